"""The merge for trainers with an optimizer of their own: the merged gradients replace `.grad`, in place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import is_finite, require_finite
from clear_strategies.core.gradients import Colour, Grads
from clear_strategies.core.step import Step
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Merged
from rasterizers.native import empty_for

_HALF: Final = (torch.float16, torch.bfloat16)  # merged in float32; float64 is not


def merge_in_place(
    conductor: Conductor,
    params: Mapping[str, Tensor],
    g_hr: Grads | None,
    step: Step | None,
    t: int,
    *,
    before: Mapping[str, Tensor],
    lr_colour: Colour | None = None,
    scale: float = 1.0,
    must_be_finite: bool = True,
    merge: Callable[..., Merged] | None = None,
) -> Mapping[str, Number]:
    """Turn `.grad` of the parameters, before + scale · ∇(λ_LR L_LR), into before + scale · the merged gradient.

    Args:
        params: the leaves by gsplat's names; those without `.grad`, except for "detail", are frozen and stay so.
        g_hr: g^HR of the raw parameters after routing, and the gradient of f_det; None: without HR.  Eq. 12, 13
        step: the iteration, with the evidence; None without HR.
        before: `.grad` at the beginning of the backward pass, by name, for parameters that had one.
        lr_colour: the gradient of sh0 and shN that the pass has brought as factors, which their `.grad` lacks.
        scale: of the loss: an AMP gradient scaler's, or 1 / the number of accumulated passes.
        merge: replaces `Conductor.merge_routed`.

    Returns:
        The conflict ratios by group, before correction; {} without HR.

    Raises:
        DivergedError: a merged gradient in the CPU's memory is not finite. Not with `must_be_finite=False`, for a trainer with an
            AMP gradient scaler, which skips such a step.
    """
    factored = ("detail",) if lr_colour is None else ("detail", "sh0", "shN")
    trained = {name: p for name, p in params.items() if p.grad is not None or name in factored}
    if lr_colour is not None and scale != 1:
        lr_colour = Colour(lr_colour.rgb * (1 / scale), lr_colour.basis)
    g_lr, out = Grads(colour=lr_colour), {}
    for name, p in trained.items():
        g = None if p.grad is None or name == "detail" else _widened(p.grad.detach())
        if g is not None and name in before:
            g = g - before[name]
        if g is not None and scale != 1:
            g = g * (1 / scale)
        if g is not None:
            g_lr[name] = g
        out[name] = g if g is not None and g.is_contiguous() else empty_for(_widened(p.detach()))
    high = Grads() if g_hr is None else Grads({name: _widened(g) for name, g in g_hr.items()}, colour=g_hr.colour)
    values = {name: p.detach() for name, p in trained.items()}
    merged = (merge or conductor.merge_routed)(values, g_lr, high, step, t, out)
    if must_be_finite and not isinstance(merged.finite, Tensor) and not merged.finite:
        by_host = all(map(is_finite, [*high.values(), *(high.colour or ())]))
        hint = " (that of HR is finite: look at the loop's own loss)" if by_host else ""
        remedy = "If the loop skips such steps, attach with loss_scale=lambda: 1.0."
        require_finite(f"t={t}: the merged gradient{hint}", merged.grads, remedy=remedy)
    for name, p in trained.items():
        g = out[name] if scale == 1 else out[name].mul_(scale)
        _set_grad(p, g.add_(before[name]) if name in before else g)
    return merged.conflict


def _widened(x: Tensor) -> Tensor:
    return x.float() if x.dtype in _HALF else x


def _set_grad(p: Tensor, gradient: Tensor) -> None:
    """Set `.grad` of a parameter, in the memory of its present `.grad` if it has one."""
    if p.grad is None:
        p.grad = gradient.to(p.dtype)
    elif p.grad.data_ptr() != gradient.data_ptr() or p.grad.dtype != gradient.dtype:
        p.grad.copy_(gradient)
