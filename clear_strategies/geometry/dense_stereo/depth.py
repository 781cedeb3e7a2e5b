"""From the cost volume to depth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.geometry.dense_stereo.cost import cost_volume
from clear_strategies.geometry.dense_stereo.image import Grey
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.dense_stereo.smoothing import smooth
from clear_strategies.geometry.dense_stereo.sources import Comparison, plane_count


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The depth of one photo, before it is compared with that of others."""

    image: Grey
    inverse_depth: Float[Tensor, "H W"]  # 1 / z, 1 / world units
    correlation: Float[Tensor, "H W"]  # ZNCC of the windows at that depth, in [-1, 1]


def plane_sweep(image: Grey, others: list[Grey], comparison: Comparison, settings: StereoSettings) -> Estimate:
    """Planes uniform in inverse depth, the minimum of the smoothed cost, and a parabola through its neighbours."""
    count = plane_count(image.camera, [other.camera for other in others], comparison, settings)
    planes = torch.linspace(comparison.far, comparison.near, count, dtype=torch.float64)
    cost = cost_volume(image, others, planes.to(image.image), settings.window)
    smoothed = smooth(cost, image.image, settings.small_step, settings.large_step)
    best = smoothed.argmin(dim=-1, keepdim=True)
    correlation = 1 - 2 * cost.gather(-1, best)[..., 0]
    step = (comparison.near - comparison.far) / (count - 1)
    position = best[..., 0].double() + parabola_minimum(smoothed, best).double()
    return Estimate(image, (comparison.far + step * position).float(), correlation)


def parabola_minimum(cost: Float[Tensor, "H W D"], best: Tensor) -> Float[Tensor, "H W"]:
    """Where the parabola through the minimum and its two neighbours is lowest, in [-0.5, 0.5] planes from the minimum."""
    last = cost.shape[-1] - 1
    before, here, after = (cost.gather(-1, (best + k).clamp(0, last))[..., 0] for k in (-1, 0, 1))
    curvature = (before - 2 * here + after).clamp_min(1e-9)
    offset = ((before - after) / (2 * curvature)).clamp(-0.5, 0.5)
    inside = (best[..., 0] > 0) & (best[..., 0] < last)
    return torch.where(inside, offset, 0.0)
