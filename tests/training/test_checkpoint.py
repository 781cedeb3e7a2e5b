"""Checkpoints: the tensors are the library's own bytes, without its copies; the last few checkpoints are kept."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save

from clear_strategies import DataError
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import tensor_parts
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


def test_the_file_is_the_one_that_the_library_writes():
    assert b"".join(tensor_parts(TENSORS)) == save({name: x.contiguous() for name, x in TENSORS.items()})
    assert b"".join(tensor_parts({})) == save({})
    with pytest.raises(ValueError, match="complex64"):
        b"".join(tensor_parts({"z": torch.zeros(2, dtype=torch.complex64)}))


def test_a_tensor_is_not_copied():
    x = torch.zeros(3)
    *_, piece = tensor_parts({"x": x})
    x += 1
    assert bytes(piece) == x.numpy().tobytes()


def test_the_last_few_are_kept_and_the_newest_is_found(tmp_path):
    state = start(())
    for t in (1, 2, 3, 4, 5):
        state.t = t
        checkpoint.save(tmp_path / "checkpoints", state.checkpoint({}), keep=2)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["step_0000004", "step_0000005"]
    assert checkpoint.load(tmp_path).t == 5
    with pytest.raises(DataError, match="no checkpoint is here"):
        checkpoint.load(tmp_path / "elsewhere")
