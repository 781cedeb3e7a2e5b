"""The backend "gsplat": gsplat's CUDA kernels, for training with them and for comparison.

The VJP is gsplat's autograd, one pass per cotangent. gsplat's cut-offs are fixed (alpha 1/255 to 0.999, transmittance
1e-4). It sums by atomics, so two runs differ in their last bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.backend import Backend, require_cotangents, require_finite_splats, require_splats
from rasterizers.geometry import SH_C0, basis_from
from rasterizers.interface import BackendUnavailable, Camera, Rendering, SplatGradients, Splats, Traits

_FIXED: Final = {"alpha_min": (1 / 255,), "alpha_max": (0.999, 0.99), "transmittance_min": (1e-4,)}
"""The values that a setting may have; 0.99, the default of RasterSettings, is drawn as 0.999."""


def _gsplat_rasterization() -> Callable[..., Any]:
    if not torch.cuda.is_available():
        raise BackendUnavailable(
            "the gsplat rasterizer draws on CUDA only, and torch finds no CUDA device; cpp draws on a CPU."
        )
    try:
        from gsplat.rendering import rasterization
    except ImportError as error:
        raise BackendUnavailable(
            f"the gsplat rasterizer needs gsplat, which cannot be imported ({error}); pip install 'clear-strategies[gsplat]'."
        ) from error
    function: Callable[..., Any] = rasterization
    return function


@dataclass(frozen=True, slots=True)
class GsplatRasterizer(Backend):
    """gsplat's `rasterization` as a rasterizer.

    Raises:
        BackendUnavailable: gsplat is not installed, or there is no CUDA.
        ValueError: a setting is out of range, or a cut-off is not the default, which gsplat cannot change.
    """

    traits: ClassVar[Traits] = Traits(devices=frozenset({"cuda"}), dtypes=frozenset({torch.float32}), depth=True)

    def __post_init__(self) -> None:
        Backend.__post_init__(self)
        for name, fixed in _FIXED.items():
            if getattr(self, name) not in fixed:
                raise ValueError(
                    f"gsplat's cut-offs cannot be chosen; {name} must stay {fixed[0]:g}, got {getattr(self, name):g}."
                )
        _gsplat_rasterization()

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs share nothing; depth is drawn by gsplat's render mode "RGB+ED"."""
        return [self._drawn(*job, z) for job, z in zip(jobs, depth, strict=True)]

    def _drawn(self, splats: Splats, camera: Camera, depth: bool) -> GsplatRendering:
        require_splats(splats, self.traits)
        require_finite_splats(splats)
        names = ("means", "quats", "scales", "opacities")
        with torch.enable_grad():
            leaves = {name: getattr(splats, name).detach().requires_grad_() for name in names}
            offset = splats.means.new_zeros(len(splats), 3) if splats.rgb_offset is None else splats.rgb_offset.detach()
            leaves["rgb"] = offset.clone().requires_grad_()
            identity = torch.zeros_like(leaves["quats"])
            identity[:, 0] = 1  # a zero quaternion is the identity and gets no gradient
            quats = torch.where(leaves["quats"].abs().amax(-1, keepdim=True) > 0, leaves["quats"], identity)
            base = splats.sh0.detach() + leaves["rgb"][:, None] / SH_C0
            K = splats.means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
            images, alphas, info = _gsplat_rasterization()(
                leaves["means"], quats, leaves["scales"], leaves["opacities"],
                torch.cat((base, splats.shN.detach()), 1),
                camera.world_to_camera.to(splats.means)[None], K[None], camera.width, camera.height,
                near_plane=self.near, eps2d=self.kernel, sh_degree=math.isqrt(splats.shN.shape[1] + 1) - 1, packed=False,
                backgrounds=splats.means.new_tensor(self.background)[None],
                rasterize_mode="antialiased" if self.antialiased else "classic",
                **({"render_mode": "RGB+ED"} if depth else {}),
            )  # fmt: skip
            colors = images[..., :3]
        radii = info["radii"][0]
        visible = (radii > 0).all(-1) if radii.dim() == 2 else radii > 0
        depths = images[0, ..., 3].detach() if depth else None
        basis = basis_from(camera, splats.means.detach(), splats.shN.shape[1])
        return GsplatRendering(
            colors[0].detach().contiguous(), alphas[0, ..., 0].detach(), depths,
            info["means2d"].detach()[0], visible,
            colors, {**leaves, "screen": info["means2d"]}, basis,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class GsplatRendering:
    """An image, and its VJP through gsplat's autograd graph.

    Args:
        colors: the image, in the graph of `leaves`.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    depth: Float[Tensor, "H W"] | None
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    colors: Float[Tensor, "1 H W 3"]
    leaves: dict[str, Tensor]
    basis: Float[Tensor, "N B1"]

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        require_cotangents(cotangents, self.image)
        leaves = list(self.leaves.values())
        by_cotangent = [
            torch.autograd.grad(self.colors, leaves, cotangent[None], retain_graph=True, materialize_grads=True)
            for cotangent in cotangents
        ]
        g = dict(zip(self.leaves, map(torch.stack, zip(*by_cotangent, strict=True)), strict=True))
        return SplatGradients(**{**g, "screen": g["screen"][:, 0]}, basis=self.basis)
