"""A checkpoint's tensors: the library's own bytes, without its copies."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load, save

from clear_strategies.training.tensor_file import parts

TYPES = (
    torch.float64, torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.int32, torch.int16, torch.int8,
    torch.uint8, torch.bool,
)  # fmt: skip
TENSORS = {f"{name} of {dtype}": (torch.arange(5) - 1).to(dtype) for dtype in TYPES for name in ("b", "a")} | {
    "no rows": torch.empty(0, 3),
    "a number": torch.tensor(3.0),
    "μ/rows": torch.randn(4, 2, 3, generator=torch.Generator().manual_seed(0)),
}


def test_the_file_is_the_one_that_the_library_writes():
    assert b"".join(parts(TENSORS)) == save(TENSORS)
    assert b"".join(parts({})) == save({})


def test_tensors_that_are_not_contiguous_are_read_back_as_they_are():
    rows = {"every other": torch.arange(12.0).reshape(4, 3)[::2], "turned": torch.arange(6.0).reshape(2, 3).T}
    found = load(b"".join(parts(rows)))
    assert all(torch.equal(found[name], rows[name]) for name in rows)


def test_a_tensor_is_not_copied():
    x = torch.zeros(3)
    *_, piece = parts({"x": x})
    x += 1
    assert bytes(piece) == x.numpy().tobytes()


def test_a_type_without_a_name_in_the_format_is_refused():
    with pytest.raises(ValueError, match="complex64"):
        b"".join(parts({"z": torch.zeros(2, dtype=torch.complex64)}))
