"""Errors of images and gradients against float64.

Each contender is compared twice: with float64 at its own cut-offs, which shows the rounding, and
with float64 without cut-offs, which shows the cut-offs too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.bench.scenes import SETTINGS, Workload

ATTRIBUTES: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
NO_CUT_OFFS: Final = {"alpha_min": 1e-9, "transmittance_min": 0.0}


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """An image and the gradients of one cotangent by attribute, in main memory."""

    image: Float[Tensor, "H W 3"]
    gradients: Mapping[str, Tensor]


def draw(render: Callable[[], Any], cotangent: Float[Tensor, "H W 3"]) -> Drawn:
    """`render` returns an object with `image`, and `vjp` of K cotangents."""
    rendering = render()
    g = rendering.vjp(cotangent[None])
    return Drawn(rendering.image.detach().cpu(), {name: getattr(g, name)[0].cpu() for name in ATTRIBUTES})


def errors(found: Drawn, truth: Drawn) -> dict[str, float]:
    """Table columns: absolute errors of the image, and relative L2 errors of each attribute's gradient.

    `<attribute>_relative` is over all Gaussians, `<attribute>_median` the median of their own.
    """
    difference = (found.image.double() - truth.image.double()).abs().numpy()
    columns = {
        "image_max": float(difference.max()),
        "image_p99.99": float(np.quantile(difference, 0.9999)),
        "image_mean": float(difference.mean()),
    }
    for name in ATTRIBUTES:
        expected = truth.gradients[name].double().reshape(len(truth.gradients[name]), -1)
        error = (found.gradients[name].double().reshape(expected.shape) - expected).norm(dim=1)
        size = expected.norm(dim=1)
        has_gradient = size > 0
        any_gradient = bool(has_gradient.any())
        columns[f"{name}_relative"] = float(error.norm() / size.norm()) if any_gradient else float(error.norm())
        columns[f"{name}_median"] = float((error / size)[has_gradient].median()) if any_gradient else 0.0
    return columns


def truth_backend() -> str | None:
    """The fastest backend here that computes in float64, on any device."""
    for name, why_not in rasterizers.available().items():
        if why_not is None and torch.float64 in rasterizers.load(name).traits.dtypes:
            return name
    return None


def truth(backend: str, workload: Workload, cotangent: Float[Tensor, "H W 3"], rules: Mapping[str, Any]) -> Drawn:
    """Draw in float64.

    Args:
        rules: the cut-offs, and settings that differ from `SETTINGS`.
    """
    rasterizer = rasterizers.load(backend, **{**SETTINGS, **rules})
    device = workload.splats.means.device.type
    wide = workload.to(device if device in rasterizer.traits.devices else "cpu", torch.float64)
    return draw(lambda: rasterizer(wide.splats, wide.camera), cotangent.to(wide.splats.means))
