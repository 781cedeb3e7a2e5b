"""A host's photographs and cameras as the views that strategies know."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import Photo, View
from clear_strategies.data.priors import Images
from clear_strategies.errors import DataError
from clear_strategies.merging.conductor import Conductor
from rasterizers.interface import Camera

SuperResolve = Callable[[str, Float[Tensor, "h w 3"], int], Float[Tensor, "H W 3"]]
"""I_HR of the view of this name, from its LR image and the factor: any of `clear_strategies.data.priors`, or yours."""


def view(
    name: str,
    image: Float[Tensor, "h w 3"],
    world_to_camera: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    sr: SuperResolve,
    factor: int = 4,
) -> View:
    """One training view of a host, on the device of its image.

    Args:
        image: the authentic photograph, in [0, 1] or 8 bits.
        world_to_camera: OpenCV axes (x right, y down, z forward).
        K: focal lengths and principal point, pixels of `image` (pixel (0, 0) spans [0, 1)²).
        sr: where the SR picture comes from. factor: HR pixels per LR pixel.

    Raises:
        DataError: the SR picture is not `factor` times the image.
    """
    if image.dtype == torch.uint8:
        image = image.float() / 255
    image = image[..., :3].float()
    h, w = image.shape[:2]
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    low = Camera(world_to_camera.detach().float(), fx, fy, cx, cy, w, h)
    enlarged = sr(name, image.cpu(), factor).to(image)
    if enlarged.shape != (h * factor, w * factor, 3):
        raise DataError(
            name, "SR image", f"is {enlarged.shape[1]}x{enlarged.shape[0]}, but {factor} times {w}x{h} is "
            f"{w * factor}x{h * factor}", "super-resolve the very images that the host trains on",
        )  # fmt: skip
    return View(name, Photo(low, image), Photo(low.scaled(factor), enlarged), sr_source=getattr(sr, "label", "unknown"))


def super_resolve(sr: SuperResolve | str | Path | None, conductor: Conductor, factor: int) -> tuple[SuperResolve, int]:
    """The function that gives SR pictures, and their factor; where there are none, HR is LR and must not be asked for."""
    if sr is not None:
        return Images(str(sr)) if isinstance(sr, str | Path) else sr, factor
    λ = conductor.objective.lambda_hr
    if λ.peak > 0 or λ.final > 0 or conductor.owner("observe") is not None:
        raise ValueError(
            "sr must say where the SR pictures are, got None, but HR takes part. Pass their folder, or set objective=lr_only "
            "and leave P2G out."
        )
    return lambda name, image, factor: image, 1
