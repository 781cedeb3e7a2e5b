"""Checks of what backends are given."""

from __future__ import annotations

from dataclasses import fields
from typing import Final

import torch
from torch import Tensor

from rasterizers.interface import Splats, Traits

_SHAPES: Final = {  # of a row; B is the number of higher bands
    "means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": ("B", 3), "rgb_offset": (3,),
}  # fmt: skip


def require_splats(splats: Splats, traits: Traits) -> None:
    """Refuse splats whose tensors differ in dtype, device or number of rows, or that the backend does not draw.

    Raises:
        TypeError: a tensor's dtype or device is not the backend's, or is not that of the means.
        ValueError: a tensor has another shape than in `Splats`.
    """
    means, n = splats.means, len(splats)
    if means.dtype not in traits.dtypes or means.device.type not in traits.devices:
        drawn = " and ".join(sorted(str(dtype).removeprefix("torch.") for dtype in traits.dtypes))
        raise TypeError(
            f"this rasterizer draws {drawn} tensors on {' or '.join(sorted(traits.devices))}, "
            f"got splats.means of {_dtype_and_device(means)}; move the splats there, or load another backend."
        )
    for name, row in _SHAPES.items():
        value = getattr(splats, name)
        if value is None:
            continue
        if value.dtype != means.dtype or value.device != means.device:
            raise TypeError(
                f"splats.{name} must be {_dtype_and_device(means)}, as splats.means is, got {_dtype_and_device(value)}."
            )
        expected = (n, *row)
        if value.shape != expected and not (name == "shN" and value.dim() == 3 and value.shape[::2] == expected[::2]):
            raise ValueError(
                f"splats.{name} must have the shape [{', '.join(map(str, expected))}], got {list(value.shape)}."
            )
    if (bands := splats.shN.shape[1]) not in (0, 3, 8, 15):
        raise ValueError(f"splats.shN must hold 0, 3, 8 or 15 bands, got {bands}.")


def _dtype_and_device(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} on {tensor.device}"


def require_finite_splats(splats: Splats) -> None:
    """Raise a ValueError for NaN and infinity, which would leave holes in the image. Costs one reduction per tensor."""
    for field in fields(splats):
        value = getattr(splats, field.name)
        if value is None or bool(torch.isfinite(value.sum())):
            continue
        bad = ~torch.isfinite(value).reshape(len(value), -1).all(1)  # none where the sum alone overflows
        if bool(bad.any()):
            index = int(bad.nonzero()[0])
            raise ValueError(f"splats.{field.name} must be finite; Gaussian {index} is not ({int(bad.sum())} in all).")


def require_cotangents(cotangents: Tensor, image: Tensor) -> None:
    """Raise a ValueError unless the cotangents are [K, H, W, 3] for an image [H, W, 3]."""
    if cotangents.dim() != 4 or cotangents.shape[1:] != image.shape:
        height, width, _ = image.shape
        raise ValueError(f"cotangents must be [K, {height}, {width}, 3], got {tuple(cotangents.shape)}.")
