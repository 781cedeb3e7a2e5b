"""Checkpoints: files that are gone or not those of the manifest, and manifests with hashes that match and nonsense inside."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from clear_strategies.jobs import resume
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import Checkpoint
from tests.helpers.short_run import start
from tests.stress.bad_inputs import BadInput
from tests.stress.faults import small

_FILES = ("manifest.json", "tensors.safetensors", "history.json")


def _load(spoil: Callable[[Path], object]) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        path = checkpoint.save(folder, small(100, 1.0))
        spoil(path)
        return checkpoint.load(path)

    return give


def _rewritten(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], object]:
    return _load(lambda path: (path / name).write_bytes(change((path / name).read_bytes())))


def _sealed(**changes: Any) -> Callable[[Path], object]:
    """A manifest that was changed, and then given the hash of its new content; `...` takes an entry away."""

    def change(manifest: dict[str, Any]) -> None:
        manifest.update(changes)
        for name in [name for name, value in changes.items() if value is ...]:
            del manifest[name]

    return _load(partial(_seal, change=change))


def _seal(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    manifest = json.loads((path / "manifest.json").read_text())
    manifest.pop("sha256_of_manifest")
    change(manifest)
    (path / "manifest.json").write_text(checkpoint._sealed(manifest))


def _content(name: str, content: bytes) -> Callable[[Path], object]:
    """A file's content in place of the one that was saved, with its hash in the manifest."""

    def spoil(path: Path) -> None:
        (path / name).write_bytes(content)
        _seal(path, lambda manifest: manifest["sha256"].update({name: hashlib.sha256(content).hexdigest()}))

    return _load(spoil)


_history = partial(_content, "history.json")
_tensors = partial(_content, "tensors.safetensors")


def _swapped(name: str) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        mine, other = (
            checkpoint.save(folder, replace(small(t, float(t)), history=[{"t": float(t)}])) for t in (100, 200)
        )
        shutil.copy(other / name, mine / name)
        return checkpoint.load(mine)

    return give


def _restored(
    change: Callable[[dict[str, torch.Tensor]], object] = lambda tensors: None, **facts: Any
) -> Callable[[Path], object]:
    """A sound file whose tensors do not belong to the run that is resumed."""

    def give(folder: Path) -> object:
        state = start(("gco", "svs"))
        saved = state.checkpoint({})
        tensors = dict(saved.tensors)
        change(tensors)
        t = facts.pop("t", saved.t)
        spoilt = Checkpoint(t, tensors, {}, {**saved.facts, **facts}, saved.history, saved.work_log, saved.device)
        return resume.restore(start(("gco", "svs")), spoilt, folder, {})

    return give


def _nested(depth: int) -> bytes:
    return b'{"a":' * depth + b"1" + b"}" * depth


_FACTS = {"optimizer_steps": 100.0, "degree": 1.0}
_CASES: dict[str, tuple[Callable[[Path], object], str]] = {
    "absent": (lambda folder: checkpoint.load(folder / "none"), "checkpoint: no checkpoint is here"),
    "folder without checkpoints": (checkpoint.load, "checkpoint: no checkpoint is here"),
    **{f"{name} gone": (_load(lambda path, name=name: (path / name).unlink()), "file: cannot be read|no checkpoint is here")
       for name in _FILES},
    **{f"{name} empty": (_rewritten(name, lambda data: b""), rf"{name}: (json|sha256)") for name in _FILES},
    **{f"{name} cut in half": (_rewritten(name, lambda data: data[: len(data) // 2]), rf"{name}: (json|sha256)")
       for name in _FILES},
    **{f"{name} with a byte more": (_rewritten(name, lambda data: data + b" "), rf"{name}: sha256") for name in _FILES},
    **{f"{name} of another checkpoint": (_swapped(name), r"sha256") for name in _FILES[1:]},
    "manifest is a list": (_rewritten("manifest.json", lambda data: b"[]"), "json: must be an object, got a list"),
    "manifest is a number": (_rewritten("manifest.json", lambda data: b"7"), "json: must be an object, got a int"),
    "manifest nests 100,000 deep": (_rewritten("manifest.json", lambda data: _nested(100_000)), "json: is not valid JSON"),
    "manifest is no UTF-8": (_rewritten("manifest.json", lambda data: b'{"a": "\xff"}'), "json: is not valid JSON"),
    "number of 5,000 digits": (_rewritten("manifest.json", lambda data: b'{"t": ' + b"7" * 5000 + b"}"), "json: is not"),
    "altered t": (_rewritten("manifest.json", lambda data: data.replace(b'"t": 100', b'"t": 999')), "sha256_of_manifest"),
    "altered setting": (_rewritten("manifest.json", lambda data: data.replace(b'seed": 1', b'seed": 2')), "sha256_of_man"),
    "format of an earlier version": (_sealed(format=1), "format: is 1, this version reads 2"),
    "format of a later version": (_sealed(format=99), "format: is 99, this version reads 2"),
    "format in words": (_sealed(format="two"), "format: is 'two'"),
    "no format": (_sealed(format=...), "format: is None"),
    **{f"{name} missing": (_sealed(**{name: ...}), name)
       for name in ("t", "config", "facts", "work_log", "device", "sha256")},
    **{f"t is {value!r}": (_sealed(t=value), r"manifest.json: t: must")
       for value in (0, -5, 10**30, 1.5, "7", None, True, [], float("nan"), float("inf"))},
    **{f"degree is {value!r}": (_sealed(facts={**_FACTS, "degree": value}), r"facts.degree: must")
       for value in (7, -1, 0.5, float("inf"), "1")},
    **{f"steps are {value!r}": (_sealed(facts={**_FACTS, "optimizer_steps": value}), r"facts.optimizer_steps: must")
       for value in (-1, 10**12, float("nan"))},
    "facts are a list": (_sealed(facts=[]), "facts: must"),
    "config is a list": (_sealed(config=[]), "config: must"),
    "device is a printer": (_sealed(device="printer"), "device: "),
    "work log counts below 0": (
        _sealed(work_log={"a": {"runs": -1, "seconds": 0, "skipped": {}}}), r"work_log\[...\].runs: must be",
    ),
    "hash is a number": (_sealed(sha256=dict.fromkeys(_FILES[1:], 7)), "sha256"),
    "hash of another file alone": (_sealed(sha256={"a": "b"}), "sha256"),
    "history is an object": (_history(b"{}"), "history.json: json: must be"),
    "history of texts": (_history(b'["a"]'), r"history.json: \[0\]: must"),
    "history with a text for a number": (_history(b'[{"t": "1"}]'), r"history.json: \[0\]\[...\]: must be"),
    "history that is no JSON": (_history(b"[1,"), "history.json: json: is not valid JSON"),
    "tensors are a pickle": (_tensors(b"\x80\x04K\x01."), "tensors.safetensors: tensors: are no safetensors"),
    "tensors are nothing": (_tensors(b""), "tensors.safetensors: tensors: are no safetensors"),
    "tensors' header asks for 2^60 bytes": (_tensors((2**60).to_bytes(8, "little") + b"{}"), "are no safetensors"),
    "tensors' offsets overlap nothing": (
        _tensors((60).to_bytes(8, "little") + b'{"a":{"dtype":"F32","shape":[9],"data_offsets":[0,36]}}'.ljust(60)),
        "are no safetensors",
    ),
    "no means": (_restored(lambda tensors: tensors.pop("field/means")), "do not fit this run"),
    "no moments": (_restored(lambda tensors: tensors.pop("optimizer/first.means")), "do not fit this run"),
    "no statistics": (_restored(lambda tensors: tensors.pop("density/score")), "do not fit this run"),
    **{f"{name} with a row too few": (
        _restored(lambda tensors, name=name: tensors.update({name: tensors[name][:-1]})), "do not fit this run")
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
    "t beyond the run": (_restored(t=10_000), "t=10000"),
    "degree beyond the run": (_restored(degree=4.0), "degree=4"),
}  # fmt: skip
INPUTS = [BadInput("checkpoint", name, give, pattern) for name, (give, pattern) in _CASES.items()]
