"""The interface of a rasterizer: its inputs, its output, and how gradients come back.

A `Rasterizer` maps `Splats` and a `Camera` to a `Rendering`; `rendering.vjp` maps gradients of the image to gradients of
the splats. Every backend in this package implements this interface, and so can a third party:

1. Write a frozen dataclass that inherits from `rasterizers.backend.Backend`. It has the fields of `RasterSettings`, their
   defaults and their checks, and may add settings of its own. Raise `BackendUnavailable` in the constructor if the class
   cannot run on this machine.
2. Implement `traits` and `draw`, which returns objects with the members of `Rendering`. A class that does not inherit from
   `Backend` takes the fields by keyword, and implements the members of `Rasterizer`.
3. Run `rasterizers.testing.check_rasterizer(MyRasterizer)`.
4. Use it by its path, like a strategy: `rasterizer._target_=my_package.MyRasterizer`, or a file `rasterizer/mine.yaml` in
   a Hydra config folder with `_target_` and the settings that differ from the class's defaults.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain
from typing import Final, Protocol, TypeGuard, cast, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class BackendUnavailable(RuntimeError):
    """A backend that cannot run on this machine. The message says why, and what to install."""


class OutdatedKernels(RuntimeError):
    """Compiled kernels that were built from other sources than the present ones. No other backend replaces them."""


Color = tuple[float, float, float]
"""RGB in [0, 1]."""

_RIGID: Final = 1e-3  # tolerance of a rigid transform; files keep few digits


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A pinhole camera, OpenCV axes (x right, y down, z forward).

    Pixel (0, 0) spans [0, 1)², so its centre lies at (0.5, 0.5).

    Args:
        world_to_camera: rigid transform, row-major, last row (0, 0, 0, 1).
        fx, fy, cx, cy: focal lengths and principal point, in pixels of a `width` × `height` image.

    Raises:
        ValueError: a size or focal length is not positive, a size is no integer, a number is not finite, or the transform is
            not rigid within 1e-3.
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
        pose = self.world_to_camera.detach().tolist()
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *chain.from_iterable(pose)))):
            raise ValueError(f"a camera's numbers must be finite, got {self!r}.")
        for name in ("width", "height"):
            size = getattr(self, name)
            try:
                object.__setattr__(self, name, operator.index(size))  # numpy's and torch's integers are no int
            except TypeError:
                raise ValueError(f"{name} must be a whole number of pixels, an int, got {size!r}.") from None
        if not _is_rigid(pose):
            raise ValueError(
                "world_to_camera must be a rotation and a translation, without scale or reflection, and its last row "
                f"0 0 0 1, got {self.world_to_camera.tolist()}."
            )
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
        """The same camera with `factor` times the resolution: the LR camera is the HR camera, `scaled(1 / 4)`.

        Raises:
            ValueError: the image size times `factor` is not a whole number of pixels.
        """
        width, height = self.width * factor, self.height * factor
        if abs(width - round(width)) > 1e-6 or abs(height - round(height)) > 1e-6:
            raise ValueError(
                f"{self.width}x{self.height} times {factor} is not a whole number of pixels; "
                f"crop the image to a multiple of {1 / factor:g} first."
            )
        return self.resized(round(width), round(height))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera with an image of width × height pixels, each axis by its own ratio."""
        x, y = width / self.width, height / self.height
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height)


def _is_rigid(world_to_camera: list[list[float]]) -> bool:
    """True if R Rᵀ = I, det R = 1 and the last row is (0, 0, 0, 1). Without tensors, which would take five times as long."""
    *rows, last = world_to_camera
    a, b, c = (row[:3] for row in rows)

    def dot(u: list[float], v: list[float]) -> float:
        return float(sum(map(operator.mul, u, v)))

    b_cross_c = [b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]]
    zeros = (dot(a, b), dot(a, c), dot(b, c), *last[:3])
    ones = (dot(a, a), dot(b, b), dot(c, c), dot(a, b_cross_c), last[3])
    return all(abs(x) <= _RIGID for x in zeros) and all(abs(x - 1) <= _RIGID for x in ones)


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """Gaussians after their activations, as rasterizers draw them.

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

    def to(self, *where: torch.device | str | torch.dtype) -> Splats:
        """The same on another device or in another type, as of `Tensor.to`."""
        tensors = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{name: x.to(*where) for name, x in tensors.items() if x is not None})


@dataclass(frozen=True, slots=True, eq=False)
class SplatGradients:
    """K gradients with respect to the tensors of `Splats`, and to the projected centres.

    A view's gradient of the spherical harmonics has rank one, ∇_SH = Y ⊗ ∇_rgb. The factors are stored, and `sh0` and `shN`
    multiply them.

    Args:
        screen: the screen gradient, with respect to the projected centre, in 1/pixel.
        rgb: with respect to the colour before its clamp; also the gradient of `rgb_offset`.
        basis: Y, the spherical harmonics of this view's directions.
        absgrad: the sum over pixels of the absolute value of what each adds to `screen` (AbsGS), where it was asked for.

    What `summed` returns has J = K - 1 gradients; else J = K.
    """

    means: Float[Tensor, "J N 3"]
    quats: Float[Tensor, "J N 4"]
    scales: Float[Tensor, "J N 3"]
    opacities: Float[Tensor, "J N"]
    screen: Float[Tensor, "K N 2"]
    rgb: Float[Tensor, "K N 3"]
    basis: Float[Tensor, "N B1"]
    absgrad: Float[Tensor, "K N 2"] | None = None

    @property
    def sh0(self) -> Float[Tensor, "K N 1 3"]:
        return self.basis[None, :, :1, None] * self.rgb[:, :, None, :]

    @property
    def shN(self) -> Float[Tensor, "K N B 3"]:  # noqa: N802 - gsplat's name
        return self.basis[None, :, 1:, None] * self.rgb[:, :, None, :]

    def summed(self, weight: Float[Tensor, " N"]) -> SplatGradients:
        """The last gradient, each Gaussian's row times `weight`, is added to the one before.

        `screen` keeps that of each cotangent, for statistics, and the last of `rgb` is what was added.
        """

        def total(g: Tensor) -> Tensor:
            last = g[-1] * weight.to(g).view(-1, *[1] * (g.dim() - 2))
            return torch.cat((g[:-2], (g[-2] + last)[None], last[None]))

        means, quats, scales, opacities = (total(g)[:-1] for g in (self.means, self.quats, self.scales, self.opacities))
        return SplatGradients(means, quats, scales, opacities, self.screen, total(self.rgb), self.basis)


@runtime_checkable
class Rendering(Protocol):
    """An image, its depth if drawn with `depth=True`, and the VJP that maps gradients of the image to those of the splats."""

    @property
    def image(self) -> Float[Tensor, "H W 3"]: ...

    @property
    def alpha(self) -> Float[Tensor, "H W"]: ...

    @property
    def depth(self) -> Float[Tensor, "H W"] | None:
        """The expected depth of each pixel, world units; None unless drawn with `depth=True`.

        E = Σ wᵢ zᵢ / Σ wᵢ with the blending weights wᵢ = Tᵢ αᵢ and the depths zᵢ of the centres along the camera's axis: "ED"
        in gsplat's terms, the accumulated depth "D" divided by alpha. It is 0 where nothing is drawn. Where alpha is small it
        is that of a few faint Gaussians. `WithTraits.vjp` has its gradient.
        """
        ...

    @property
    def means2d(self) -> Float[Tensor, "N 2"]:
        """Projected centres, in pixels: finite for every Gaussian, meaningful for the visible ones."""
        ...

    @property
    def visible(self) -> Bool[Tensor, " N"]:
        """Whether the Gaussian may contribute to a pixel of the image."""
        ...

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        """The gradients of the splats for K gradients of the image (cotangents), in one pass where the backend can.

        Backends may read the splats' tensors again: call this before they are changed in place. Autograd may be off, here and
        where it was drawn.
        """
        ...


@dataclass(frozen=True, slots=True)
class Traits:
    """What a backend supports, for the trainer, the benchmark and the tests.

    Args:
        devices: "cpu", "cuda" or both: where the splats' tensors may be.
        dtypes: the types that the splats' tensors may have.
        native_threads: it computes on the threads of `rasterizers.native`, not on torch's.
        depth: it draws expected depth. Without this trait, its methods are never called with `depth` and may lack the argument.
        absgrad: `WithTraits.vjp` takes this argument.
        depth_gradient: `WithTraits.vjp` takes alpha and depth. Without this trait, depth has no gradient, and alpha's needs a
            second image.
        radii: its renderings have `WithTraits.radii`.
        shears: its renderings have `WithTraits.shears`.
    """

    devices: frozenset[str]
    dtypes: frozenset[torch.dtype]
    native_threads: bool = False
    depth: bool = False
    absgrad: bool = False
    depth_gradient: bool = False
    radii: bool = False
    shears: bool = False


class WithTraits(Rendering, Protocol):
    """A rendering with every optional feature; a backend's `Traits` say which of them it has."""

    def vjp(
        self,
        cotangents: Float[Tensor, "K H W 3"],
        *,
        absgrad: bool = False,
        alpha: Float[Tensor, "K H W"] | None = None,
        depth: Float[Tensor, "K H W"] | None = None,
    ) -> SplatGradients:
        """See `Rendering.vjp`.

        Args:
            absgrad: also compute `SplatGradients.absgrad`, for the trait of this name.
            alpha, depth: gradients of the same K losses with respect to `Rendering.alpha` and `Rendering.depth`, for the trait
                `depth_gradient`; None: 0.

        Raises:
            ValueError: `depth` is given for a rendering that was drawn without it.
        """
        ...

    def summed_vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"]) -> SplatGradients:
        """See the function of this name, which calls this method if there is one: a backend may sum before the VJP of its
        projection, `SplatGradients.summed` sums after it.
        """
        ...

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """Half the size of each Gaussian's bounding box, px, rounded up; 0 for invisible ones. For the trait of this name.

        As in gsplat, the box ends where alpha falls below `alpha_min`, at 3.33 standard deviations at most.
        """
        ...

    @property
    def shears(self) -> Float[Tensor, "N 3"]:
        """(A, S, D) of each Gaussian's exponent ½(A (dx + S dy)² + D dy²), A and D in 1/px²; meaningful for the visible ones. For
        the trait of this name.
        """
        ...


def summed_vjp(
    rendering: Rendering, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None
) -> SplatGradients:
    """The gradients for all cotangents; those for the last two are summed, the last times `weight`, Gaussian by Gaussian.

    Args:
        weight: None: nothing is summed, as by `Rendering.vjp`.
    """
    if weight is None:
        return rendering.vjp(cotangents)
    if hasattr(rendering, "summed_vjp"):
        return cast(WithTraits, rendering).summed_vjp(cotangents, weight)
    return rendering.vjp(cotangents).summed(weight)


@runtime_checkable
class Rasterizer(Protocol):
    """Draws splats. All backends share the settings of `RasterSettings`."""

    @property
    def traits(self) -> Traits: ...

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        """Draw the splats.

        Args:
            depth: also draw `Rendering.depth`, for a rasterizer with the trait `depth`.
        """
        ...

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        """Draw several resolutions from one pose, each with depth or without; None: none with it.

        Backends may share work between jobs whose splats hold the same tensor objects.
        """
        ...


@runtime_checkable
class Recordable(Rasterizer, Protocol):
    """A rasterizer whose renderings can be part of a `recording.Recording`. It reads from tensors what changes in a replay."""

    def numbers_of(self, camera: Camera, device: torch.device) -> Sequence[Tensor]:
        """The numbers of a camera, in tensors that belong to this camera object. Those of another camera of the same size may be
        copied to them.
        """
        ...

    def background_on(self, device: torch.device) -> Float[Tensor, "1 3"]:
        """The background, in a tensor that must not be changed."""
        ...

    def over_changing(self, background: Float[Tensor, "1 3"]) -> Rasterizer:
        """The rasterizer with a background on the device."""
        ...


def is_recordable(rasterizer: Rasterizer) -> TypeGuard[Recordable]:
    """Whether it is `Recordable`. `isinstance` with a protocol would take a tenth of the host's time in a replay."""
    return hasattr(rasterizer, "over_changing")


@dataclass(frozen=True, slots=True)
class RasterSettings:
    """The settings of every backend.

    Args:
        kernel: variance of the 2D Mip kernel, px² (Mip-Splatting: 0.1).
        near: smallest depth at which a Gaussian is drawn, world units.
        alpha_min: a contribution below it is not blended (1/255: the usual default).
        alpha_max: cap on a single contribution, in (0, 1 - 1e-7], which is below 1 in float32, too.
        transmittance_min: a pixel ends before its transmittance falls below it.
        background: RGB in [0, 1].
        antialiased: scale the opacity to make up for the blur of the 2D kernel (Mip-Splatting).

    Raises:
        ValueError: a number is outside the range above.
    """

    kernel: float = 0.1
    near: float = 0.01
    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4
    background: Color = (0.0, 0.0, 0.0)
    antialiased: bool = True

    def __post_init__(self) -> None:
        if not (math.isfinite(self.kernel) and self.kernel >= 0):
            raise ValueError(f"kernel must be a variance >= 0 px², got {self.kernel}.")
        if not (math.isfinite(self.near) and self.near > 0):
            raise ValueError(f"near must be > 0, got {self.near}.")
        if not 0 < self.alpha_min < self.alpha_max <= 1 - 1e-7:
            raise ValueError(
                f"0 < alpha_min < alpha_max <= 1 - 1e-7 must hold, got alpha_min={self.alpha_min}, alpha_max={self.alpha_max}."
            )
        if not 0 <= self.transmittance_min < 1:
            raise ValueError(f"transmittance_min must lie in [0, 1), got {self.transmittance_min}.")
        object.__setattr__(self, "background", tuple(float(c) for c in self.background))  # any sequence, e.g. Hydra's
        if len(self.background) != 3 or not all(0 <= c <= 1 for c in self.background):
            raise ValueError(f"background must be three numbers in [0, 1], got {self.background}.")

    def with_background(self, background: Color) -> RasterSettings:
        """A copy with another background. A backend that adapts to its images overrides this, so that the copy adapts, too."""
        return replace(self, background=background)


def over(rasterizer: Rasterizer, background: Color | None) -> Rasterizer:
    """The rasterizer with another background, RGB in [0, 1]; itself for None.

    Raises:
        TypeError: it does not have the settings of `RasterSettings`.
    """
    if background is None:
        return rasterizer
    if not isinstance(rasterizer, RasterSettings):
        raise TypeError(
            f"{type(rasterizer).__name__} has no background that could change; derive it from RasterSettings."
        )
    return cast(Rasterizer, rasterizer.with_background(background))


def with_depth(rasterizer: Rasterizer, depth: bool) -> Callable[..., Rendering]:
    """The rasterizer, called with `depth=True` if depth is True: without the trait it may not have the argument."""
    return functools.partial(rasterizer, depth=True) if depth else rasterizer


PRESETS: Final[Mapping[str, Mapping[str, float]]] = {
    "fast": {"alpha_min": 1 / 255, "transmittance_min": 1e-4},
    "accurate": {"alpha_min": 1 / 4096, "transmittance_min": 1e-5},
    "exact": {"alpha_min": 1e-7, "transmittance_min": 1e-9},
}
"""Cut-offs by name, coarsest first. The error of the gradients is due to the cut-offs, not to the arithmetic.

"fast", the default, has gradients that are off by about 3 %. "accurate" has a tenth of that error, for up to a third more time.
At "exact", for numeric tests, only the rounding of float32 remains.
"""
