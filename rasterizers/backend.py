"""The base class of backends, and what more than one of this package does with its arguments."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Camera, RasterSettings, Rendering, Splats


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
