"""The merge in C++ (`kernels/src/merge.cpp`), for tensors on the CPU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import ROTATION_NOISE, CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.core.gradients import CONFLICT_GROUPS
from clear_strategies.kernels.merge.interface import Colour, Merged, Rows
from rasterizers.native import load_kernels, threads

GROUPS: Final = {name: k for k, name in enumerate((*CONFLICT_GROUPS, "detail"))}
FIRST_BANDS: Final = {"sh0": 0, "shN": 1}


def merge(
    attributes: Mapping[str, Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
    colour: Colour | None = None, keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
) -> Merged:  # fmt: skip
    """See `kernels.merge.Merge`."""
    tables = [
        {
            "out": rows.out, "lr": _whole(rows.lr), "before": _whole(rows.before), "hr": _whole(rows.hr), "p": _whole(rows.p),
            "anchor": _whole(rows.anchor), "stiffness": rows.stiffness, "width": rows.out.shape[1:].numel(),
            "group": GROUPS[name], "first_band": FIRST_BANDS.get(name, -1) if colour is not None else -1,
        }
        for name, rows in attributes.items()
    ]  # fmt: skip
    factors = None if colour is None else {
        "rgb": colour.rgb.contiguous(), "basis": colour.basis.contiguous(), "bases": colour.basis.shape[1]
    }  # fmt: skip
    n = len(next(iter(attributes.values())).out)
    kernels: Any = load_kernels("clear_strategies.kernels")
    counts, finite = kernels.merge(n, tables, factors, correction_table(rule, q), keeps_lr, lambda_hr, scale, threads())
    return Merged(ConflictCounts(*counts), finite)


def correction_table(rule: CorrectionRule | None, q: Float[Tensor, " N"] | None) -> dict[str, Any] | None:
    """The rule as the kernels take it."""
    if rule is None:
        return None
    return {
        "groups": rule.corrects, "tolerance": rule.tolerance, "weight_min": rule.weight_min, "weight_max": rule.weight_max,
        "rotation_noise": ROTATION_NOISE, "reliability": None if q is None else q.float().contiguous(),
    }  # fmt: skip


def _whole(x: Tensor | None) -> Tensor | None:
    return None if x is None else x.detach().contiguous()
