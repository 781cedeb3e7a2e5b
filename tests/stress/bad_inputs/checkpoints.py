"""Checkpoints: files that are gone, damaged or of another program, and sound ones that do not belong to the run."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save

from clear_strategies.jobs import resume
from clear_strategies.training import checkpoint
from tests.helpers.short_run import SCENE, start
from tests.stress.bad_inputs import BadInput
from tests.stress.faults import small


def _rewritten(change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    """Of the file's bytes."""

    def give(folder: Path) -> object:
        path = checkpoint.save(folder, small(100, 1.0))
        path.write_bytes(change(path.read_bytes()))
        return checkpoint.load(path)

    return give


def _stated(text: str | None = None, *, sealed: bool = True, **changes: str) -> Callable[[Path], object]:
    """Other metadata beside the same tensors: `text` with its seal, and changes of the entries."""

    def change(data: bytes) -> bytes:
        tensors, header = load(data), data[8 : 8 + struct.unpack("<Q", data[:8])[0]]
        metadata: dict[str, str] = checkpoint.msgspec.json.decode(header)["__metadata__"]
        if text is not None:
            metadata["stated"] = text
        if sealed:
            metadata["sha256"] = checkpoint._seal(metadata["stated"], tensors)
        return save(tensors, {**metadata, **changes})

    return _rewritten(change)


def _restored(
    change: Callable[[dict[str, torch.Tensor]], object] = lambda tensors: None, **stated: Any
) -> Callable[[Path], object]:
    """A sound file whose content does not belong to the run that is resumed."""

    def give(folder: Path) -> object:
        saved = start(("gco", "svs")).checkpoint({})
        tensors, facts = dict(saved.tensors), {**saved.facts, **stated.pop("facts", {})}
        change(tensors)
        path = checkpoint.save(folder, replace(saved, tensors=tensors, facts=facts, **stated))
        return resume.restore(start(("gco", "svs")), SCENE, checkpoint.load(path), path)

    return give


def _with_row_too_few(name: str) -> Callable[[Path], object]:
    return _restored(lambda tensors: tensors.update({name: tensors[name][:-1]}))


_HEADER = b'{"a":{"dtype":"F32","shape":[9],"data_offsets":[0,36]}}'.ljust(60)
_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "absent": (lambda folder: checkpoint.load(folder / "none"), "checkpoint: no checkpoint is here"),
    "folder without checkpoints": (checkpoint.load, "checkpoint: no checkpoint is here"),
    "empty": (_rewritten(lambda data: b""), "is no whole checkpoint"),
    "cut in half": (_rewritten(lambda data: data[: len(data) // 2]), "is no whole checkpoint"),
    "with a byte more": (_rewritten(lambda data: data + b" "), "is no whole checkpoint"),
    "a pickle": (_rewritten(lambda data: b"\x80\x04K\x01."), "is no whole checkpoint"),
    "header asks for 2^60 bytes": (_rewritten(lambda data: (2**60).to_bytes(8, "little") + b"{}"), "is no whole"),
    "offsets overlap nothing": (_rewritten(lambda data: (60).to_bytes(8, "little") + _HEADER), "is no whole"),
    "tensors of another program": (_rewritten(lambda data: save(load(data))), "format: is None, this version reads '4'"),
    "altered t": (_rewritten(lambda data: data.replace(b'\\"t\\":100', b'\\"t\\":999')), "sha256: .* was altered"),
    "altered setting": (_rewritten(lambda data: data.replace(b'seed\\":1', b'seed\\":2')), "sha256: .* was altered"),
    "altered number": (_rewritten(lambda data: data.replace(struct.pack("<f", 1), struct.pack("<f", 2))), "was altered"),
    "the same numbers in another shape": (_rewritten(lambda data: data.replace(b"[5,3]", b"[3,5]")), "sha256: .* was altered"),
    "a table among the settings": (
        _stated('{"t":1,"config":{"a.b":[{"_target_":"os.abort"}]},"facts":{},"work_log":{},"device":"cpu","columns":[]}'),
        r"config\.a\.b: must be a number, text, true, false, null or a list of these",
    ),
    "format of a later version": (_stated(format="99"), "format: is '99', this version reads '4'"),
    "no seal": (_stated(sealed=False, sha256=""), "sha256: .* was altered"),
    "stated is no JSON": (_stated("{"), "is no whole checkpoint"),
    "stated is a list": (_stated("[]"), "is no whole checkpoint"),
    "stated lacks entries": (_stated('{"t":1}'), "is no whole checkpoint"),
    "stated nests 100,000 deep": (_stated('{"a":' * 100_000), "is no whole checkpoint"),
    "device is a printer": (
        _stated('{"t":1,"config":{},"facts":{},"work_log":{},"device":"printer","columns":[]}'), "no whole checkpoint",
    ),
    "history of other columns": (
        _stated('{"t":1,"config":{},"facts":{},"work_log":{},"device":"cpu","columns":["t"]}'), "is no whole checkpoint",
    ),
    "no means": (_restored(lambda tensors: tensors.pop("field/means")), "do not fit this run"),
    "no moments": (_restored(lambda tensors: tensors.pop("optimizer/first.means")), "do not fit this run"),
    "no statistics": (_restored(lambda tensors: tensors.pop("density/score")), "do not fit this run"),
    **{f"{name} with a row too few": (_with_row_too_few(name), "do not fit this run")
       for name in ("field/quats", "field/filter_3d", "optimizer/second.shN", "density/count")},
    "means in float64": (
        _restored(lambda tensors: tensors.update({"field/means": tensors["field/means"].double()})), "torch.float64",
    ),
    "harmonics of another degree": (
        _restored(lambda tensors: tensors.update({"field/shN": tensors["field/shN"][:, :3]})), "shN is",
    ),
    "a strategy's tensors that is not in the run": (
        _restored(lambda tensors: tensors.update({"strategies/Other.rows": torch.zeros(3)})), "belongs to no strategy",
    ),
    "t of 0": (_restored(t=0), "t=0"),
    "t beyond the run": (_restored(t=10_000), "t=10000"),
    "degree beyond the run": (_restored(facts={"degree": 4.0}), "degree=4"),
}  # fmt: skip
INPUTS = [BadInput("checkpoint", name, give, pattern) for name, (give, pattern) in _CASES.items()]
