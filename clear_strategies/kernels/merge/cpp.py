"""The merge in C++ (`kernels/src/merge.cpp`), for tensors on the CPU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import ROTATION_NOISE, CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.core.gradients import CONFLICT_GROUPS
from clear_strategies.kernels import native
from clear_strategies.kernels.merge.interface import FIRST_BANDS, Colour, Merged, Rows
from rasterizers.native import threads

GROUPS: Final = {name: k for k, name in enumerate((*CONFLICT_GROUPS, "detail"))}


def merge(
    attributes: Mapping[str, Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
    lr_colour: Colour | None = None, colour: Colour | None = None,
    keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
) -> Merged:  # fmt: skip
    """See `kernels.merge.Merge`."""
    n, kept = len(next(iter(attributes.values())).out), []

    def address(x: Tensor | None, numbers: int) -> int:
        """Of the tensor's numbers, or of a contiguous copy's; the kernel takes no other."""
        if x is None:
            return 0
        if x.dtype != torch.float32 or x.device.type != "cpu" or x.numel() != n * numbers:
            raise ValueError(
                f"the merge takes float32 [{n}, …] of {numbers} numbers a row on the CPU, got {x.dtype} {list(x.shape)}."
            )
        kept.append(x.contiguous())
        return kept[-1].data_ptr()

    def factors(colour: Colour | None) -> tuple[int, int, int]:
        if colour is None:
            return 0, 0, 1
        bases = colour.basis.shape[1]
        return address(colour.rgb, 3), address(colour.basis, bases), bases

    tuples = []
    for name, rows in attributes.items():
        width, first_band = rows.out.shape[1:].numel(), FIRST_BANDS.get(name, -1)
        if not rows.out.is_contiguous():
            raise ValueError(f"the merged gradient of {name} must be contiguous, got strides {rows.out.stride()}.")
        tensors = (rows.out, rows.lr, rows.before, rows.hr, rows.p, rows.anchor)
        tuples.append((*(address(x, width) for x in tensors), rows.stiffness, width, GROUPS[name], first_band))
    kernels: Any = native.module()
    counts, finite = kernels.merge(
        n, tuples, factors(lr_colour), factors(colour), correction_table(rule, q), keeps_lr, lambda_hr, scale, threads()
    )
    return Merged(ConflictCounts(*counts), finite)


def correction_table(rule: CorrectionRule | None, q: Float[Tensor, " N"] | None) -> dict[str, Any] | None:
    """The rule as the kernels take it."""
    if rule is None:
        return None
    return {
        "groups": rule.corrects, "tolerance": rule.tolerance, "weight_min": rule.weight_min, "weight_max": rule.weight_max,
        "rotation_noise": ROTATION_NOISE, "reliability": None if q is None else q.float().contiguous(),
    }  # fmt: skip
