"""Checkpoints: written whole or not at all, and verified before they are used.

A checkpoint is one file, `step_NNNNNNN.safetensors`: the tensors, with the history among them, and in the metadata the rest as
JSON and a seal, the SHA-256 of all of it. It is written elsewhere, flushed, then renamed, and older checkpoints beyond `keep`
are removed only after that. Nothing is unpickled.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
import torch
from safetensors import SafetensorError
from safetensors.torch import load as tensors_of
from safetensors.torch import save as serialized
from torch import Tensor

from clear_strategies.data.strict_json import plain_settings
from clear_strategies.errors import DataError
from clear_strategies.files import flush, read_bytes, write_bytes

_log = logging.getLogger(__name__)

FORMAT: Final = "4"
CHECKPOINTS: Final = "checkpoints"
"""The folder of a run's checkpoints."""
SUFFIX: Final = ".safetensors"
_PREFIX: Final = "step_"
_HISTORY: Final = "history"
_USE_ANOTHER: Final = "resume from another checkpoint of the run, or start a new run"


class _Stated(msgspec.Struct):
    """What a checkpoint's metadata hold as JSON; see `Checkpoint`."""

    t: int
    config: dict[str, Any]
    facts: dict[str, float]
    work_log: dict[str, dict[str, Any]]
    device: Literal["cpu", "cuda"]
    columns: list[str]


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """All that a run needs to continue.

    Args:
        t: the next iteration. config: the run's composed configuration, to refuse another one on resume; see `plain_settings`.
        facts: small numbers (Adam's step count, the active SH degree …). history: one row per iteration.
        work_log: `WorkLog.state_dict` until then.
        device: "cpu" or "cuda", where the run was; tensors are saved from and loaded to the CPU.
    """

    t: int
    tensors: Mapping[str, Tensor]
    config: Mapping[str, Any]
    facts: Mapping[str, float]
    history: Sequence[dict[str, float]]
    work_log: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"

    def copied(self) -> Checkpoint:
        """The same in the CPU's memory, which training does not change as it goes on."""
        tensors = {name: x.detach().to("cpu", copy=True) for name, x in self.tensors.items()}
        return replace(self, tensors=tensors, history=[*self.history])


def save(folder: Path, checkpoint: Checkpoint, *, keep: int = 3) -> Path:
    """Write `folder/step_<t>.safetensors` atomically; returns its path.

    Raises:
        OSError: the disk is full or read-only; earlier checkpoints are untouched.
    """
    c = checkpoint
    target = folder / f"{_PREFIX}{c.t:07d}{SUFFIX}"
    columns = list(dict.fromkeys(name for row in c.history for name in row))
    rows = [[row.get(name, math.nan) for name in columns] for row in c.history]
    tensors = {name: x.detach().cpu().contiguous() for name, x in c.tensors.items()}
    tensors[_HISTORY] = torch.tensor(rows, dtype=torch.float64)
    stated = _Stated(c.t, dict(c.config), dict(c.facts), dict(c.work_log), c.device, columns)  # type: ignore[arg-type]
    text = msgspec.json.encode(stated).decode()
    write_bytes(target, serialized(tensors, {"format": FORMAT, "stated": text, "sha256": _seal(text, tensors)}))
    flush(folder)
    # Later ones belong to another run, or to a try that this run does not continue.
    others = [path for path in saved(folder) if path != target]
    earlier = [path for path in others if path < target]
    for old in (*earlier[: max(0, len(earlier) + 1 - keep)], *others[len(earlier) :]):
        try:
            old.unlink()
        except OSError:  # the folder has become read-only; the new checkpoint is in place
            _log.warning("%s: cannot be removed.", old)
    return target


def saved(folder: Path) -> list[Path]:
    """The checkpoints in a folder of checkpoints, newest last."""
    return sorted(folder.glob(f"{_PREFIX}*{SUFFIX}"))


def load(path: Path) -> Checkpoint:
    """Read a checkpoint, or the newest in a folder of checkpoints (or of a run).

    Raises:
        DataError: nothing is there, it is damaged, or the format is another version's.
    """
    file = _newest(path)
    data = read_bytes(file, remedy=_USE_ANOTHER)
    try:
        tensors = tensors_of(data)
        header = msgspec.json.decode(data[8 : 8 + int.from_bytes(data[:8], "little")])
        metadata: dict[str, str] = header.get("__metadata__", {})
        if (found := metadata.get("format")) != FORMAT:
            problem = f"is {found!r}, this version reads {FORMAT!r}"
            raise DataError(file, "format", problem[:120], "use the version of clear-strategies that wrote it")
        if metadata.get("sha256") != _seal(metadata["stated"], tensors):
            raise DataError(file, "sha256", "is not that of the content: the file was altered", _USE_ANOTHER)
        stated = msgspec.json.decode(metadata["stated"], type=_Stated)
        config = plain_settings(file, stated.config)
        rows = [zip(stated.columns, row, strict=True) for row in tensors.pop(_HISTORY).tolist()]
        history = [{name: x for name, x in row if not math.isnan(x)} for row in rows]
    except (SafetensorError, msgspec.MsgspecError, KeyError, TypeError, ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(file, "file", f"is no whole checkpoint ({error})", _USE_ANOTHER) from error
    return Checkpoint(stated.t, tensors, config, stated.facts, history, stated.work_log, stated.device)


def _seal(text: str, tensors: Mapping[str, Tensor]) -> str:
    """The SHA-256 of the stated text and of every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(text.encode())
    for name, x in sorted(tensors.items()):
        digest.update(f"{name} {x.dtype} {tuple(x.shape)}".encode())
        # It is contiguous, of any stride if it is empty.
        digest.update(x.as_strided((x.numel(),), (1,)).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _newest(path: Path) -> Path:
    if path.is_file():
        return path
    for folder in (path, path / CHECKPOINTS):
        if checkpoints := saved(folder):
            return checkpoints[-1]
    raise DataError(path, "checkpoint", "no checkpoint is here", "give a run's folder or one of its checkpoints/step_*")
