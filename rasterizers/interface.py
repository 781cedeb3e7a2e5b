"""The contract between splats and pictures: what goes in, what comes out, and how gradients come back.

Everything else in this package implements it; nothing here knows an implementation. A rasterizer maps
`Splats` and a `Camera` to a `Rendering`, and the rendering carries its own transpose: `rendering.vjp`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor


class BackendUnavailable(RuntimeError):
    """A rasterizer that cannot run here. The message says why, and what would make it run."""


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera, OpenCV axes (x right, y down, z forward).

    Pixel (0, 0) spans [0, 1)², so its centre lies at (0.5, 0.5).

    Args:
        world_to_camera: rigid transform, row-major, last row (0, 0, 0, 1).
        fx, fy, cx, cy: focal lengths and principal point, in pixels of a `width` × `height` image.

    Raises:
        ValueError: a size or focal length is not positive, or a number is not finite.
    """

    world_to_camera: Float[Tensor, "4 4"]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.world_to_camera.shape != (4, 4):
            raise ValueError(f"world_to_camera must be 4x4, got {tuple(self.world_to_camera.shape)}.")
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not (all(map(math.isfinite, intrinsics)) and bool(self.world_to_camera.isfinite().all())):
            raise ValueError(f"a camera's numbers must be finite, got {self!r}.")
        if not (self.fx > 0 and self.fy > 0 and self.width > 0 and self.height > 0):
            raise ValueError(
                "focal lengths and image sizes must be positive, got "
                f"fx={self.fx}, fy={self.fy}, width={self.width}, height={self.height}."
            )

    @property
    def center(self) -> Float[Tensor, " 3"]:
        """The camera's position in the world."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def scaled(self, factor: float) -> Camera:
        """The same ray bundle on another pixel grid: C^v at LR is C^v at HR, `scaled(1 / 4)`.

        Raises:
            ValueError: the image size times `factor` is not a whole number of pixels.
        """
        width, height = self.width * factor, self.height * factor
        if abs(width - round(width)) > 1e-6 or abs(height - round(height)) > 1e-6:
            raise ValueError(
                f"{self.width}x{self.height} times {factor} is not a whole number of pixels; "
                f"crop the image to a multiple of {1 / factor:g} first."
            )
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            width=round(width),
            height=round(height),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """Gaussians ready to be drawn: activations applied, nothing learnable left.

    Args:
        quats: wxyz, any norm > 0 (a zero quaternion is drawn as the identity and gets no gradient).
        scales: standard deviations, > 0, world units.
        opacities: 0 means absent; may exceed 1 under inverted dropout (alpha is capped, not opacity).
        sh0, shN: colour as spherical harmonics; `B = (degree + 1)² - 1` active bands in `shN`.
        rgb_offset: the detail feature, added to the colour before its clamp at 0.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    sh0: Float[Tensor, "N 1 3"]
    shN: Float[Tensor, "N B 3"]  # noqa: N815 - gsplat's name
    rgb_offset: Float[Tensor, "N 3"] | None = None

    def __len__(self) -> int:
        return self.means.shape[0]


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """K gradients with respect to the tensors of `Splats`, and to the projected centres.

    A view's colour gradient is rank one, ∇_SH = Y ⊗ ∇_rgb: the factors are kept, `sh0` and `shN` expand.

    Args:
        screen: with respect to the projected centre, in 1/pixel.
        rgb: with respect to the colour before its clamp; also the gradient of `rgb_offset`.
        basis: Y, the spherical harmonics of this view's directions.
    """

    means: Float[Tensor, "K N 3"]
    quats: Float[Tensor, "K N 4"]
    scales: Float[Tensor, "K N 3"]
    opacities: Float[Tensor, "K N"]
    screen: Float[Tensor, "K N 2"]
    rgb: Float[Tensor, "K N 3"]
    basis: Float[Tensor, "N B1"]

    @property
    def sh0(self) -> Float[Tensor, "K N 1 3"]:
        return self.basis[None, :, :1, None] * self.rgb[:, :, None, :]

    @property
    def shN(self) -> Float[Tensor, "K N B 3"]:  # noqa: N802 - gsplat's name
        return self.basis[None, :, 1:, None] * self.rgb[:, :, None, :]


@runtime_checkable
class Rendering(Protocol):
    """A picture and its transpose."""

    @property
    def image(self) -> Float[Tensor, "H W 3"]: ...

    @property
    def alpha(self) -> Float[Tensor, "H W"]: ...

    @property
    def means2d(self) -> Float[Tensor, "N 2"]:
        """u_i = π(μ_i), in pixels; finite for every Gaussian, meaningful for the visible ones."""
        ...

    @property
    def visible(self) -> Bool[Tensor, " N"]:
        """Could touch at least one pixel of the image."""
        ...

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        """Pull K image cotangents back to the splats, in one traversal where the backend can."""
        ...


@dataclass(frozen=True, slots=True)
class Traits:
    """What a backend can do, as data: tests, configuration and the trainer read it.

    Args:
        shared_pass: K cotangents cost one traversal (else a loop, still correct).
        shared_scales: `render_scales` reuses projection, colours and depth order.
        deterministic: bitwise equal on repetition.
        own_threads: computes on threads of its own (`rasterizers.native`), not on torch's.
    """

    devices: frozenset[str]
    dtypes: frozenset[torch.dtype]
    shared_pass: bool
    shared_scales: bool
    deterministic: bool
    own_threads: bool = False


@runtime_checkable
class Rasterizer(Protocol):
    """Draws splats. Implementations share the names of their settings, see `RasterSettings`."""

    @property
    def traits(self) -> Traits: ...

    def __call__(self, splats: Splats, camera: Camera, tiles: Bool[Tensor, "th tw"] | None = None) -> Rendering:
        """Draw; tiles not asked for show the background, and `vjp` honours the mask."""
        ...

    @property
    def tile(self) -> int:
        """Edge of the demand mask's square tiles, px."""
        ...

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], tiles: Sequence[Bool[Tensor, "_ _"] | None] | None = None
    ) -> list[Rendering]:
        """Draw several pixel grids of one camera centre, sharing whatever `is` the same tensor; a demand mask for each."""
        ...


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """The numbers every backend understands.

    Args:
        kernel: variance of the 2D Mip kernel, px² (Mip-Splatting: 0.1).
        near: Gaussians are drawn from this depth on, world units.
        alpha_min: a contribution below it is not blended (1/255: everyone's default).
        alpha_max: cap on a single contribution, in (0, 1).
        transmittance_min: a pixel is finished before its transmittance falls below it.
        tile: edge of the square tiles of the demand mask, px.
        background: RGB in [0, 1].
        antialiased: scale the opacity so that the 2D kernel keeps a splat's total (Mip-Splatting).

    Raises:
        ValueError: a number is outside the range above.
    """

    kernel: float = 0.1
    near: float = 0.2
    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    tile: int = 16
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialiased: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.kernel) and self.kernel >= 0):
            raise ValueError(f"kernel must be a variance >= 0 px², got {self.kernel}.")
        if not (math.isfinite(self.near) and self.near > 0):
            raise ValueError(f"near must be > 0, got {self.near}.")
        if not 0 < self.alpha_min < self.alpha_max < 1:
            raise ValueError(
                f"0 < alpha_min < alpha_max < 1 must hold, got alpha_min={self.alpha_min}, alpha_max={self.alpha_max}."
            )
        if not 0 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min must lie in [0, 1), got {self.transmittance_min}.")
        if self.tile < 1:
            raise ValueError(f"tile must be at least 1 pixel, got {self.tile}.")
        if len(self.background) != 3 or not all(0 <= c <= 1 for c in self.background):
            raise ValueError(f"background must be three numbers in [0, 1], got {self.background}.")


PRESETS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "fast": MappingProxyType({"alpha_min": 1 / 255, "transmittance_min": 1e-4}),
        "accurate": MappingProxyType({"alpha_min": 1 / 4096, "transmittance_min": 1e-5}),
        "exact": MappingProxyType({"alpha_min": 1e-7, "transmittance_min": 1e-9}),
    }
)
"""Cut-offs by name, coarsest first. They, not the arithmetic, decide how far gradients are from those without cut-offs.

"fast" is everyone's default: gradients are off by some 3 %. "accurate" is ten times closer for a fifth more time. At
"exact" float32 itself is what remains, for numeric tests.
"""
