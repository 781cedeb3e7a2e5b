"""Error against float64: of the picture, and of each attribute's gradient.

Twice: against float64 at the same cut-offs, which is what the arithmetic loses, and against float64 without any, which
is what the cut-offs lose too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.bench.scenes import SETTINGS
from rasterizers.interface import Camera, Rasterizer, Splats

ATTRIBUTES: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
NO_CUT_OFFS: Final = {"alpha_min": 1e-9, "transmittance_min": 0.0}


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A rendering and its gradient for one cotangent, by attribute; in main memory."""

    image: Float[Tensor, "H W 3"]
    gradients: Mapping[str, Tensor]


@dataclass(frozen=True, slots=True)
class Errors:
    """How far a picture is from the truth.

    Args:
        image: "max", "mean" and "p99.99" of the absolute difference of its values.
        relative: by attribute, ‖g - g*‖ / ‖g*‖ over all Gaussians.
        median: by attribute, the same of one Gaussian, median over those with a gradient.
    """

    image: Mapping[str, float]
    relative: Mapping[str, float]
    median: Mapping[str, float]


def draw(rasterizer: Rasterizer, splats: Splats, camera: Camera, cotangent: Float[Tensor, "H W 3"]) -> Picture:
    rendering = rasterizer(splats, camera)
    g = rendering.vjp(cotangent.to(rendering.image)[None])
    return Picture(rendering.image.cpu(), {name: getattr(g, name)[0].cpu() for name in ATTRIBUTES})


def compare(found: Picture, truth: Picture) -> Errors:
    difference = (found.image.double() - truth.image.double()).abs().numpy()
    image = {
        "max": float(difference.max()),
        "mean": float(difference.mean()),
        "p99.99": float(np.quantile(difference, 0.9999)),
    }
    relative, median = {}, {}
    for name in ATTRIBUTES:
        expected = truth.gradients[name].double().flatten(1) if truth.gradients[name].dim() > 1 else (
            truth.gradients[name].double()[:, None]
        )  # fmt: skip
        off = torch.linalg.vector_norm(found.gradients[name].double().view(expected.shape) - expected, dim=1)
        size = torch.linalg.vector_norm(expected, dim=1)
        has = size > 0
        relative[name] = float(off.norm() / size.norm()) if bool(has.any()) else float(off.norm())
        median[name] = float((off[has] / size[has]).median()) if bool(has.any()) else 0.0
    return Errors(image, relative, median)


def oracle_backend() -> str | None:
    """The fastest backend here that computes in float64, on whichever device."""
    for name, why_not in rasterizers.available().items():
        if why_not is None and torch.float64 in rasterizers.load(name).traits.dtypes:
            return name
    return None


def oracle(backend: str, splats: Splats, camera: Camera, cotangent: Tensor, rules: Mapping[str, Any]) -> Picture:
    """The truth by some rules: cut-offs, and whatever else is not as in `SETTINGS`."""
    rasterizer = rasterizers.load(backend, **{**SETTINGS, **rules})
    here = splats.means.device.type
    device = here if here in rasterizer.traits.devices else "cpu"
    tensors = {f.name: getattr(splats, f.name) for f in fields(splats)}
    wide = replace(splats, **{name: t.to(device, torch.float64) for name, t in tensors.items() if t is not None})
    return draw(rasterizer, wide, camera, cotangent.double())
