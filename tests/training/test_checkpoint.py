"""Checkpoints: what is saved comes back, others may read the file, and the last few are kept."""

import errno
import math
import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clear_strategies import DataError
from clear_strategies.training import checkpoint
from tests.helpers.full_disk import full_disk
from tests.helpers.short_run import start

TYPES = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8,
    torch.uint8, torch.bool,
)  # fmt: skip
TENSORS = {f"{name} of {dtype}": (torch.arange(5) - 1).to(dtype) for dtype in TYPES for name in ("b", "a")} | {
    "no rows": torch.empty(0, 3),
    "a number": torch.tensor(3.0),
    "μ/rows": torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0)),
    "every other": torch.arange(12.0).reshape(4, 3)[::2],
    "turned": torch.arange(6.0).reshape(2, 3).T,
}
HISTORY = [{"t": 1.0, "loss": 1 / 3}, {"t": 2.0, "loss": math.inf, "psnr": -0.0}, {}, {"t": 3.0, "loss": 1e-300}]
CONFIG = {"fit.seed": 1, "data.views.train": None, "b": [1, 2.5, "μ\n\""], "on": True}  # fmt: skip


def test_what_is_saved_comes_back(tmp_path: Path) -> None:
    saved = replace(start(()).checkpoint(CONFIG), tensors=TENSORS, history=HISTORY)
    path = checkpoint.save(tmp_path, saved)
    found = checkpoint.load(path)
    for name in ("t", "config", "facts", "work_log", "device"):
        assert getattr(found, name) == getattr(saved, name), name
    assert [list(row.items()) for row in found.history] == [list(row.items()) for row in HISTORY]
    assert found.tensors.keys() == TENSORS.keys()
    for name, x in TENSORS.items():
        assert found.tensors[name].dtype == x.dtype
        assert torch.equal(found.tensors[name], x), name
    plain = tmp_path / "plain"
    plain.touch()
    assert path.stat().st_mode == plain.stat().st_mode  # others may read it, as any file of a run
    assert list(tmp_path.iterdir()) == [path, plain] or list(tmp_path.iterdir()) == [plain, path]


def test_a_full_disk_is_told_as_such_and_leaves_nothing(tmp_path: Path) -> None:
    saved = start(()).checkpoint({})
    with full_disk(), pytest.raises(OSError, match=os.strerror(errno.EFBIG)) as refused:
        checkpoint.save(tmp_path, saved)
    assert refused.value.errno == errno.EFBIG
    assert list(tmp_path.iterdir()) == []


def test_the_last_few_are_kept_and_the_newest_is_found(tmp_path: Path) -> None:
    state = start(())
    for t in (1, 2, 3, 4, 5):
        state.t = t
        checkpoint.save(tmp_path / "checkpoints", state.checkpoint({}), keep=2)
    kept = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert kept == ["step_0000004.safetensors", "step_0000005.safetensors"]
    assert checkpoint.load(tmp_path).t == 5
    state.t = 2  # of a try that starts earlier
    checkpoint.save(tmp_path / "checkpoints", state.checkpoint({}), keep=2)
    assert [p.name for p in checkpoint.saved(tmp_path / "checkpoints")] == ["step_0000002.safetensors"]
    with pytest.raises(DataError, match="no checkpoint is here"):
        checkpoint.load(tmp_path / "elsewhere")
