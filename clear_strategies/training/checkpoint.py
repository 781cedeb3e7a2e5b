"""Checkpoints: written whole or not at all, and verified before they are used.

A checkpoint is a folder: `tensors.safetensors`, `history.json`, and `manifest.json` with the SHA-256 of both and of itself.
It is written under another name, flushed, then renamed; older checkpoints beyond `keep`, and an earlier one of the same
iteration, are removed only after that. Nothing is unpickled.

The tensors are written here one by one, since safetensors itself holds all of them in memory twice more while it writes.
https://github.com/huggingface/safetensors#format: the header's length in 8 bytes, the header as JSON, the tensors' bytes.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import logging
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
import torch
from msgspec import Meta
from torch import Tensor

from clear_strategies.data.strict_json import Count, Positive, typed
from clear_strategies.errors import DataError
from clear_strategies.files import partial_of, read_bytes

_log = logging.getLogger(__name__)

FORMAT: Final = 2
_TENSORS, _HISTORY, _MANIFEST = "tensors.safetensors", "history.json", "manifest.json"
CHECKPOINTS: Final = "checkpoints"
"""The folder of a run's checkpoints."""
_PREFIX: Final = "step_"
_SEAL: Final = "sha256_of_manifest"
_STATED: Final = ("t", "config", "facts", "work_log", "device")  # the fields of `Checkpoint` in the manifest
_USE_ANOTHER: Final = "resume from another checkpoint of the run, or start a new run"

# In the order in which the library writes them: wide types first, so that every tensor is aligned.
_TYPES: Final = {
    torch.int64: "I64", torch.float64: "F64", torch.float32: "F32", torch.int32: "I32", torch.bfloat16: "BF16",
    torch.float16: "F16", torch.int16: "I16", torch.int8: "I8", torch.uint8: "U8", torch.bool: "BOOL",
}  # fmt: skip
_ALIGNMENT: Final = 8  # bytes; of the header, so that the first tensor is aligned


class _Facts(msgspec.Struct):
    optimizer_steps: Annotated[float, Meta(ge=0, le=10**9, multiple_of=1)]
    degree: Annotated[float, Meta(ge=0, le=3, multiple_of=1)]


class _Stage(msgspec.Struct):
    runs: Count
    seconds: Positive
    skipped: dict[str, Count]


class _Hashes(msgspec.Struct):
    tensors: str = msgspec.field(name=_TENSORS)
    history: str = msgspec.field(name=_HISTORY)


class _Manifest(msgspec.Struct):
    t: Annotated[int, Meta(ge=1, le=10**9)]
    config: dict[str, Any]
    facts: _Facts
    work_log: dict[str, _Stage]
    device: Literal["cpu", "cuda"]
    sha256: _Hashes


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
    history: Sequence[dict[str, float]]
    work_log: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"


def save(folder: Path, checkpoint: Checkpoint, *, keep: int = 3) -> Path:
    """Write `folder/step_<t>` atomically; returns its path.

    Raises:
        OSError: the disk is full or read-only; earlier checkpoints are untouched.
    """
    folder.mkdir(parents=True, exist_ok=True)
    step = f"{_PREFIX}{checkpoint.t:07d}"
    # Where the name is taken, by the same step before a resume, another that sorts right after it.
    names = itertools.chain([step], (f"{step}_{n}" for n in itertools.count(2)))
    target = next(path for name in names if not (path := folder / name).exists())
    contents = {_TENSORS: tensor_parts(checkpoint.tensors), _HISTORY: _rows(checkpoint.history)}
    manifest: dict[str, Any] = {"format": FORMAT, **{name: getattr(checkpoint, name) for name in _STATED}}
    partial = partial_of(target)
    try:
        partial.mkdir()
        manifest["sha256"] = {name: _write_durably(partial / name, parts) for name, parts in contents.items()}
        _write_durably(partial / _MANIFEST, [_sealed(manifest).encode()])
        _flush_folder(partial)
        partial.rename(target)
        _flush_folder(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)  # exists only after an exception or Ctrl-C above
    # Those of the same iteration, and of later ones, belong to another run or to a try that this run does not continue.
    others = [path for path in saved(folder) if path != target]
    earlier = [path for path in others if path.name < step]
    for old in (*earlier[: max(0, len(earlier) + 1 - keep)], *others[len(earlier) :]):
        _remove(old)
    return target


def _remove(old: Path) -> None:
    """Renamed first: a checkpoint that is half removed must not look like one."""
    gone = partial_of(old)
    try:
        old.rename(gone)
    except OSError:  # the folder has become read-only; the new checkpoint is in place
        _log.warning("%s: cannot be removed.", old)
        return
    shutil.rmtree(gone, ignore_errors=True)


def saved(folder: Path) -> list[Path]:
    """The checkpoints in a folder of checkpoints, newest last."""
    return sorted(p for p in folder.glob(f"{_PREFIX}*") if (p / _MANIFEST).is_file())


def load(path: Path) -> Checkpoint:
    """Read a checkpoint folder, or the newest in a folder of checkpoints (or of a run).

    Raises:
        DataError: nothing is there, a file is missing or altered, or the format is newer than this version.
    """
    path = _newest(path)
    manifest = _manifest(path)
    files = {}
    for name in (_TENSORS, _HISTORY):
        files[name] = read_bytes(path / name, remedy=_USE_ANOTHER)
        if hashlib.sha256(files[name]).hexdigest() != manifest["sha256"][name]:
            raise DataError(path / name, "sha256", "is not what the manifest says: the file was altered", _USE_ANOTHER)
    tensors = tensors_of(path / _TENSORS, files[_TENSORS])
    history = _json(path / _HISTORY, files[_HISTORY])
    typed(path / _HISTORY, history, list[dict[str, float]], remedy=_USE_ANOTHER)
    return Checkpoint(tensors=tensors, history=history, **{name: manifest[name] for name in _STATED})


def tensor_parts(tensors: Mapping[str, Tensor]) -> Iterator[bytes | memoryview]:
    """The pieces of tensors.safetensors in their order; a tensor's is a view of its memory. Tensors on a device are copied one
    by one.

    Raises:
        ValueError: a tensor's type has no name in the format.
    """
    types = list(_TYPES)
    order = sorted(tensors.items(), key=lambda item: (types.index(item[1].dtype), item[0]))
    header, end = dict[str, object](), 0
    for name, x in order:
        start, end = end, end + x.nbytes
        header[name] = {"dtype": _TYPES[x.dtype], "shape": list(x.shape), "data_offsets": [start, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    yield len(text).to_bytes(8, "little") + text
    for _, x in order:
        yield x.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data


def tensors_of(file: Path, data: bytes) -> dict[str, Tensor]:
    """The content of a tensors.safetensors.

    Raises:
        DataError: it is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load as from_bytes

    try:
        return from_bytes(data)
    except (SafetensorError, ValueError, KeyError, AttributeError, RuntimeError) as error:
        raise DataError(file, "tensors", f"are no safetensors ({error})", _USE_ANOTHER) from error


def _manifest(path: Path) -> dict[str, Any]:
    file = path / _MANIFEST
    data = read_bytes(file, remedy=_USE_ANOTHER)
    manifest = _json(file, data)
    if not isinstance(manifest, dict):
        raise DataError(file, "json", f"must be an object, got a {type(manifest).__name__}", _USE_ANOTHER)
    if manifest.get("format") != FORMAT:
        problem = f"is {manifest.get('format')!r}, this version reads {FORMAT}"
        raise DataError(file, "format", problem[:120], "use the version of clear-strategies that wrote it")
    content = {key: value for key, value in manifest.items() if key != _SEAL}
    if _sealed(content).encode() != data:
        raise DataError(file, _SEAL, "is not that of the file: it was altered", _USE_ANOTHER)
    typed(file, content, _Manifest, remedy=_USE_ANOTHER)
    return content


def _sealed(manifest: Mapping[str, Any]) -> str:
    """The manifest's text with the hash of its own content. No other text is accepted, so every altered bit is found."""
    digest = hashlib.sha256(json.dumps(manifest).encode()).hexdigest()
    return json.dumps({**manifest, _SEAL: digest}, indent=1)


def _json(file: Path, data: bytes) -> Any:
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(file, "json", f"is not valid JSON ({str(error)[:120]})", _USE_ANOTHER) from error


def _newest(path: Path) -> Path:
    if (path / _MANIFEST).is_file():
        return path
    for folder in (path, path / CHECKPOINTS):
        if checkpoints := saved(folder):
            return checkpoints[-1]
    raise DataError(path, "checkpoint", "no checkpoint is here", "give a run's folder or one of its checkpoints/step_*")


def _rows(history: Sequence[Mapping[str, float]]) -> Iterator[bytes]:
    """The JSON of a list, row by row: as a whole it is larger than the history itself."""
    yield b"["
    for i, row in enumerate(history):
        yield (", " * (i > 0) + json.dumps(row)).encode()
    yield b"]"


def _write_durably(path: Path, parts: Iterable[bytes | memoryview]) -> str:
    """Write the parts one after the other; returns the SHA-256 of the whole."""
    digest = hashlib.sha256()
    with path.open("wb") as file:
        for part in parts:
            digest.update(part)
            file.write(part)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest()


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
