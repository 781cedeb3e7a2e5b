"""The merge and the optimizer's step in two compiled passes over the Gaussians, with the weights of the strategies between them.

The passes compute the same as `Conductor.merge`, `Activation.vjp`, `Adam.step` and `GaussianField.constrain`, which remain the
specification: tests/training/test_compiled_step.py compares the two. Here the products of the higher bands are rounded less, so a
strategy may decide differently for a Gaussian within 2e-7 of a bound, and two trainings then drift apart as two seeds do. Every
hook of the strategies is called as by the readable path.

C++ runs for Gaussians in the CPU's memory, Warp for Gaussians on CUDA. On CUDA the host never waits: counts, and numbers
computed from them, stay on the device (`core.deferred`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Final, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.conflicts import Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import Colour, Grads
from clear_strategies.kernels import gaussian_step as kernel
from clear_strategies.kernels import native
from clear_strategies.kernels.gaussian_step import cpp
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import HrSide, LossWeights
from clear_strategies.training.field import LOG_SCALE_LIMIT, LOGIT_LIMIT, Activation, FieldShot
from clear_strategies.training.optim import BETA1, BETA2, Adam
from rasterizers.interface import BackendUnavailable
from rasterizers.modes import apart_from_the_loop
from rasterizers.recording import running
from rasterizers.warp_runtime import require_warp

_log = logging.getLogger(__name__)

FusedMode = Literal["auto", "off"]

GaussianPass = Callable[..., kernel.GaussianStep]
"""`gaussian_step.cpp.CppGaussianStep`, or another class of its signature."""

_LIMITS: Final = {"opacities": LOGIT_LIMIT, "scales": LOG_SCALE_LIMIT}


def compiled_step_for(conductor: Conductor, optimizer: Adam, mode: FusedMode = "auto") -> CompiledStep | None:
    """The compiled step for this conductor and optimizer; None if there is none, and a log line with the reason."""
    reason = next(_why_not(conductor, optimizer, mode), None)
    if reason is None:
        return CompiledStep(conductor, optimizer)
    _log.info("The per-Gaussian step takes the readable path, which is several times slower: %s.", reason)
    return None


def _why_not(conductor: Conductor, optimizer: Adam, mode: FusedMode) -> Iterator[str]:
    if mode == "off":
        yield "fit.fused=off"
    for instance, base in ((conductor, Conductor), (optimizer, Adam)):
        if type(instance) is not base:
            yield f"{type(instance).__name__} may compute something else than {base.__name__}"
    if not all(s.shares_gate for s in conductor.strategies):
        yield "a mask for each scale makes two activations of the field"
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


class CompiledStep:
    """Merges as `Conductor.merge` does, steps as `Adam.step` does, and constrains the parameters, in one pass.

    It skips rows whose gradient and both moments are 0, and bands of the spherical harmonics above the active degree.

    Args:
        skips: False visits every row; the result has the same bits.
        passes: the passes' implementation; None: that for the device of the optimizer's moments.

    Attributes:
        recordable: whether a step can be part of a recording.
        bands: how many bands of shN the last step could change, the lowest ones.
    """

    def __init__(
        self, conductor: Conductor, optimizer: Adam, *, skips: bool = True, passes: GaussianPass | None = None
    ) -> None:
        self.conductor, self.optimizer, self.skips = conductor, optimizer, skips
        self._passes = gaussian_pass(optimizer) if passes is None else passes
        self.recordable = getattr(self._passes, "recordable", False)
        self._numbers: Tensor | None = None  # on the device: `count` writes them before each replay of a recording
        self.bands, self._restored = 0, -1  # see `_find_bands`; `Adam.restored`, then

    @apart_from_the_loop
    def step(
        self, params: Mapping[str, Tensor], shot: FieldShot, g_lr: Grads, hr: HrSide | None, t: int
    ) -> Mapping[str, Number]:
        """Step `params` and the optimizer's moments in place; returns the conflict ratios by group.

        Args:
            shot: one of the renderings that the gradients are of, by `FieldShot.gradients`.
        """
        gaussians, λ = self._gaussians(shot.activation, g_lr, hr), self.conductor.objective.lambda_hr(t)
        products = gaussians.products() if hr is not None and λ > 0 else None
        both = partial(_both_dense, shot.activation, g_lr, Grads() if hr is None else hr.g)
        step = None if hr is None else hr.step
        weights, plus, conflict = self.conductor.answers(products, both, params, step, t, finite=True)  # Eq. 6, 7, 11
        decays = (hr is not None and hr.detail is not None) or "detail" in plus
        self._apply(gaussians, params, g_lr, t, weights, plus, decays=decays)
        return conflict

    def count(self, t: int) -> None:
        """Count a step that is recorded or replayed, and write its numbers to the device."""
        from clear_strategies.kernels.gaussian_step.warp import written

        rates, bias2 = self.optimizer.advance()
        device, (_, λ_hf) = self.optimizer.first["means"].device, self.conductor.objective.weights(t)
        self._numbers = written(self._settings(t, bias2), rates, device, lambda_hf=λ_hf, out=self._numbers)

    def weights(self, t: int) -> LossWeights:
        """λ_HR(t) and λ_HR(t) λ_HF; on the device in a recording."""
        if running() is None or self._numbers is None:
            return self.conductor.objective.weights(t)
        from clear_strategies.kernels.gaussian_step.warp import loss_weights

        return loss_weights(self._numbers)

    def step_extra(self, params: Mapping[str, Tensor], shot: FieldShot, g_lr: Grads, t: int) -> None:
        """Step on this gradient alone: nothing is regularized."""
        self._apply(self._gaussians(shot.activation, g_lr, None), params, g_lr, t, Weights(), Grads(), decays=False)

    def _apply(
        self,
        gaussians: kernel.GaussianStep,
        params: Mapping[str, Tensor],
        g_lr: Grads,
        t: int,
        weights: Weights | Grads,
        plus: Grads,
        *,
        decays: bool,
    ) -> None:
        """Merge and step.

        Args:
            weights: or ĝ_HR, if a strategy overrides `correct`. decays: f_det decays.
        """
        weights, corrected = (weights, Grads()) if isinstance(weights, Weights) else (Weights(keep=0.0), weights)
        numbers = None if running() is None else self._numbers
        rates, bias2 = self.optimizer.advance() if numbers is None else ({}, 1.0)
        keep = 1 - self.optimizer.rates.detail_decay if decays else 1.0
        attributes = {
            name: kernel.Attribute(
                p, self.optimizer.first[name], self.optimizer.second[name], rates.get(name, 0.0),
                _rows_like(p, corrected.get(name)), _rows_like(p, plus.get(name)), keep if name == "detail" else 1.0,
                _LIMITS.get(name, float("inf")),
            )
            for name, p in params.items()
        }  # fmt: skip
        all_bands, active = params["shN"].shape[1], _basis(g_lr).shape[1] - 1
        moved = "shN" in plus or "shN" in corrected
        self._find_bands(active, moved=moved)
        settings = self._settings(t, bias2, self.skips, 3 * self.bands, numbers)
        unchanged = gaussians.step(attributes, weights, settings)
        skip = self.conductor.work_log.skip
        if isinstance(unchanged, Tensor) or unchanged:  # a number on the device is not read here
            skip("optimizer rows", "gradient and moments are 0", unchanged)
        if self.bands < all_bands:
            skip("SH bands in the optimizer", "above the active degree", all_bands - self.bands)

    def _gaussians(self, a: Activation, g_lr: Grads, hr: HrSide | None) -> kernel.GaussianStep:
        """The passes over the gradients of one view."""
        activation = {
            "scales": a.scales, "filtered": a.filtered, "filter": a.filter_3d, "sigmoid": a.sigmoid,
            "factor": a.factor.contiguous(), "basis": _basis(g_lr, None if hr is None else hr.g),
        }  # fmt: skip
        return self._passes(activation, g_lr.tensors, None if hr is None else hr.routed.tensors)

    def _settings(
        self, t: int, bias2: float, skips: bool = False, width: int = 0, changing: Tensor | None = None
    ) -> kernel.StepSettings:
        λ = self.conductor.objective.lambda_hr(t)
        return kernel.StepSettings(BETA1, BETA2, bias2, self.optimizer.rates.eps, λ, skips, width, changing)

    def _find_bands(self, active: int, *, moved: bool) -> None:
        """Set `bands`: up to the highest that may have a gradient or momentum.

        The moments are read once, and again where a checkpoint has restored them. After that, only a step gives a band momentum.

        Args:
            moved: a strategy gives all of them a gradient.
        """
        first, second = (moments["shN"] for moments in (self.optimizer.first, self.optimizer.second))
        all_bands = first.shape[1]
        if moved or not self.skips:
            self.bands = all_bands
        elif self._restored != self.optimizer.restored:
            has_momentum = ((first != 0) | (second != 0)).any(2).any(0).tolist()
            self.bands = max((k + 1 for k in range(all_bands) if has_momentum[k]), default=0)
        self._restored, self.bands = self.optimizer.restored, max(self.bands, active)


def _basis(g_lr: Grads, g_hr: Grads | None = None) -> Float[Tensor, "N B1"]:
    """Y of a view, the same at both scales. Some rasterizers leave out the rows of Gaussians that a scale does not draw."""
    low, high = (None if g is None else g.colour for g in (g_lr, g_hr))
    if low is None:
        raise ValueError("the gradient of the colours must be given by its factors.")
    if high is None or high.basis is low.basis:
        return low.basis
    return torch.where((low.rgb != 0).any(1, keepdim=True), low.basis, high.basis)


def _both_dense(a: Activation, g_lr: Grads, g_hr: Grads) -> tuple[Grads, Grads]:
    """g_LR and g^HR in full, for strategies that override `correct`."""
    basis = _basis(g_lr, g_hr)
    low, high = (a.vjp(Grads(g, colour=Colour(g.tensors["rgb"], basis))) for g in (g_lr, g_hr))
    return low, high


def _rows_like(p: Tensor, g: Tensor | None) -> Tensor | None:
    """A strategy's gradient, in the type, device and layout that the passes take."""
    return None if g is None else g.to(p).reshape(p.shape).contiguous()
