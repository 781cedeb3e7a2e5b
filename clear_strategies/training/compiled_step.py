"""The merge and the optimizer's step in one compiled pass over the Gaussians.

The pass computes what `Conductor.merge`, `Activation.vjp`, `Adam.step` and `GaussianField.constrain` compute; these remain
the specification, and tests/training/test_compiled_step.py compares the two. The products of the higher bands are rounded
less here, so a Gaussian whose cosine lies within 2e-7 of -τ_c may be corrected in one path and not in the other; two trainings
then drift apart as two seeds do. Strategies state their `correct` and `regularize` as data (`CorrectionRule`, `Anchor`); all
their other hooks are called as in the readable path.

C++ runs for Gaussians in the CPU's memory, Warp for Gaussians on CUDA. On CUDA the host never waits: counts stay on the
device, and so do the numbers made of them (`core.deferred`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import Anchor, CorrectionRule
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels import gaussian_step as kernel
from clear_strategies.kernels import native
from clear_strategies.kernels.gaussian_step import cpp
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import HrGradients, Weights
from clear_strategies.strategies.base import Strategy, not_stated_as_data, overrides
from clear_strategies.training.field import LOG_SCALE_LIMIT, LOGIT_LIMIT, Activation, FieldShot
from clear_strategies.training.optim import BETA1, BETA2, Adam
from rasterizers.interface import BackendUnavailable, SplatGradients
from rasterizers.recording import running
from rasterizers.warp_runtime import require_warp

_log = logging.getLogger(__name__)

FusedMode = Literal["auto", "off"]

GaussianPass = Callable[..., kernel.GaussianStep]
"""`gaussian_step.cpp.CppGaussianStep`, or another class of its signature."""

_ROWS: Final = ("means", "quats", "scales", "opacities", "rgb")
_LIMITS: Final = {"opacities": LOGIT_LIMIT, "scales": LOG_SCALE_LIMIT}


def compiled_step_for(conductor: Conductor, optimizer: Adam, mode: FusedMode = "auto") -> CompiledStep | None:
    """The compiled step for this conductor and optimizer; None, and a log line with the reason, where there is none."""
    reason = next(_why_not(conductor, optimizer, mode), None)
    if reason is None:
        return CompiledStep(conductor, optimizer)
    _log.info("The per-Gaussian step takes the readable path, which is several times slower: %s.", reason)
    return None


def _why_not(conductor: Conductor, optimizer: Adam, mode: FusedMode) -> Iterator[str]:
    if mode == "off":
        yield "fit.fused=off"
    yield from not_stated_as_data(conductor.strategies)
    for thing, base in ((conductor, Conductor), (optimizer, Adam)):
        if type(thing) is not base:
            yield f"{type(thing).__name__} may compute something else than {base.__name__}"
    for name, moments in optimizer.first.items():
        if moments.device.type not in ("cpu", "cuda") or moments.dtype != torch.float32:
            yield f"{name} is {moments.dtype} on {moments.device}, not float32 on the CPU or on CUDA"
    try:
        gaussian_pass(optimizer)
    except BackendUnavailable as error:
        yield str(error).rstrip(".")


def gaussian_pass(optimizer: Adam) -> GaussianPass:
    """The pass for the device of the optimizer's moments."""
    device = optimizer.first["means"].device.type
    if device == "cpu":
        native.module()
        return cpp.CppGaussianStep
    require_warp("the compiled pass", device, "it runs in C++ for a field in the CPU's memory")
    from clear_strategies.kernels.gaussian_step import warp

    return warp.WarpGaussianStep


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """One cotangent's gradient with respect to the drawn splats.

    Args:
        rows: by attribute, colour as its rank-one factors "rgb" and "basis".
    """

    rows: Mapping[str, Tensor]
    screen: Float[Tensor, "N 2"]
    activation: Activation

    @classmethod
    def of(cls, g: SplatGradients, activation: Activation) -> list[Factors]:
        """One for each cotangent."""
        basis = g.basis.contiguous()
        each = zip(*(x.unbind() for x in (g.means, g.quats, g.scales, g.opacities, g.rgb, g.screen)), strict=True)
        return [
            cls(
                {**{name: x.contiguous() for name, x in zip(_ROWS, rows, strict=True)}, "basis": basis},
                screen,
                activation,
            )
            for *rows, screen in each
        ]

    def table(self) -> Mapping[str, Tensor]:
        return self.rows


class CompiledStep:
    """A `Stepper`: merges as `Conductor.merge` does, steps as `Adam.step` does, and constrains the parameters.

    A row stays as it is where its gradient, both moments and the anchor's pull are 0, and so do bands of the spherical
    harmonics above the active degree.

    Args:
        skips: for tests: False visits every row. The result has the same bits.
        passes: what computes; None: what runs on the device of the optimizer's moments.
    """

    stage: Final = "per-Gaussian pass"

    def __init__(
        self, conductor: Conductor, optimizer: Adam, *, skips: bool = True, passes: GaussianPass | None = None
    ) -> None:
        self.conductor, self.optimizer, self.skips = conductor, optimizer, skips
        self._passes = gaussian_pass(optimizer) if passes is None else passes
        corrector = conductor.owner("correct")
        self._rule: CorrectionRule | None = None if corrector is None else corrector.correction_rule()
        self._regularizer: Strategy | None = next((s for s in conductor.strategies if overrides(s, "regularize")), None)
        self._changing: Tensor | None = None  # the numbers of the step on the device, of a recording
        self._examined: dict[bool, tuple[int, Sequence[Tensor | None], bool]] = {}  # by whether there is an anchor

    @property
    def records(self) -> bool:
        """Whether a step can be part of a recording."""
        return getattr(self._passes, "records", False)

    def vjp(self, shot: FieldShot, cotangents: Float[Tensor, "K H W 3"]) -> list[Factors]:
        return Factors.of(shot.gradients(cotangents), shot.activation)

    def step(
        self, params: Mapping[str, Tensor], g_lr: Factors, hr: HrGradients[Factors] | None, t: int
    ) -> Mapping[str, Number]:
        """Step `params` and the optimizer's moments in place; returns the conflict ratios by group."""
        return self._run(params, g_lr, hr, t, *self._advance())

    def count(self, t: int) -> None:
        """Count a step that is recorded or replayed, and write its numbers."""
        from clear_strategies.kernels.gaussian_step.warp import written

        rates, bias2 = self.optimizer.advance()
        device, (_, λ_hf) = self.optimizer.first["means"].device, self.conductor.objective.weights(t)
        self._changing = written(self._settings(t, bias2), rates, device, lambda_hf=λ_hf, out=self._changing)

    def weights(self, t: int) -> Weights:
        """λ_HR(t) and λ_HR(t) λ_HF; of a recording on the device."""
        if running() is not None and self._changing is not None:
            return self._changing[0, -2:]
        return self.conductor.objective.weights(t)

    def step_extra(self, params: Mapping[str, Tensor], g_lr: Factors, t: int) -> None:
        """Step on this gradient alone: no anchor pulls."""
        self._run(params, g_lr, None, t, *self._advance(), anchor=Anchor({}, {}))

    def gradient(
        self, params: Mapping[str, Tensor], g_lr: Factors, hr: HrGradients[Factors] | None, t: int
    ) -> tuple[Grads, Mapping[str, Number]]:
        """For tests: the dense gradient that `step` uses, and the conflict ratios; nothing moves."""
        merged = Grads({name: torch.zeros_like(p) for name, p in params.items()})
        return merged, self._run(params, g_lr, hr, t, dict.fromkeys(params, 0.0), 1.0, merged)

    def _run(
        self,
        params: Mapping[str, Tensor],
        g_lr: Factors,
        hr: HrGradients[Factors] | None,
        t: int,
        rates: Mapping[str, float],
        bias2: float,
        merged: Grads | None = None,
        anchor: Anchor | None = None,
    ) -> Mapping[str, Number]:
        """
        Args:
            merged: receives the dense gradient; nothing is left out. anchor: in place of the strategies' own.
        """
        gaussians, λ = self._gaussians(g_lr, hr), self.conductor.objective.lambda_hr(t)
        compares = hr is not None and λ > 0
        rule = self._rule if compares else None
        anchor = self._anchor(len(params["means"])) if anchor is None else anchor
        decays = (hr is not None and hr.hf is not None) or "detail" in anchor.targets
        keep = 1 - self.optimizer.rates.detail_decay if decays else 1.0
        attributes = {
            name: kernel.Attribute(
                p, self.optimizer.first[name], self.optimizer.second[name], rates.get(name, 0.0), anchor.targets.get(name),
                anchor.stiffness.get(name, 0.0), keep if name == "detail" else 1.0, _LIMITS.get(name, float("inf")),
                None if merged is None else merged[name],
            )
            for name, p in params.items()
        }  # fmt: skip
        skips = self.skips and merged is None
        shN, active = params["shN"], g_lr.rows["basis"].shape[1] - 1
        bands = active if skips and self._above_is_quiet(shN, active, anchor.targets.get("shN")) else shN.shape[1]
        evidence = None if hr is None else hr.step.evidence
        q = None if evidence is None else evidence.reliability.float().contiguous()
        settings = self._settings(t, bias2, skips, 3 * bands, self._changing if running() is not None else None)
        stepped = gaussians.step(attributes, rule, q, settings)
        if rule is not None:
            rule.report(stepped.conflicts, CONFLICT_GROUPS, evidence is not None)
        if merged is None:
            self._note_skips(stepped, bands, shN.shape[1])
        return stepped.conflicts.ratios(CONFLICT_GROUPS) if compares else {}

    def _gaussians(self, g_lr: Factors, hr: HrGradients[Factors] | None) -> kernel.GaussianStep:
        """The pass over the gradients of one view."""
        a, m = g_lr.activation, None if hr is None else hr.m
        activation = {
            "scales": a.scales, "filtered": a.filtered, "filter": a.filter_3d, "sigmoid": a.sigmoid,
            "factor": a.factor.contiguous(), "route": m.float().contiguous() if isinstance(m, Tensor) else None,
        }  # fmt: skip
        base, hf = (None, None) if hr is None else (hr.base.rows, None if hr.hf is None else hr.hf.rows)
        return self._passes(activation, g_lr.rows, base, hf, self.conductor.objective.lambda_hf)

    def _advance(self) -> tuple[Mapping[str, float], float]:
        """As of `Adam.advance`. Of a recording, `count` has written the numbers."""
        return ({}, 1.0) if running() is not None else self.optimizer.advance()

    def _settings(
        self, t: int, bias2: float, skips: bool = False, width: int = 0, changing: Tensor | None = None
    ) -> kernel.StepSettings:
        λ = self.conductor.objective.lambda_hr(t)
        return kernel.StepSettings(BETA1, BETA2, bias2, self.optimizer.rates.eps, λ, skips, width, changing)

    def _anchor(self, n: int) -> Anchor:
        if self._regularizer is None:
            return Anchor({}, {})
        anchor = self._regularizer.anchor(n)
        if anchor is None:
            self.conductor.work_log.skip("regularize", "no anchor yet")
            return Anchor({}, {})
        return anchor

    def _above_is_quiet(self, shN: Tensor, active: int, anchor: Tensor | None) -> bool:
        """Whether bands above the active degree have no momentum and no pull.

        Recomputed when a tensor has been replaced (densification, resuming, the anchor). While the tensors are the same the
        result holds: a pass that skips the bands leaves them quiet, and momentum does not vanish.
        """
        tensors = (self.optimizer.first["shN"], self.optimizer.second["shN"], anchor)
        anchored = anchor is not None
        if anchored in self._examined:
            examined_at, same, quiet = self._examined[anchored]
            known = examined_at <= active if quiet else examined_at == active
            if known and all(a is b for a, b in zip(same, tensors, strict=True)):
                return quiet
        moved = any(bool(moments[:, active:].any()) for moments in tensors[:2] if moments is not None)
        pulled = anchor is not None and not torch.equal(anchor[:, active:], shN[:, active:])
        quiet = not (moved or pulled)
        if not quiet:  # this pass moves the bands, and so the other kind of pass has to look again
            self._examined = {key: entry for key, entry in self._examined.items() if not entry[2]}
        self._examined[anchored] = active, tensors, quiet
        return quiet

    def _note_skips(self, stepped: kernel.StepCounts, bands: int, all_bands: int) -> None:
        skip = self.conductor.work_log.skip
        if isinstance(stepped.still, Tensor) or stepped.still:  # a number on the device is not read here
            skip("optimizer rows", "gradient, moments and anchor's pull are 0", stepped.still)
        if bands < all_bands:
            skip("SH bands in the optimizer", "above the active degree", all_bands - bands)
