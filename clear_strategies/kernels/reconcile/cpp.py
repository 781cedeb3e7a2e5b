"""Products and apply in C++ (`kernels/src/reconcile.cpp`), for float32 in the CPU's memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import torch
from torch import Tensor

from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels import native
from clear_strategies.kernels.reconcile.tables import (
    FIRST_BANDS,
    addresses,
    contiguous,
    row_width,
    weight_tables,
)
from rasterizers.native import empty, threads

_GROUPS: Final = {name: k for k, name in enumerate((*CONFLICT_GROUPS, "detail"))}


def products(lr: Grads, hr: Grads, names: Sequence[str]) -> Products:
    """See `kernels.reconcile.products`."""
    lr, hr = contiguous(lr), contiguous(hr)
    n = len(next(iter(lr.tensors.values())))
    rows = [_rows(name, row_width(name, lr, hr), n, lr.get(name), hr.get(name)) for name in names]
    table = empty((3, len(CONFLICT_GROUPS), n), torch.float64)
    kernels: Any = native.module()
    counts = kernels.products(n, rows, _factors(lr, n), _factors(hr, n), table.data_ptr(), threads())
    return Products(names, *(x.T for x in table), *counts)


def apply(
    out: Mapping[str, Tensor], lr: Grads, hr: Grads, weights: Weights, lambda_hr: float | Tensor, plus: Grads,
    keeps_lr: bool,
) -> Number:  # fmt: skip
    """See `kernels.reconcile.apply`."""
    lr, hr, plus, n = contiguous(lr), contiguous(hr), contiguous(plus), len(next(iter(out.values())))
    rows = [
        _rows(name, to.shape[1:].numel(), n, lr.get(name), hr.get(name), plus.get(name), to) for name, to in out.items()
    ]
    tables = weight_tables(weights, n, torch.device("cpu"))
    kernels: Any = native.module()
    finite: bool = kernels.apply(
        n, rows, _factors(lr, n), _factors(hr, n), addresses(tables), float(lambda_hr), keeps_lr, threads()
    )
    return finite


def _rows(name: str, width: int, n: int, *tensors: Tensor | None) -> tuple[int, ...]:
    """An attribute for the kernel: addresses of lr, hr, plus and out, width, group, first band."""
    at = [_address(name, x, n, width) for x in tensors]
    group = _GROUPS.get(name, _GROUPS["detail"])  # other attributes are summed, like f_det
    return (*at, *[0] * (4 - len(at)), width, group, FIRST_BANDS.get(name, -1))


def _factors(g: Grads, n: int) -> tuple[int, int, int]:
    if g.colour is None:
        return 0, 0, 1
    bases = g.colour.basis.shape[1]
    return _address("rgb", g.colour.rgb, n, 3), _address("basis", g.colour.basis, n, bases), bases


def _address(name: str, x: Tensor | None, n: int, width: int) -> int:
    """The address of a tensor; 0 for None."""
    if x is None:
        return 0
    if x.numel() != n * width or not x.is_contiguous():
        raise ValueError(
            f"{name} must be contiguous, {n} rows of {width} numbers, got {list(x.shape)} at {x.stride()}."
        )
    return x.data_ptr()
