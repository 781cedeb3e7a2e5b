"""The base class of backends; checks of what they are given, and what more than one of this package does with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from itertools import pairwise
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Camera, RasterSettings, Rendering, Splats, Traits

_SHAPES: Final = {  # of a row; B is the number of higher bands
    "means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": ("B", 3), "rgb_offset": (3,),
}  # fmt: skip


class Backend(RasterSettings):
    """A rasterizer that is made of `traits` and `draw`, which a subclass implements."""

    __slots__ = ()

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Draw each job, with depth or without. All have the same pose and the same tensors, so that they may share work;
        opacities and offsets may differ.
        """
        raise NotImplementedError

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return self.draw([(splats, camera)], [depth])[0]

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        """See `Rasterizer.render_scales`. Jobs of different poses or tensor objects are drawn one by one."""
        depths = depth or [False] * len(jobs)
        if all(
            (
                from_a.world_to_camera is from_b.world_to_camera
                or torch.equal(from_a.world_to_camera, from_b.world_to_camera)
            )
            and all(getattr(a, name) is getattr(b, name) for name in ("means", "quats", "scales", "sh0", "shN"))
            for (a, from_a), (b, from_b) in pairwise(jobs)
        ):
            return self.draw(jobs, depths)
        return [self(*job, depth=z) for job, z in zip(jobs, depths, strict=True)]


def packed_rows(sh: Float[Tensor, "N B 3"]) -> Float[Tensor, "N B 3"]:
    """The tensor with contiguous rows. A view of the active bands has gaps between its rows, and is returned as it is."""
    return sh if sh.numel() == 0 or sh.stride()[1:] == (3, 1) else sh.contiguous()


def of_accumulated(
    rendering: Rendering, alpha: Float[Tensor, "K H W"] | None, depth: Float[Tensor, "K H W"] | None
) -> tuple[Float[Tensor, "K H W"] | None, Float[Tensor, "K H W"] | None]:
    """The cotangents of alpha A and of the accumulated depth D = A E from those of A and of the expected depth E = D / A.

    Raises:
        ValueError: the rendering has no depth, or a cotangent is not [K, H, W].
    """
    for name, cotangent in (("alpha", alpha), ("depth", depth)):
        drawn = getattr(rendering, name)
        if cotangent is not None and (drawn is None or cotangent.dim() != 3 or cotangent.shape[1:] != drawn.shape):
            raise ValueError(
                f"cotangents of {name} must be [K, {', '.join(map(str, rendering.alpha.shape))}] of a rendering that has it, "
                f"got {tuple(cotangent.shape)} of one {'without; draw with depth=True' if drawn is None else 'with it'}."
            )
    like = rendering.alpha
    alpha = None if alpha is None else alpha.detach().to(like)
    if depth is None or rendering.depth is None:
        return alpha, None
    d_D = torch.where(like > 0, depth.detach().to(like) / like, 0.0)
    d_A = -rendering.depth * d_D
    return d_A if alpha is None else d_A + alpha, d_D


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
