"""Products and apply in torch, in float64, on any device: the specification of the other two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels.reconcile.tables import FIRST_BANDS, WeightTable, row_width, weight_tables


def products(lr: Grads, hr: Grads, names: Sequence[str]) -> Products:
    """See `kernels.reconcile.products`."""
    columns = []
    for group in CONFLICT_GROUPS:
        width = row_width(group, lr, hr) if group in names else 0
        low, high = _rows(lr, group, width), _rows(hr, group, width)
        columns.append(torch.stack(((low * high).sum(1), low.square().sum(1), high.square().sum(1))))
    dot, l2, h2 = table = torch.stack(columns, 2)
    whole_dot, whole_l2, whole_h2 = torch.cat((table, table.sum(2, keepdim=True)), 2)
    comparable = (whole_l2 > 0) & (whole_h2 > 0)
    counts = (deferred.elements(x.sum(0)) for x in (comparable, comparable & (whole_dot < 0)))
    return Products(names, dot, l2, h2, *counts)


def apply(
    out: Mapping[str, Tensor], lr: Grads, hr: Grads, weights: Weights, lambda_hr: float | Tensor, plus: Grads,
    keeps_lr: bool,
) -> Number:  # fmt: skip
    """See `kernels.reconcile.apply`."""
    first = next(iter(out.values()))
    tables = weight_tables(weights, len(first), first.device)
    for name, to in out.items():
        low, high, added = (_rows(g, name, to.shape[1:].numel(), to) for g in (lr, hr, plus))
        keep, remove = (_weight(table, name) for table in tables) if name in CONFLICT_GROUPS else Weights()
        g_hr = keep * high - remove * low  # Eq. 7
        total = low + lambda_hr * g_hr if keeps_lr else g_hr  # Eq. 8
        to.copy_((total + added).view(to.shape))
    return deferred.scalar(torch.stack([x.isfinite().all() for x in out.values()]).all())


def _rows(g: Grads, name: str, width: int, like: Tensor | None = None) -> Float[Tensor, "N D"]:
    """An attribute's gradient in float64, as rows of `width` numbers; 0 if there is none."""
    first = next(iter(g.tensors.values())) if like is None else like
    rows = first.new_zeros(len(first), width, dtype=torch.float64)
    if name in g and width:
        rows += g[name].reshape(rows.shape)
    if g.colour is not None and name in FIRST_BANDS and width:
        bands = g.colour.basis[:, :1] if name == "sh0" else g.colour.basis[:, 1:]
        product = (bands.double()[..., None] * g.colour.rgb.double()[:, None]).flatten(1)
        rows[:, : product.shape[1]] += product
    return rows


def _weight(table: WeightTable, name: str) -> float | Float[Tensor, "N 1"]:
    number, rows, _ = table
    if rows is None:
        return number
    return (rows[CONFLICT_GROUPS.index(name)] if rows.dim() == 2 else rows)[:, None]
