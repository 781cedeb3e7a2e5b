"""Checkpoints: written whole or not at all, and verified before they are used.

A checkpoint is a folder: `tensors.safetensors`, `history.json`, and `manifest.json` with the SHA-256 of both. It is
written under another name, flushed, then renamed; older checkpoints beyond `keep` are removed only after that. Nothing is
unpickled.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

FORMAT: Final = 1
_TENSORS, _HISTORY, _MANIFEST = "tensors.safetensors", "history.json", "manifest.json"
_PREFIX: Final = "step_"


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """What a run needs to continue.

    Args:
        t: the next iteration. config: the run's composed configuration, to refuse another one on resume.
        facts: small numbers (Adam's step count, the active SH degree …). history: one row per iteration.
        work_log: `WorkLog.state_dict` until then.
        device: "cpu" or "cuda", where the run was; tensors are saved from and loaded to the CPU.
    """

    t: int
    tensors: Mapping[str, Tensor]
    config: Mapping[str, Any]
    facts: Mapping[str, float]
    history: list[dict[str, float]]
    work_log: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"


def save(folder: Path, checkpoint: Checkpoint, *, keep: int = 3) -> Path:
    """Write `folder/step_<t>` atomically; returns its path.

    Raises:
        OSError: the disk is full or read-only; earlier checkpoints are untouched.
    """
    from safetensors.torch import save as to_bytes

    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{_PREFIX}{checkpoint.t:07d}"
    tensors = {name: value.detach().cpu().contiguous() for name, value in checkpoint.tensors.items()}
    files = {_TENSORS: to_bytes(tensors), _HISTORY: json.dumps(checkpoint.history).encode()}
    manifest = {
        "format": FORMAT,
        "t": checkpoint.t,
        "config": checkpoint.config,
        "facts": checkpoint.facts,
        "work_log": checkpoint.work_log,
        "device": checkpoint.device,
        "sha256": {name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
    }
    files[_MANIFEST] = json.dumps(manifest, indent=1).encode()

    partial = folder / f".{target.name}.{os.getpid()}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir()
        for name, data in files.items():
            _write_durably(partial / name, data)
        if target.exists():  # the same step again, after a resume
            shutil.rmtree(target)
        partial.rename(target)
        _flush_folder(folder)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    all_of_them = saved(folder)
    # Checkpoints of later iterations belong to another run, or to a try that this run does not continue.
    until, beyond = [p for p in all_of_them if p <= target], [p for p in all_of_them if p > target]
    for old in (*until[:-keep], *beyond):
        shutil.rmtree(old, ignore_errors=True)
    return target


def saved(folder: Path) -> list[Path]:
    """The checkpoints in a folder of checkpoints, newest last."""
    return sorted(p for p in folder.glob(f"{_PREFIX}*") if (p / _MANIFEST).is_file())


def load(path: Path) -> Checkpoint:
    """Read a checkpoint folder, or the newest in a folder of checkpoints (or of a run).

    Raises:
        DataError: nothing is there, a file is missing or altered, or the format is newer than this version.
    """
    from safetensors.torch import load as from_bytes

    path = _newest(path)
    manifest = _manifest(path)
    files = {}
    for name in (_TENSORS, _HISTORY):
        try:
            files[name] = (path / name).read_bytes()
        except OSError as error:
            raise DataError(path / name, "file", f"cannot be read ({error.strerror})", _USE_ANOTHER) from error
        if hashlib.sha256(files[name]).hexdigest() != manifest["sha256"].get(name):
            raise DataError(path / name, "sha256", "is not what the manifest says: the file was altered", _USE_ANOTHER)
    return Checkpoint(
        t=manifest["t"],
        tensors=from_bytes(files[_TENSORS]),
        config=manifest["config"],
        facts=manifest["facts"],
        history=json.loads(files[_HISTORY]),
        work_log=manifest.get("work_log", {}),
        device=manifest.get("device", "cpu"),
    )


_USE_ANOTHER: Final = "resume from another checkpoint of the run, or start a new run"


def _manifest(path: Path) -> dict[str, Any]:
    file = path / _MANIFEST
    try:
        manifest = json.loads(file.read_text())
    except OSError as error:
        raise DataError(file, "file", f"cannot be read ({error.strerror})", _USE_ANOTHER) from error
    except (ValueError, RecursionError) as error:
        raise DataError(file, "json", f"is not valid JSON ({error})", _USE_ANOTHER) from error
    kinds = {"format": int, "t": int, "config": dict, "facts": dict, "sha256": dict}
    for key, kind in kinds.items():
        if not isinstance(manifest, dict) or not isinstance(manifest.get(key), kind):
            raise DataError(file, key, f"is missing or no {kind.__name__}", _USE_ANOTHER)
    if manifest["format"] != FORMAT:
        problem = f"is {manifest['format']}, this version reads {FORMAT}"
        raise DataError(file, "format", problem, "use the version of clear-strategies that wrote it")
    return dict(manifest)


def _newest(path: Path) -> Path:
    if (path / _MANIFEST).is_file():
        return path
    for folder in (path, path / "checkpoints"):
        if found := saved(folder):
            return found[-1]
    raise DataError(path, "checkpoint", "no checkpoint is here", "give a run's folder or one of its checkpoints/step_*")


def _write_durably(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
