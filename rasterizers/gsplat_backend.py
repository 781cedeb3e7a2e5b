"""gsplat's CUDA kernels behind the interface: to train on what the ecosystem trains on, and to measure against it.

Its own autograd does the transpose, one pass for each cotangent, and its cut-offs are its own (alpha 1/255 to 0.999,
transmittance 1e-4); sums are made by atomics, so two runs differ in their last bits. Not yet run on a GPU here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rasterizers.checks import build, require_cotangents, require_finite, require_tiles, spread
from rasterizers.geometry import SH_C0, spherical_harmonics
from rasterizers.interface import (
    BackendUnavailable,
    Camera,
    Rasterizer,
    RasterSettings,
    Rendering,
    SplatGradients,
    Splats,
    Traits,
)

_OWN: Final = {"alpha_min": 1 / 255, "alpha_max": 0.99, "transmittance_min": 1e-4}  # what "default" is called here


def create(**settings: Any) -> Rasterizer:
    """The backend called "gsplat"; `settings` are the fields of `RasterSettings`.

    Raises:
        BackendUnavailable: gsplat is not installed, or there is no CUDA.
        ValueError: a cut-off other than the default, which gsplat does not let one choose.
    """
    try:
        from gsplat.rendering import rasterization
    except ImportError as error:
        raise BackendUnavailable(
            f"the gsplat rasterizer needs gsplat, which cannot be imported ({error}); pip install 'clear-strategies[gsplat]'."
        ) from error
    if not torch.cuda.is_available():
        raise BackendUnavailable(
            "the gsplat rasterizer draws on CUDA only, and torch finds no CUDA device; cpp draws on a CPU."
        )
    return build(GsplatRasterizer, {"rasterization": rasterization, **settings})


@dataclass(frozen=True, slots=True)
class GsplatRasterizer(RasterSettings):
    """gsplat's `rasterization`, or a function of its shape.

    Args:
        device: where the splats' tensors lie.
    """

    rasterization: Callable[..., Any] = field(kw_only=True)
    device: str = "cuda"

    dtypes: ClassVar[frozenset[torch.dtype]] = frozenset({torch.float32})

    def __post_init__(self) -> None:
        RasterSettings.__post_init__(self)
        for name, own in _OWN.items():
            if getattr(self, name) != own:
                raise ValueError(
                    f"gsplat's cut-offs cannot be chosen; {name} must stay {own:g}, got {getattr(self, name):g}."
                )

    @property
    def traits(self) -> Traits:
        return Traits(
            frozenset({self.device}), self.dtypes, shared_pass=False, shared_scales=False, deterministic=False
        )

    def __call__(self, splats: Splats, camera: Camera, tiles: Bool[Tensor, "th tw"] | None = None) -> GsplatRendering:
        """Draw.

        Raises:
            ValueError: the splats lie elsewhere, are not float32 or not finite; or the tile mask has another shape.
        """
        if tiles is not None:
            require_tiles(tiles, camera.width, camera.height, self.tile)
        if splats.means.device.type != self.device or splats.means.dtype != torch.float32:
            raise ValueError(
                f"gsplat draws float32 tensors on {self.device}, got {splats.means.dtype} on {splats.means.device}."
            )
        require_finite(splats)
        names = ("means", "quats", "scales", "opacities", "sh0", "shN")
        with torch.enable_grad():
            leaves = {name: getattr(splats, name).detach().requires_grad_() for name in names}
            offset = splats.means.new_zeros(len(splats), 3) if splats.rgb_offset is None else splats.rgb_offset.detach()
            leaves["rgb"] = offset.clone().requires_grad_()
            still = torch.zeros_like(leaves["quats"])
            still[:, 0] = 1  # a zero quaternion is the identity and gets no gradient
            quats = torch.where(leaves["quats"].abs().amax(-1, keepdim=True) > 0, leaves["quats"], still)
            base = leaves["sh0"] + leaves["rgb"][:, None] / SH_C0
            K = splats.means.new_tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
            images, alphas, info = self.rasterization(
                leaves["means"], quats, leaves["scales"], leaves["opacities"], torch.cat((base, leaves["shN"]), 1),
                camera.world_to_camera.to(splats.means)[None], K[None], camera.width, camera.height,
                near_plane=self.near, eps2d=self.kernel, sh_degree=math.isqrt(splats.shN.shape[1] + 1) - 1, packed=False,
                backgrounds=splats.means.new_tensor(self.background)[None],
                rasterize_mode="antialiased" if self.antialiased else "classic",
            )  # fmt: skip
        radii = info["radii"][0]
        visible = (radii > 0).all(-1) if radii.dim() == 2 else radii > 0
        asked = None if tiles is None else spread(tiles, self.tile, camera.height, camera.width)[..., None]
        image = images[0] if asked is None else torch.where(asked, images[0], images[0].new_tensor(self.background))
        direction = torch.nn.functional.normalize(splats.means.detach() - camera.center.to(splats.means), dim=-1)
        basis = spherical_harmonics(direction, splats.shN.shape[1])
        alpha = alphas[0, ..., 0].detach()
        alpha = alpha if asked is None else alpha * asked[..., 0]
        return GsplatRendering(
            image.detach(), alpha, info["means2d"].detach()[0], visible, images, {**leaves, "screen": info["means2d"]},
            basis, asked,
        )  # fmt: skip

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], tiles: Sequence[Bool[Tensor, "_ _"] | None] | None = None
    ) -> list[Rendering]:
        """One after the other: nothing is shared."""
        masks = [None] * len(jobs) if tiles is None else tiles
        return [self(splats, camera, mask) for (splats, camera), mask in zip(jobs, masks, strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class GsplatRendering:
    """A picture and its transpose, by gsplat's graph.

    Args:
        drawn: [1, H, W, 3], in the graph of `leaves`. asked: pixels of the demand mask, None: all.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    drawn: Float[Tensor, "1 H W 3"]
    leaves: dict[str, Tensor]
    basis: Float[Tensor, "N B1"]
    asked: Bool[Tensor, "H W 1"] | None

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        require_cotangents(cotangents, self.image)
        pulled = []
        for cotangent in cotangents if self.asked is None else cotangents * self.asked:
            gradients = torch.autograd.grad(
                self.drawn, list(self.leaves.values()), cotangent[None], retain_graph=True, materialize_grads=True
            )
            pulled.append(dict(zip(self.leaves, gradients, strict=True)))

        def of(name: str) -> Tensor:
            return torch.stack([g[name] for g in pulled])

        return SplatGradients(
            of("means"), of("quats"), of("scales"), of("opacities"), of("screen")[:, 0], of("rgb"), self.basis
        )
