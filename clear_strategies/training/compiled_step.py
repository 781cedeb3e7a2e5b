"""Floor 4: the conductor's merge and the optimizer's step in one compiled pass over the Gaussians.

`Conductor.merge`, `GCO.correct`, `SVS.regularize`, `Activation.vjp`, `Adam.step` and `GaussianField.constrain` are what
it computes; they remain the source of truth, and `tests/training/test_compiled_step.py` holds the two side by
side. What the strategies say in a few numbers per Gaussian (gate, observe, route, score) is asked of them as always.

C++ sweeps over Gaussians in the CPU's memory, Warp over those on CUDA. There nothing is waited for: what was counted stays
on the device, and so do the numbers that are made of it (`late`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads
from clear_strategies.kernels import gaussian_step as kernel
from clear_strategies.kernels.gaussian_step import cpp
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.gco import ROTATION_NOISE, Correction
from clear_strategies.training.field import LOG_SCALE_LIMIT, LOGIT_LIMIT, Activation, FieldShot
from clear_strategies.training.optim import BETA1, BETA2, Adam
from rasterizers.interface import BackendUnavailable, SplatGradients
from rasterizers.native import load_kernels
from rasterizers.warp_runtime import require_warp

_log = logging.getLogger(__name__)

FusedMode = Literal["auto", "every_row", "off"]

GaussianPass = Callable[..., kernel.GaussianStep]
"""`gaussian_step.cpp.CppGaussianStep`, or another class of its signature."""

_KNOWN: Final = ("gco", "p2g", "svs")
_LIMITS: Final = {"opacities": LOGIT_LIMIT, "scales": LOG_SCALE_LIMIT}


def compiled_step_for(conductor: Conductor, optimizer: Adam, mode: FusedMode = "auto") -> CompiledStep | None:
    """The compiled pass for this conductor and optimizer; None, and one line that says why, where there is none."""
    reason = _why_not(conductor, optimizer, mode)
    if reason is None:
        return CompiledStep(conductor, optimizer, skips=mode == "auto")
    _log.info("The per-Gaussian pass takes the readable path: %s.", reason)
    return None


def _why_not(conductor: Conductor, optimizer: Adam, mode: FusedMode) -> str | None:
    if mode == "off":
        return "fit.fused=off"
    for s in conductor.strategies:
        if type(s).fused not in _KNOWN:
            return f"{type(s).__name__} has no compiled arithmetic"
    for thing, base in ((conductor, Conductor), (optimizer, Adam)):
        if type(thing) is not base:
            return f"{type(thing).__name__} may do something else than {base.__name__}"
    for name, moments in optimizer.first.items():
        if moments.device.type not in ("cpu", "cuda") or moments.dtype != torch.float32:
            return f"{name} is {moments.dtype} on {moments.device}, not float32 on the CPU or on CUDA"
    try:
        gaussian_pass(optimizer)
    except BackendUnavailable as error:
        return str(error).rstrip(".")
    return None


def gaussian_pass(optimizer: Adam) -> GaussianPass:
    """The pass for where the optimizer's moments lie.

    Raises:
        BackendUnavailable: C++ was not compiled for the CPU, or Warp is not there for CUDA.
    """
    device = optimizer.first["means"].device.type
    if device == "cpu":
        load_kernels("clear_strategies.kernels")
        return cpp.CppGaussianStep
    require_warp("the compiled pass", device, "it runs in C++ for a field in the CPU's memory")
    from clear_strategies.kernels.gaussian_step import warp

    return warp.WarpGaussianStep


@dataclass(frozen=True, slots=True, eq=False)
class Factors:
    """One cotangent's gradient as the rasterizer gave it: on the drawn splats, colour as its rank-one factors."""

    gradients: SplatGradients
    k: int
    activation: Activation
    visible: Bool[Tensor, " N"]

    @property
    def screen(self) -> Float[Tensor, "N 2"]:
        return self.gradients.screen[self.k]

    def table(self) -> dict[str, Tensor]:
        g, k = self.gradients, self.k
        rows = {"means": g.means, "quats": g.quats, "scales": g.scales, "opacities": g.opacities, "rgb": g.rgb}
        return {name: value[k].contiguous() for name, value in rows.items()} | {"basis": g.basis.contiguous()}


class CompiledStep:
    """Merges as `Conductor.merge` does, then steps as `Adam.step` does and projects; nothing dense in between.

    A row stays as it is where its gradient, both moments and the anchor's vjp are 0, and so do bands of the spherical
    harmonics above the active degree; `skips` False visits them all the same, and finds the same bits.

    Args:
        sweeps: who does the arithmetic; None: who can, where the optimizer's moments lie.

    Raises:
        BackendUnavailable: nobody can.
    """

    stage: Final = "per-Gaussian pass"

    def __init__(
        self, conductor: Conductor, optimizer: Adam, *, skips: bool = True, sweeps: GaussianPass | None = None
    ) -> None:
        self.conductor, self.optimizer, self.skips = conductor, optimizer, skips
        self._sweeps = gaussian_pass(optimizer) if sweeps is None else sweeps
        self._gco: Any = conductor.owner("correct")
        self._svs: Any = next((s for s in conductor.strategies if type(s).fused == "svs"), None)
        self._looked_at: tuple[int, Sequence[Tensor | None]] | None = None
        self._quiet = False

    def vjp(self, shot: FieldShot, cotangents: Float[Tensor, "K H W 3"]) -> list[Factors]:
        g = shot.gradients(cotangents)
        return [Factors(g, k, shot.activation, shot.visible) for k in range(len(cotangents))]

    def merge(
        self,
        params: Mapping[str, Tensor],
        g_lr: Factors,
        g_base: Factors | None,
        g_hf: Factors | None,
        m: float | Float[Tensor, " N"],
        e: Evidence | None,
        t: int,
    ) -> tuple[Grads, Mapping[str, Number]]:
        """Step `params` and the optimizer's moments in place; no gradient is left, only the conflict ratio."""
        rates, bias2 = self.optimizer.advance()
        only = self.optimizer.rates.rows == "visible"
        visible = (g_lr.visible if g_base is None else g_lr.visible | g_base.visible) if only else None
        conflict = self._sweep(params, g_lr, g_base, g_hf, m, e, t, rates, bias2, visible, None)
        return Grads(), conflict

    def gradient(
        self,
        params: Mapping[str, Tensor],
        g_lr: Factors,
        g_base: Factors | None,
        g_hf: Factors | None,
        m: float | Float[Tensor, " N"],
        e: Evidence | None,
        t: int,
    ) -> tuple[Grads, Mapping[str, Number]]:
        """For checking: the dense gradient that `merge` steps by, and nothing moved."""
        merged = Grads({name: torch.zeros_like(p) for name, p in params.items()})
        rates = dict.fromkeys(params, 0.0)
        conflict = self._sweep(params, g_lr, g_base, g_hf, m, e, t, rates, 1.0, None, merged)
        return merged, conflict

    def _sweep(
        self,
        params: Mapping[str, Tensor],
        g_lr: Factors,
        g_base: Factors | None,
        g_hf: Factors | None,
        m: float | Tensor,
        e: Evidence | None,
        t: int,
        rates: Mapping[str, float],
        bias2: float,
        visible: Tensor | None,
        merged: Grads | None,
    ) -> Mapping[str, Number]:
        o, a = self.conductor.objective, g_lr.activation
        activation = {
            "scales": a.scales, "filtered": a.filtered, "filter": a.filter_3d, "sigmoid": a.sigmoid,
            "factor": a.factor.contiguous(), "route": m.float().contiguous() if isinstance(m, Tensor) else None,
        }  # fmt: skip
        gaussians = self._sweeps(
            activation,
            g_lr.table(),
            None if g_base is None else g_base.table(),
            None if g_hf is None else g_hf.table(),
            o.lambda_hf,
        )
        λ = o.lambda_hr(t)
        conflict: dict[str, Number] = {}
        correction, compared, margins = None, None, None
        if g_base is not None and λ > 0:
            products = self._products(a.sigmoid)
            compared = gaussians.compare(products)  # before correction
            shares = zip((*CONFLICT_GROUPS, "gaussian"), compared.opposed, compared.comparable, strict=True)
            conflict = {group: deferred.defer(deferred.ratio, opposed, n) for group, opposed, n in shares}
            if self._gco is not None:
                correction, margins = self._correction(compared, products, e)
        anchor, stiffness = self._anchor(len(a.sigmoid))
        decays = g_hf is not None or "detail" in anchor
        keep = 1 - self.optimizer.rates.detail_decay if decays else 1.0
        attributes = {
            name: kernel.Attribute(
                p, self.optimizer.first[name], self.optimizer.second[name], rates[name], anchor.get(name),
                stiffness.get(name, 0.0), keep if name == "detail" else 1.0, _LIMITS.get(name, float("inf")),
                None if merged is None else merged[name],
            )
            for name, p in params.items()
        }  # fmt: skip
        skips = self.skips and merged is None and self.optimizer.rates.eps > 0  # 0 / (√0 + 0) moves everything
        shN, active = params["shN"], g_lr.gradients.basis.shape[1] - 1
        bands = active if skips and self._above_is_quiet(shN, active, anchor.get("shN")) else shN.shape[1]
        stepped = gaussians.step(
            attributes, correction,
            kernel.StepSettings(
                BETA1, BETA2, bias2, self.optimizer.rates.eps, λ,
                None if visible is None else visible.contiguous().view(torch.uint8), skips, 3 * bands,
            ),
        )  # fmt: skip
        if self._gco is not None and compared is not None and margins is not None:
            self._report(compared, margins, stepped, e)
        if merged is None:
            self._note_skips(stepped, bands, shN.shape[1])
        return conflict

    def _products(self, like: Float[Tensor, " N"]) -> Float[Tensor, "6 N"] | None:
        """Room for ‖g_LR‖‖g_HR‖ by group, which only an absolute ε is held against."""
        if self._gco is None or not self._gco.eps.startswith("absolute"):
            return None
        return like.new_empty(len(CONFLICT_GROUPS), len(like), dtype=torch.float64)

    def _correction(
        self, compared: kernel.Comparison, products: Tensor | None, e: Evidence | None
    ) -> tuple[kernel.Correction, list[Number | None]]:
        gco = self._gco
        eps_cos, eps_corr = self._epsilons(compared)
        absolute, _ = gco.epsilons(0.0, 0.0)  # whatever the norms are
        margins = [None] * len(CONFLICT_GROUPS) if products is None else [gco.margin(x, absolute) for x in products]
        correction = kernel.Correction(
            [group in gco.groups for group in CONFLICT_GROUPS],
            eps_cos,
            eps_corr,
            gco.tolerance,
            gco.weight_min,
            gco.weight_max,
            ROTATION_NOISE,
            gco.bound == "omega",
            None if e is None else e.reliability.float().contiguous(),
        )
        return correction, margins

    def _epsilons(self, c: kernel.Comparison) -> tuple[Sequence[float] | Tensor, Sequence[float] | Tensor]:
        """ε of the cosine and of the correction by group; on the device, if that is where the mean norms are."""
        epsilons = self._gco.epsilons
        if isinstance(c.comparable, Tensor):
            n = c.comparable[:-1].clamp_min(1)  # where nothing could be compared, the sums are 0
            lr, hr = (torch.as_tensor(norms) / n for norms in (c.norm_lr, c.norm_hr))
            cos, corr = (x if isinstance(x, Tensor) else torch.full_like(lr, x) for x in epsilons(lr, hr))
            return cos, corr
        norms = zip(c.norm_lr, c.norm_hr, c.comparable, strict=False)
        each = [epsilons(lr / n, hr / n) if n else epsilons(0.0, 0.0) for lr, hr, n in norms]
        return [cos for cos, _ in each], [corr for _, corr in each]

    def _report(
        self,
        compared: kernel.Comparison,
        margins: Sequence[Number | None],
        stepped: kernel.StepCounts,
        e: Evidence | None,
    ) -> None:
        index = {group: k for k, group in enumerate(CONFLICT_GROUPS)}
        done = [
            Correction(
                group, compared.comparable[k], stepped.corrected[k], stepped.omega[k], stepped.at_lower_bound[k], margins[k]
            )
            for group, k in ((group, index[group]) for group in self._gco.groups)
        ]  # fmt: skip
        self._gco.report(done, e)

    def _anchor(self, n: int) -> tuple[Mapping[str, Tensor], Mapping[str, float]]:
        if self._svs is None:
            return {}, {}
        if not self._svs.state:
            self.conductor.work_log.skip("regularize", "no anchor yet")
            return {}, {}
        return self._svs.state, self._svs.stiffness(n)

    def _above_is_quiet(self, shN: Tensor, active: int, anchor: Tensor | None) -> bool:
        """Whether bands above the active degree have no momentum and no vjp. Looked at again when a tensor is another
        one (densification, resuming, the anchor); while it is the same, a pass that left them alone left them quiet, and
        momentum that is there does not end.
        """
        tensors = (self.optimizer.first["shN"], self.optimizer.second["shN"], anchor)
        if self._looked_at is not None:
            looked_from, same = self._looked_at
            known = looked_from <= active if self._quiet else looked_from == active
            if known and all(a is b for a, b in zip(same, tensors, strict=True)):
                return self._quiet
        moved = any(bool(moments[:, active:].any()) for moments in tensors[:2] if moments is not None)
        pulled = anchor is not None and not torch.equal(anchor[:, active:], shN[:, active:])
        self._looked_at, self._quiet = (active, tensors), not (moved or pulled)
        return self._quiet

    def _note_skips(self, stepped: kernel.StepCounts, bands: int, all_bands: int) -> None:
        skip = self.conductor.work_log.skip
        for reason, rows in (
            ("gradient, moments and anchor's vjp are 0", stepped.still),
            ("not visible (optim.rows=visible)", stepped.invisible),
        ):
            if isinstance(rows, Tensor) or rows:  # a number on the device is not looked at
                skip("optimizer rows", reason, rows)
        if bands < all_bands:
            skip("SH bands in the optimizer", "above the active degree", all_bands - bands)
