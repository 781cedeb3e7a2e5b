"""`diff_gaussian_rasterization`, the CUDA rasterizer of 3DGS and its forks, over this package's rasterizers.

A fork is known by its settings, and gets what its own rasterizer returns:

| settings | trainers | returns |
|---|---|---|
| 3DGS's alone | 3DGS before October 2024, DropGaussian | image, radii |
| the same, and the call unpacks more | Binocular3DGS and others of few views | what it names depth, invdepth or alpha [1, H, W] |
| `antialiasing` | 3DGS | image, radii, inverse depth [1, H, W] |
| `kernel_size`, `subpixel_offset` | Mip-Splatting | image, radii |
| `confidence` | FSGS, NexusGS | image, radii, depth [1, H, W], alpha [1, H, W] |

Depths are sums over a pixel's Gaussians, weighted as their colours are, and differentiable. `means2D.grad` holds the gradient of
the projected centres in NDC; for Mip-Splatting its third column is Σ (|∂L/∂x| + |∂L/∂y|) over the pixels.
"""

from __future__ import annotations

import ast
import functools
import inspect
import linecache
import sys
from collections.abc import Callable, Sequence
from itertools import islice
from types import CodeType
from typing import Any, Final, NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import rasterizers
from clear_strategies.errors import HostError
from rasterizers import autograd
from rasterizers.geometry import constant_band, depths
from rasterizers.gsplat_picture import CameraView
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, Rendering, Splats, WithTraits
from rasterizers.reference.projection import footprints

__path__: Final[list[str]] = []  # so that the import of a part, e.g. of _C, is told as one of a rasterizer
_NEAR: Final = 0.2  # what 3DGS draws begins at this depth
_KERNEL: Final = 0.3  # its 2D kernel's variance, px²


class OwnRasterizerError(HostError, ImportError):
    """A trainer needs what its own CUDA rasterizer has, and none of those above; a trainer may do without, by ImportError.

    Args:
        what: of it the trainer uses.
    """

    def __init__(self, what: str) -> None:
        super().__init__(
            f"this trainer needs its own CUDA rasterizer, for {what}, and with it a GPU. On a CPU images are drawn as by those "
            "of 3DGS, Mip-Splatting, DropGaussian and FSGS."
        )


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    raise OwnRasterizerError(name)


def _refusing(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function, which tells arguments that it does not know."""
    known = inspect.signature(function).parameters

    @functools.wraps(function)
    def refusing(*args: Any, **kwargs: Any) -> Any:
        if unknown := [name for name in kwargs if name not in known]:
            raise OwnRasterizerError(", ".join(unknown))
        return function(*args, **kwargs)

    return refusing


class GaussianRasterizationSettings(NamedTuple):
    """What a rasterizer draws: 3DGS's settings, and behind `debug` those that single forks have.

    Args:
        viewmatrix, projmatrix: world to camera, and world to clip space, both transposed.
        prefiltered, debug: without effect.
        antialiasing: scale the opacities to make up for the blur of the 2D kernel.
        kernel_size: the variance of that kernel, px²; such settings are always antialiased.
        subpixel_offset: must be 0.
        confidence: factors of the gradients; must be 1.
    """

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool = False
    debug: bool = False
    antialiasing: bool | None = None
    kernel_size: float | None = None
    subpixel_offset: Tensor | None = None
    confidence: Tensor | None = None

    def camera(self) -> Camera:
        """The same view for this package's rasterizers."""
        view, width, height = self.viewmatrix.detach(), self.image_width, self.image_height
        projection = torch.linalg.solve(view.double(), self.projmatrix.double())
        cx, cy = (float((projection[2, i] + 1) * size / 2) for i, size in enumerate((width, height)))
        return Camera(view.T.contiguous(), width / 2 / self.tanfovx, height / 2 / self.tanfovy, cx, cy, width, height)


GaussianRasterizationSettings.__new__ = _refusing(GaussianRasterizationSettings.__new__)  # type: ignore[method-assign]


_load: Final = functools.lru_cache(maxsize=8)(rasterizers.load)


class GaussianRasterizer(torch.nn.Module):
    """Draws the image of these settings.

    Raises:
        ValueError: `subpixel_offset` or `confidence` is used, which only the CUDA rasterizers of Mip-Splatting and FSGS have.
        OwnRasterizerError: the call has another argument.
    """

    def __init__(self, raster_settings: GaussianRasterizationSettings) -> None:
        super().__init__()
        self.raster_settings, self._names = raster_settings, cast(Sequence[str], ())
        for name, neutral in (("subpixel_offset", 0), ("confidence", 1)):
            value = getattr(raster_settings, name)
            if value is not None and bool((value != neutral).any()):
                raise ValueError(
                    f"{name} must be {neutral} everywhere on a CPU; other values need the CUDA rasterizer."
                )

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        caller = sys._getframe(1)
        self._names = _unpacked(caller.f_code, caller.f_lasti)
        return super().__call__(*args, **kwargs)

    def markVisible(self, positions: Float[Tensor, "N 3"]) -> Bool[Tensor, " N"]:  # noqa: N802 - the name of 3DGS
        """Whether each position is far enough in front of the camera."""
        return depths(positions.detach(), self.raster_settings.camera().world_to_camera.to(positions)) > _NEAR

    @_refusing
    def forward(
        self,
        means3D: Float[Tensor, "N 3"],
        means2D: Float[Tensor, "N 3"],
        opacities: Float[Tensor, "N 1"],
        shs: Float[Tensor, "N K 3"] | None = None,
        colors_precomp: Float[Tensor, "N 3"] | None = None,
        scales: Float[Tensor, "N 3"] | None = None,
        rotations: Float[Tensor, "N 4"] | None = None,
        cov3D_precomp: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """The image [3, H, W], the radii [N] in pixels (0: not visible), and what the fork adds.

        Args:
            means2D: any values; its gradient will be that of the projected centres.

        Raises:
            ValueError: colours or shapes are given twice, not at all, or as covariances.
        """
        if cov3D_precomp is not None or scales is None or rotations is None:
            raise ValueError(
                "shapes must be given as scales and rotations; cov3D_precomp (--compute_cov3D_python) needs the CUDA "
                "rasterizer."
            )
        if (shs is None) == (colors_precomp is None):
            raise ValueError("exactly one of shs and colors_precomp must be given.")
        s = self.raster_settings
        camera, kernel = s.camera(), _KERNEL if s.kernel_size is None else float(s.kernel_size)
        antialiased = s.kernel_size is not None or bool(s.antialiasing)
        rasterizer = _load(rasterizers.fastest("cpu"), near=_NEAR, kernel=kernel, antialiased=antialiased)
        colors, degree = (colors_precomp, None) if shs is None else (shs, s.sh_degree)
        inputs = Inputs(means3D, rotations, scales * s.scale_modifier, opacities[:, 0], cast(Tensor, colors), None)
        pose = camera.world_to_camera
        view = CameraView(rasterizer, camera, pose, inputs, degree, s.bg.detach(), "RGB", replays=False)
        parts = view.parts()
        drawn = parts[0].drawing.rendering
        absgrad = None if s.kernel_size is None else torch.zeros_like(drawn.means2d)
        centres = drawn.means2d + _gradient_probe(means2D, camera, absgrad)
        image, alpha = view.picture(parts, centres, None, absgrad)
        image = image.permute(2, 0, 1).contiguous()
        radii = _radii(drawn, inputs, camera, rasterizer, kernel)
        names, kinds = self._names, cast(Sequence[str], ())
        star = next((i for i, name in enumerate(names) if name.startswith("*")), len(names))
        if s.confidence is not None:
            kinds = ("depth", "alpha")
        elif s.antialiasing is not None:
            kinds = ("inverse",)
        elif s.kernel_size is None:  # a star may stand for the image and the radii
            kinds = [*map(_kind, (*names[2:star], *(name for name in names[star + 1 :] if "radii" not in name)))]
        fits = len(names) == 2 + len(kinds) if star == len(names) else len(names) <= 3 + len(kinds)
        if names and ("" in kinds or not fits):
            raise OwnRasterizerError(f"what it returns ({', '.join(names)})")

        def drawn_as(kind: str) -> Tensor:
            if kind == "alpha":
                return alpha[None]
            z = depths(means3D, pose.to(means3D))[:, None].clamp_min(_NEAR)
            return _sum(rasterizer, camera, inputs, centres, 1 / z if kind == "inverse" else z)

        return image, radii, *map(drawn_as, kinds)


def _kind(name: str) -> str:
    """What a renderer expects behind the radii, by the name that it gives it; "": unknown."""
    if "depth" in name:
        return "inverse" if "inv" in name else "depth"
    return "alpha" if "alpha" in name else ""


@functools.cache
def _unpacked(code: CodeType, instruction: int) -> Sequence[str]:
    """The names to which this call unpacks its result, one perhaps with a star; none: it does not."""
    here = next(islice(code.co_positions(), instruction // 2, None))
    for node in ast.walk(ast.parse("".join(linecache.getlines(code.co_filename)))):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            call, parts = node.value, node.targets[0].elts
            if here == (call.lineno, call.end_lineno, call.col_offset, call.end_col_offset):
                return [*map(ast.unparse, parts)]
    return ()


def _gradient_probe(
    points: Float[Tensor, "N C"], camera: Camera, absgrad: Float[Tensor, "N 2"] | None
) -> Float[Tensor, "N 2"]:
    """Zeros in px that pass the gradient of the projected centres on to `points`, in NDC.

    With `absgrad`, the gradient's third column is the sum of the absolute gradients, which are then reset to 0.
    """
    half = points.new_tensor((camera.width / 2, camera.height / 2))
    offset = points - points.detach()
    if absgrad is not None and offset.requires_grad:

        def with_absolute(gradient: Tensor) -> Tensor:
            both = torch.cat((gradient[:, :2], (absgrad @ half)[:, None]), 1)
            absgrad.zero_()
            return both

        offset.register_hook(with_absolute)  # type: ignore[no-untyped-call]
    return offset[:, :2] * half


def _sum(
    rasterizer: Rasterizer, camera: Camera, inputs: Inputs, centres: Float[Tensor, "N 2"], values: Float[Tensor, "N 1"]
) -> Float[Tensor, "1 H W"]:
    """Σ w · value of a pixel's Gaussians.

    A backward pass that reaches it draws it once more: most steps have no loss of it, and a strategy takes all gradients of the
    image in one pass where the image is the only drawing.
    """

    def drawn(
        values: Tensor, centres: Tensor, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor
    ) -> Tensor:
        colors = constant_band(values.expand(-1, 3))
        splats = Splats(means, quats, scales, opacities, colors, colors[:, 1:])
        return autograd.draw(rasterizer, splats, camera, centres, colors=colors).image[..., 0][None]

    shapes = centres, *inputs[:4]
    if any(x.requires_grad for x in shapes):
        return cast(Tensor, checkpoint(drawn, values, *shapes, use_reentrant=True, preserve_rng_state=False))
    return drawn(values, *shapes)


@torch.no_grad()
def _radii(
    drawn: Rendering, inputs: Inputs, camera: Camera, rasterizer: Rasterizer, kernel: float
) -> Int[Tensor, " N"]:
    """Three standard deviations along the longer axis, in pixels; 0: not visible."""
    rows = drawn.visible.nonzero()[:, 0]
    if rasterizer.traits.shears:
        shears = cast(WithTraits, drawn).shears[rows]
    else:
        shapes = inputs.means[rows], inputs.quats[rows], inputs.scales[rows]
        shears = footprints(*shapes, camera, kernel).shears
    A, S, D = shears.unbind(-1)  # Σ' = [[1/A + S²/D, -S/D], [-S/D, 1/D]]
    middle = (1 / A + (S * S + 1) / D) / 2
    longest = middle + (middle * middle - 1 / (A * D)).clamp_min(0.1).sqrt()  # the eigenvalue as 3DGS bounds it
    radii = torch.zeros(len(drawn.visible), dtype=torch.int32)
    radii[rows] = (3 * longest.sqrt()).ceil().int()
    return radii
