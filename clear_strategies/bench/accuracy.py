"""Errors of images and gradients against float64."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.bench.scenes import SETTINGS, Workload

ATTRIBUTES: Final = ("means", "scales", "quats", "opacities", "sh0", "shN")
NO_CUT_OFFS: Final = {"alpha_min": 1e-9, "transmittance_min": 0.0}
REFERENCE_LIMIT: Final = 10_000  # Gaussians; with more, the pure-torch reference takes minutes per turn

Drawn = Mapping[str, Tensor]
"""An image, and the gradients of one cotangent by attribute, in main memory."""


def draw(render: Callable[[], Any], cotangent: Float[Tensor, "H W 3"]) -> Drawn:
    """`render` returns an object with `image`, and `vjp` of K cotangents."""
    rendering = render()
    g = rendering.vjp(cotangent[None])
    return {"image": rendering.image.detach().cpu(), **{name: getattr(g, name)[0].cpu() for name in ATTRIBUTES}}


def errors(measured: Drawn, truth: Drawn) -> dict[str, float]:
    """Table columns: absolute errors of the image, and relative L2 errors of each attribute's gradient.

    `<attribute>_relative` is over all Gaussians, `<attribute>_median` the median of the Gaussians' relative errors.
    """
    difference = (measured["image"].double() - truth["image"].double()).abs().numpy()
    columns = {
        "image_max": float(difference.max()),
        "image_p99.99": float(np.quantile(difference, 0.9999)),
        "image_mean": float(difference.mean()),
    }
    for name in ATTRIBUTES:
        x, expected = (drawn[name].double().reshape(len(truth[name]), -1) for drawn in (measured, truth))
        size = expected.norm(dim=1)
        of_each = ((x - expected).norm(dim=1) / size)[size > 0]
        whole, error = float(size.norm()), float((x - expected).norm())
        columns[f"{name}_relative"] = error / whole if whole > 0 else error
        columns[f"{name}_median"] = float(of_each.median()) if len(of_each) else 0.0
    return columns


def affordable(backend: str, workload: Workload, what: str, note: Callable[[str], None]) -> bool:
    """Whether a backend draws this scene in seconds; if not, `note` gets the reason."""
    if backend != "torch" or len(workload.splats) <= REFERENCE_LIMIT:
        return True
    note(f"{what}, {workload.name}: the torch reference takes at most {REFERENCE_LIMIT:,} Gaussians here.")
    return False


def truth_backend() -> str:
    """The fastest backend here that computes in float64, on any device."""
    runs = (name for name, why_not in rasterizers.available().items() if why_not is None)
    return next(name for name in runs if torch.float64 in rasterizers.load(name).traits.dtypes)


def truth(backend: str, workload: Workload, cotangent: Float[Tensor, "H W 3"], rules: Mapping[str, Any]) -> Drawn:
    """Draw in float64, on the workload's device where the backend draws there.

    Args:
        rules: the cut-offs, and settings that differ from `SETTINGS`.
    """
    rasterizer = rasterizers.load(backend, **{**SETTINGS, **rules})
    device = workload.splats.means.device.type
    wide = workload.to(device if device in rasterizer.traits.devices else "cpu", torch.float64)
    return draw(lambda: rasterizer(wide.splats, wide.camera), cotangent.to(wide.splats.means))
