"""What every backend asks of its input, said in the same words, and what several do with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.interface import Camera, RasterSettings, Splats

Settings = TypeVar("Settings", bound=RasterSettings)


def build(kind: type[Settings], settings: Mapping[str, Any]) -> Settings:
    """A backend from its settings, the fields of `kind`.

    Raises:
        ValueError: a setting that it does not have, or that is out of range.
    """
    known = [f.name for f in fields(kind) if f.init]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise ValueError(f"unknown rasterizer setting {unknown[0]!r}; known are {', '.join(known)}.")
    chosen = dict(settings)
    if "background" in chosen:
        chosen["background"] = tuple(float(c) for c in chosen["background"])
    return kind(**chosen)


def require_finite(splats: Splats) -> None:
    """NaN or infinity is named here, not found later as a hole in the picture. One reduction a tensor.

    Raises:
        ValueError: names the tensor and the first Gaussian.
    """
    for field in fields(splats):
        value = getattr(splats, field.name)
        if value is None or value.numel() == 0:
            continue
        if not bool(torch.isfinite(value.sum())) and not bool(torch.isfinite(value).all()):
            bad = (~torch.isfinite(value)).flatten(1).any(1) if value.dim() > 1 else ~torch.isfinite(value)
            index = int(bad.nonzero()[0])
            raise ValueError(f"splats.{field.name} must be finite; Gaussian {index} is not ({int(bad.sum())} in all).")


def require_cotangents(cotangents: Tensor, image: Tensor) -> None:
    """Cotangents are [K, H, W, 3] for the image they belong to.

    Raises:
        ValueError: they are not.
    """
    expected = tuple(image.shape)
    if cotangents.dim() != 4 or tuple(cotangents.shape[1:]) != expected:
        raise ValueError(f"cotangents must be [K, {', '.join(map(str, expected))}], got {tuple(cotangents.shape)}.")


def require_tiles(tiles: Tensor, width: int, height: int, tile: int) -> None:
    """A demand mask has one entry per tile.

    Raises:
        ValueError: it has not.
    """
    rows, columns = -(-height // tile), -(-width // tile)
    if tuple(tiles.shape) != (rows, columns):
        raise ValueError(
            f"the tile mask must be [{rows}, {columns}] for {width}x{height} pixels "
            f"in tiles of {tile}, got {tuple(tiles.shape)}."
        )


def shares(first: tuple[Splats, Camera], other: tuple[Splats, Camera]) -> bool:
    """Whether two jobs see the same Gaussians from the same pose; opacities and offsets may differ."""
    (a, from_a), (b, from_b) = first, other
    same = all(getattr(a, name) is getattr(b, name) for name in ("means", "quats", "scales", "sh0", "shN"))
    return same and torch.equal(from_a.world_to_camera, from_b.world_to_camera)


def spread(mask: Bool[Tensor, "h w"], times: int, height: int, width: int) -> Bool[Tensor, "H W"]:
    """A mask on a grid `times` as fine, which ends where the image does."""
    return mask.repeat_interleave(times, 0).repeat_interleave(times, 1)[:height, :width]


def packed_rows(shN: Float[Tensor, "N B 3"]) -> Float[Tensor, "N B 3"]:
    """Rows may lie apart (a view of the active bands), but each must be contiguous."""
    return shN if shN.numel() == 0 or shN.stride()[1:] == (3, 1) else shN.contiguous()
