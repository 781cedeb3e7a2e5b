"""The Gaussian field: raw parameters, their activations, and the two renderings of one view.  Eq. 1-3"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from clear_strategies.core.gradients import ATTRIBUTES, PARAMETERS, Grads, gathered, gradients_of
from clear_strategies.core.points import PointCloud, spread
from clear_strategies.core.view import View
from clear_strategies.kernels import per_gaussian
from clear_strategies.kernels.per_gaussian import reference
from clear_strategies.kernels.reconcile import dense
from clear_strategies.training.mip import NEAR, filter_std
from rasterizers.geometry import constant_band
from rasterizers.interface import Camera, Rasterizer, Rendering, Splats, summed_vjp

_INITIAL_OPACITY: Final = 0.1
_NEIGHBOURS: Final = 3  # 3DGS: a point's initial size is the root mean square distance to its 3 nearest neighbours
_SMALLEST_SQUARED_DISTANCE: Final = 1e-7

# Beyond these a parameter has no gradient: sigmoid(17) is 1 in float32, exp(45)² is infinite.
LOGIT_LIMIT: Final = 15.0
LOG_SCALE_LIMIT: Final = 20.0


class GaussianField(nn.Module):
    """θ: raw parameters by gsplat's names, and f_det.

    Attributes:
        quats: wxyz, any norm. scales: log. opacities: logit.
        detail: f_det, an RGB offset in HR renderings, 0 at the start.
        filter_3d: standard deviation of the 3D filter, world units; not trained.
        degree: active degree of spherical harmonics.
    """

    means: Float[nn.Parameter, "N 3"]
    quats: Float[nn.Parameter, "N 4"]
    scales: Float[nn.Parameter, "N 3"]
    opacities: Float[nn.Parameter, " N"]
    sh0: Float[nn.Parameter, "N 1 3"]
    shN: Float[nn.Parameter, "N B 3"]  # noqa: N815 - gsplat's name
    detail: Float[nn.Parameter, "N 3"]
    filter_3d: Float[Tensor, " N"]

    def __init__(self, parameters: Mapping[str, Tensor], *, degree: int = 0) -> None:
        super().__init__()
        for name in ATTRIBUTES:
            setattr(self, name, nn.Parameter(parameters[name].detach().clone(), requires_grad=False))
        self.register_buffer("filter_3d", parameters["means"].new_zeros(len(parameters["means"])))
        self.degree = degree

    @classmethod
    def from_cloud(cls, cloud: PointCloud, *, max_degree: int = 3) -> GaussianField:
        """The initial field of 3DGS: isotropic, as large as the distance to the neighbours, opacity 0.1, the points' colours."""
        n = len(cloud)
        if n == 0:
            raise ValueError(f"an initial cloud needs at least one point, {cloud.source!r} has none.")
        means = cloud.means.float()
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1
        return cls(
            {
                "means": means,
                "quats": quats,
                "scales": _neighbour_distance(means).log()[:, None].expand(n, 3),
                "opacities": torch.logit(torch.full((n,), _INITIAL_OPACITY)),
                "sh0": constant_band(cloud.colors.float()),
                "shN": torch.zeros(n, (max_degree + 1) ** 2 - 1, 3),
                "detail": torch.zeros(n, 3),
            }
        )

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def max_degree(self) -> int:
        return math.isqrt(self.shN.shape[1] + 1) - 1

    def raw(self) -> dict[str, Tensor]:
        """The raw parameters by attribute; edit them in place only."""
        return {name: getattr(self, name).data for name in ATTRIBUTES}

    def render_scales(
        self,
        rasterizer: Rasterizer,
        view: View,
        *,
        gate: Float[Tensor, " N"] | Float[Tensor, "2 N"] | None = None,
        lr: bool = True,
        hr: bool = True,
    ) -> tuple[FieldShot | None, FieldShot | None]:
        """Î_LR without f_det and Î_HR with it, of the same gated geometry; None for a scale that is not wanted.  Eq. 2, 3

        Args:
            gate: of both scales, or a row for LR and one for HR.
        """
        at_lr, at_hr = [self._activate(gate)] * 2 if gate is None or gate.dim() == 1 else map(self._activate, gate)
        jobs = [(at_lr, False, view.lr.camera)] * lr + [(at_hr, True, view.hr.camera)] * hr
        renderings = rasterizer.render_scales([(active.splats(detail=d), camera) for active, d, camera in jobs])
        shots = [FieldShot(r, active, detail=d) for (active, d, _), r in zip(jobs, renderings, strict=True)]
        return shots[0] if lr else None, shots[-1] if hr else None

    def shot(self, rasterizer: Rasterizer, camera: Camera) -> FieldShot:
        """A rendering with gradients, of all Gaussians, without f_det."""
        active = self._activate()
        return FieldShot(rasterizer(active.splats(detail=False), camera), active, detail=False)

    def render(self, rasterizer: Rasterizer, camera: Camera, *, detail: bool = True) -> Float[Tensor, "H W 3"]:
        """An image for evaluation: no dropout, f = base + det, not clamped."""
        return rasterizer(self._activate().splats(detail=detail), camera).image

    def update_filter(self, cameras: Sequence[Camera], variance: float, near: float = NEAR) -> None:
        """Recompute the 3D filter from the present means, in the same memory if their number is the same."""
        stds = filter_std(self.means.data, cameras, variance, near)
        if len(stds) == len(self.filter_3d):
            self.filter_3d.copy_(stds)
        else:
            self.filter_3d = stds

    def take(self, parents: Int[Tensor, " M"]) -> None:
        """Change the structure by one gather, see `gathered`: row i becomes a copy of row parents[i]."""
        for name in ATTRIBUTES:
            getattr(self, name).data = gathered(getattr(self, name).data, parents)
        self.filter_3d = gathered(self.filter_3d, parents)

    def constrain(self) -> None:
        """Clamp parameters to where they have a gradient: logits to ±15, log scales to ±20."""
        self.opacities.data.clamp_(-LOGIT_LIMIT, LOGIT_LIMIT)
        self.scales.data.clamp_(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)

    def filtered_opacities(self) -> Float[Tensor, " N"]:
        """σ(opacity) times the 3D filter's coefficient, the opacity that is rendered; pruning uses it."""
        return self._activate().opacities

    def lower_opacities(self, most: float) -> None:
        """Lower every rendered opacity to at most `most` (the form of Mip-Splatting)."""
        active = self._activate()
        target = active.opacities.clamp_max(most) / active.coefficient.clamp_min(torch.finfo(torch.float32).tiny)
        self.opacities.data.clamp_max_(torch.logit(target.clamp(1e-6, 1 - 1e-6)))

    def baked(self) -> Splats:
        """Splats for exports and viewers: the filter in scales and opacities, f_det in the colour."""
        return self._activate().splats(detail=True)

    def splats_of(self, raw: Mapping[str, Tensor]) -> Splats:
        """Other raw parameters as those of the field are drawn, without f_det; differentiable."""
        _, filtered, *_, opacities = reference.activate(raw["scales"], raw["opacities"], self.filter_3d, None)
        shN = raw["shN"][:, : (self.degree + 1) ** 2 - 1]
        return Splats(raw["means"], raw["quats"], filtered, opacities, raw["sh0"], shN)

    def _activate(self, gate: Tensor | None = None) -> Activation:
        raw, bands = self.raw(), (self.degree + 1) ** 2 - 1
        activated = per_gaussian.activate(raw["scales"], raw["opacities"], self.filter_3d, gate)
        return Activation(raw, self.filter_3d, raw["shN"][:, :bands], *activated)


@dataclass(frozen=True, slots=True, eq=False)
class Activation:
    """The activated field, with what the chain rule to the raw parameters needs.

    Args:
        scales: s = exp(raw). filtered: √(s² + f²). sigmoid: σ(raw). opacities: factor · σ.
        coefficient: Π_k s_k / √(s_k² + f²): a filtered Gaussian is larger, and its opacity lower. factor: coefficient · z.
    """

    raw: Mapping[str, Tensor]
    filter_3d: Float[Tensor, " N"]
    shN: Float[Tensor, "N B 3"]  # noqa: N815 - gsplat's name
    scales: Float[Tensor, "N 3"]
    filtered: Float[Tensor, "N 3"]
    sigmoid: Float[Tensor, " N"]
    coefficient: Float[Tensor, " N"]
    factor: Float[Tensor, " N"]
    opacities: Float[Tensor, " N"]

    def splats(self, *, detail: bool) -> Splats:
        return Splats(
            self.raw["means"], self.raw["quats"], self.filtered, self.opacities, self.raw["sh0"], self.shN,
            self.raw["detail"] if detail else None,
        )  # fmt: skip

    def vjp(self, g: Grads) -> Grads:
        """Chain rule through the filter, exp and sigmoid, for a gradient of the splats; the result has no factors."""
        d_opacity = g["opacities"]
        # ∂ log(coefficient) / ∂ log(s) = f² / (s² + f²): the opacity's gradient reaches the scales.
        share = (self.filter_3d[:, None] / self.filtered).square()
        d_scales = g["scales"] * self.scales.square() / self.filtered
        d_scales = d_scales + (d_opacity * self.opacities)[:, None] * share
        d_opacity = d_opacity * self.factor * self.sigmoid * (1 - self.sigmoid)
        raw = Grads({**g, "scales": d_scales, "opacities": d_opacity}, colour=g.colour, screen=g.screen)
        return dense(raw, {name: self.raw[name] for name in PARAMETERS})


class FieldShot:
    """A rendering of the field; see `gradients.Shot`."""

    def __init__(self, rendering: Rendering, activation: Activation, *, detail: bool) -> None:
        self.image, self.means2d, self.visible = rendering.image, rendering.means2d, rendering.visible
        self._rendering = rendering
        self.activation = activation
        self._detail = detail

    def gradients(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        """As `vjp`, of the rendered splats: before the chain rule of `activation`, with the colours' gradient as factors."""
        return gradients_of(summed_vjp(self._rendering, cotangents, weight))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        """See `Shot`; the sum is taken before the projection's VJP."""
        each = self.gradients(cotangents, weight)
        if weight is not None:
            *each, hf = each
            return [*map(self.activation.vjp, each), hf if self._detail else Grads(screen=hf.screen)]
        raw = [*map(self.activation.vjp, each)]
        if self._detail:
            for g, drawn in zip(raw, each, strict=True):
                g["detail"] = drawn.tensors["rgb"]
        return raw


def _neighbour_distance(means: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    from scipy.spatial import cKDTree

    if len(means) == 1:
        return means.new_full((1,), _SMALLEST_SQUARED_DISTANCE**0.5)
    k = min(_NEIGHBOURS, len(means) - 1) + 1  # the nearest is the point itself
    points = means.numpy()
    distances = np.asarray(cKDTree(points).query(points, k=k)[0])
    squared = torch.from_numpy(distances[:, 1:]).square().mean(1)
    size = spread(means)  # in units of a scene whose size is between 1 and 1000, as most have
    unit = size / min(max(size, 1.0), 1000.0) or 1.0
    return squared.clamp_min(_SMALLEST_SQUARED_DISTANCE * unit**2).sqrt().to(means)
