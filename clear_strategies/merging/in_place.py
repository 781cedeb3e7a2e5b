"""The merge for trainers that have their own optimizer: their gradients become the merged ones, in place.

One compiled pass over the Gaussians where the strategies state their arithmetic as data (`CorrectionRule`, `Anchor`), and
`Conductor.merge` where they do not, or where nothing is compiled for the gradients' type and device. Both give the same within
rounding; tests/merging/test_in_place.py compares them.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import Anchor, CorrectionRule
from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import require_finite
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.core.step import Step
from clear_strategies.kernels import merge as kernel
from clear_strategies.kernels.merge import Colour, Rows
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.base import not_stated_as_data

_log = logging.getLogger(__name__)
_HALF: Final = (torch.float16, torch.bfloat16)  # merged in float32; float64 is not


@dataclass(frozen=True, slots=True, eq=False)
class RoutedGradients:
    """g^HR of one view after routing, of the raw parameters.  Eq. 12, 13

    Args:
        grads: by attribute, without f_det, and without sh0 and shN where `colour` has them.
        colour: the gradient of sh0 and shN as its factors, for shN of as many bands as the basis has, or more.
        detail: m λ_HF ∇L_HF of f_det; None: there is no f_det, or no L_HF.
        step: the iteration, with the evidence.
    """

    grads: Mapping[str, Tensor]
    step: Step
    colour: Colour | None = None
    detail: Float[Tensor, "N 3"] | None = None


def dense(grads: Mapping[str, Tensor], colour: Colour | None, like: Mapping[str, Tensor]) -> Grads:
    """The same with every number of the spherical harmonics, in the shapes of `like` and for its attributes alone."""
    g = Grads(grads)
    if colour is not None and (merge := kernel.compiled((colour.rgb, like["sh0"], like["shN"]))) is not None:
        bands = {name: Rows(kernel.empty_like(like[name])) for name in ("sh0", "shN")}
        merge(bands, None, None, lr_colour=colour, lambda_hr=0.0)
        g |= {name: rows.out for name, rows in bands.items()}
    elif colour is not None:
        rgb, Y, n_bands = colour.rgb[:, None], colour.basis[..., None], like["shN"].shape[1]
        g["sh0"], shN = Y[:, :1] * rgb, Y[:, 1:] * rgb  # contiguous each, since optimizers read them
        inactive = n_bands - shN.shape[1]
        g["shN"] = torch.nn.functional.pad(shN, (0, 0, 0, inactive)) if inactive else shN
    return Grads({name: value.reshape(like[name].shape) for name, value in g.items() if name in like})


class InPlaceMerge:
    """Merges in place for one conductor.

    Attributes:
        compiled: whether the strategies allow the compiled pass; the reason is logged where they do not.
    """

    def __init__(self, conductor: Conductor) -> None:
        self.conductor = conductor
        reason = next(_why_not(conductor), None)
        if reason is not None:
            _log.info("The merge takes the readable path, which is several times slower: %s.", reason)
        self.compiled = reason is None
        corrector = conductor.owner("correct")
        self._rule: CorrectionRule | None = None if corrector is None else corrector.correction_rule()
        self._regularizers = conductor.regularizers

    def __call__(
        self,
        params: Mapping[str, Tensor],
        hr: RoutedGradients | None,
        t: int,
        *,
        before: Mapping[str, Tensor],
        lr_colour: Colour | None = None,
        scale: float = 1.0,
        must_be_finite: bool = True,
    ) -> Mapping[str, Number]:
        """Turn `.grad` of the parameters, before + scale · ∇(λ_LR L_LR), into before + scale · the merged gradient.

        Args:
            params: the leaves by gsplat's names; those without `.grad` are frozen and stay so, but for "detail".
            before: `.grad` as it was when the backward pass began, by name, where it was there.
            lr_colour: what `.grad` of sh0 and shN lacks of this pass, where `takes_factors`.
            scale: of the loss: an AMP gradient scaler's, or 1 / the number of accumulated passes.

        Returns:
            The conflict ratios by group, before correction; {} without HR.

        Raises:
            DivergedError: a merged gradient in the CPU's memory is not finite, and `must_be_finite`: False for a trainer with an
                AMP gradient scaler, which skips such a step.
        """
        factored = ("detail",) if lr_colour is None else ("detail", "sh0", "shN")
        trained = {name: p for name, p in params.items() if p.grad is not None or name in factored}
        whole = [p for p in trained.values() if p.dtype not in _HALF]
        merge = kernel.compiled(whole) if self.compiled and whole else None
        if merge is None:
            return self._merge_readably(trained, hr, t, before, scale)
        λ = 0.0 if hr is None else self.conductor.objective.lambda_hr(t)
        anchor = self._anchor(len(next(iter(trained.values()))))
        rows = {name: self._rows(name, p, hr, before.get(name), anchor) for name, p in trained.items()}
        rule = self._rule if λ > 0 else None
        evidence = None if hr is None else hr.step.evidence
        counts, finite = merge(
            rows, rule, None if evidence is None else evidence.reliability, lr_colour=lr_colour,
            colour=None if hr is None else hr.colour, lambda_hr=λ, scale=scale,
        )  # fmt: skip
        for name, p in trained.items():
            _give(p, rows[name].out)
        if must_be_finite and not finite and isinstance(finite, bool):
            require_finite(f"t={t}: the merged gradient", {name: row.out for name, row in rows.items()})
        if λ == 0:
            return {}
        groups = [group for group in CONFLICT_GROUPS if group in trained]
        if rule is not None:
            rule.report(counts, groups, evidence is not None)
        return counts.ratios(groups)

    def takes_factors(self, params: Mapping[str, Tensor]) -> bool:
        """Whether the gradient of the colours may come by its factors: whether these parameters take the compiled pass."""
        return self.compiled and kernel.compiled(params.values()) is not None

    def _rows(self, name: str, p: Tensor, hr: RoutedGradients | None, before: Tensor | None, anchor: Anchor) -> Rows:
        lr = None if p.grad is None or name == "detail" else p.grad.detach().float().contiguous()
        g_hr = None if hr is None else hr.detail if name == "detail" else hr.grads.get(name)
        target = anchor.targets.get(name)
        return Rows(
            kernel.empty_like(p) if lr is None else lr,
            lr,
            None if before is None else before.float().contiguous(),
            None if g_hr is None else g_hr.float().contiguous(),
            None if target is None else p.detach().float().contiguous(),
            target,
            anchor.stiffness.get(name, 0.0),
        )

    def _anchor(self, n: int) -> Anchor:
        anchor = self._regularizers[0].anchor(n) if self._regularizers else None
        if self._regularizers and anchor is None:
            self.conductor.work_log.skip("regularize", "no anchor yet")
        return anchor or Anchor({}, {})

    def _merge_readably(
        self, trained: Mapping[str, Tensor], hr: RoutedGradients | None, t: int, before: Mapping[str, Tensor], scale: float
    ) -> Mapping[str, Number]:  # fmt: skip
        g_lr = Grads()
        for name, p in trained.items():
            if p.grad is not None and name != "detail":
                new = p.grad - before[name] if name in before else p.grad
                g_lr[name] = new if scale == 1 else new * (1 / scale)
        values = {name: p.detach() for name, p in trained.items()}
        if hr is None:
            merged = self.conductor.merge(values, g_lr, None, t)
        else:
            g_hr = dense(hr.grads, hr.colour, trained)
            merged = self.conductor.merge_routed(values, g_lr, g_hr, hr.detail, hr.step, t)
        for name, p in trained.items():
            # Without HR the gradient of f_det is 0 and not None, so that its Adam counts every step.
            g = merged.grads[name] if name in merged.grads else torch.zeros_like(p)
            g = g if scale == 1 else g * scale
            _give(p, g + before[name] if name in before else g)
        return merged.conflict


def _why_not(conductor: Conductor) -> Iterator[str]:
    yield from not_stated_as_data(conductor.strategies)
    if type(conductor) is not Conductor:
        yield f"{type(conductor).__name__} may merge in another way than Conductor"


def _give(p: Tensor, gradient: Tensor) -> None:
    """Make a gradient that of a parameter, in the tensor that holds it already where there is one."""
    if p.grad is None:
        p.grad = gradient.to(p.dtype)
    elif p.grad.data_ptr() != gradient.data_ptr() or p.grad.dtype != gradient.dtype:
        p.grad.copy_(gradient)
