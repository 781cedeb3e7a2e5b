"""Rasterizers as differentiable torch functions.

`draw` returns a rendering that is part of the autograd graph. `rasterization` has the signature of gsplat's function, so
that a loop written for gsplat runs on a CPU. Each backward pass handles one cotangent; `Rendering.vjp` handles several, and
`recorded` gives it to callers of code that draws.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from enum import Enum
from typing import Any, Final, NamedTuple, ParamSpec, TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

import rasterizers
from rasterizers.checks import require_depth
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Rasterizer, RasterSettings, Rendering, Splats, over
from rasterizers.reference.projection import footprints

# Arguments of gsplat 1.5 that change its speed, or leave out Gaussians that are too small or too far to matter.
_WITHOUT_EFFECT: Final = {
    "sparse_grad", "tile_size", "radius_clip", "far_plane", "channel_chunk", "distributed", "segmented",
}  # fmt: skip
# The only value that this package draws of each other argument; None for one that is not listed.
_SUPPORTED: Final = {"camera_model": "pinhole", "with_ut": False, "with_eval3d": False, "rolling_shutter": "GLOBAL"}


_TAKEN: Final = {
    "means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height", "near_plane", "eps2d", "sh_degree",
    "packed", "backgrounds", "render_mode", "absgrad", "rasterize_mode", "backend", "rgb_offset",
}  # fmt: skip


class Drawn(NamedTuple):
    """An image, and its depth if `draw` had `depth=True`, in the autograd graph of their splats.

    Args:
        depth: the expected depth, see `rasterizers.interface.Rendering.depth`. A loss must not depend on it.
        means2d: projected centres, pixels. After `backward()` its `.grad` is the screen gradient in 1/pixel; the gradient
            of the positions does not pass through it.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    depth: Float[Tensor, "H W"] | None = None


TakeColours = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N B1"]], None]
"""Gets a gradient of the spherical harmonics Y ⊗ ∇rgb by its factors: ∇rgb and Y."""


@dataclass(slots=True, eq=False)
class BackwardHook:
    """What a caller does when a backward pass reaches a drawing.

    Attributes:
        reached: called in the pass, before the gradients of the drawing exist. It returns where this pass brings the gradient of
            the colours, which `colors` then does not get; None: `colors` gets it, as every other tensor.
    """

    reached: Callable[[], TakeColours | None] = lambda: None


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """What `draw` drew.

    Args:
        inputs: means, quats, scales, opacities and colors [N, K, 3] as they were given, and image: as it was returned, all in
            the autograd graph.
        hook: of the backward passes that reach it.
    """

    rendering: Rendering
    inputs: Mapping[str, Tensor]
    image: Float[Tensor, "H W 3"]
    hook: BackwardHook


class _Recordings(threading.local):
    """The lists that the drawings of this thread are added to, the innermost last."""

    def __init__(self) -> None:
        self.running: list[list[Drawing]] = []


_recordings: Final = _Recordings()


@contextmanager
def recorded() -> Iterator[list[Drawing]]:
    """What this thread draws with gradients inside, by any code. Its VJP takes several cotangents in one pass and stops at what
    was drawn.
    """
    drawings: list[Drawing] = []
    outer = _recordings.running
    _recordings.running = [*outer, drawings]
    try:
        yield drawings
    finally:
        _recordings.running = outer


class _Ahead(threading.local):
    """One image that is drawn together with another, before it is asked for.

    Attributes:
        wanted: what the image shows, see `_shown`: its camera alone.
        kept: that image, what it shows, and the splats: while these live, no other tensors lie at their addresses.
    """

    wanted: Camera | None = None
    kept: tuple[tuple[Any, ...], Rendering, Splats] | None = None

    def draw(self, rasterizer: Rasterizer, splats: Splats, camera: Camera) -> Rendering:
        """The image, from `kept` where it lies there."""
        if self.kept is not None and self.kept[0] == _shown(rasterizer, splats, camera):
            rendering, self.kept = self.kept[1], None
            return rendering
        wanted = self.wanted
        if wanted is None or camera.world_to_camera.tolist() != wanted.world_to_camera.tolist():
            return rasterizer(splats, camera)
        self.wanted = None
        plain = replace(splats, rgb_offset=None)
        if splats.rgb_offset is None and _grid(camera) == _grid(wanted):  # it is this one
            return rasterizer(splats, camera)
        other = replace(wanted, world_to_camera=camera.world_to_camera)  # by the same tensor, as a backend sees at once
        ahead, rendering = rasterizer.render_scales([(plain, other), (splats, camera)])
        self.kept = _shown(rasterizer, plain, other), ahead, plain
        return rendering


_ahead: Final = _Ahead()


def _grid(camera: Camera) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


def _shown(rasterizer: Rasterizer, splats: Splats, camera: Camera) -> tuple[Any, ...]:
    """What an image shows: equal for equal images, as long as the tensors are alive."""
    tensors = (getattr(splats, field.name) for field in fields(Splats))
    memory = [None if x is None else (x.data_ptr(), x.shape, x.stride(), x._version) for x in tensors]
    return rasterizer, memory, _grid(camera), camera.world_to_camera.tolist()


@contextmanager
def drawing_ahead(viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int) -> Iterator[None]:
    """The first drawing inside from this pose brings along the one of the same splats by K and without `rgb_offset`.

    A later drawing inside of just that takes it: the two share projection, colour and depth order. It is forgotten with the
    block.
    """
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    _ahead.wanted, _ahead.kept = Camera(viewmat.detach(), fx, fy, cx, cy, width, height), None
    try:
        yield
    finally:
        _ahead.wanted = _ahead.kept = None


_P = ParamSpec("_P")
_R = TypeVar("_R")


def uncompiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function, which `torch.compile` leaves as it is where compiled code calls it: the kernels take memory, not traces."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if torch.compiler.is_compiling():
            apart: Callable[_P, _R] = torch.compiler.disable(function)  # type: ignore[no-untyped-call]
            return apart(*args, **kwargs)  # made here, since at import it would take a second
        return function(*args, **kwargs)

    return called


@uncompiled
def draw(
    rasterizer: Rasterizer,
    splats: Splats,
    camera: Camera,
    means2d: Tensor | None = None,
    *,
    depth: bool = False,
    colors: Float[Tensor, "N K 3"] | None = None,
) -> Drawn:
    """Draw the splats. Gradients flow from the image and its alpha to the splats' tensors; depth has none.

    A loss of alpha draws the splats a second time, over another background, and takes a second backward pass.

    Args:
        means2d: a tensor that receives the projected centres and whose `.grad` will be the screen gradient; None makes one.
        depth: also draw the expected depth.
        colors: the tensor that `splats.sh0` and `splats.shN` are slices of, for a caller that has them as one.

    Raises:
        ValueError: the rasterizer lacks the trait `depth` that `depth=True` needs, or the pose requires a gradient.
        NotImplementedError: in `backward`, if the loss depends on the depth.
        RuntimeError: in `backward`, if the loss depends on these gradients, e.g. by a gradient penalty.
    """
    if colors is None:
        colors = torch.cat((splats.sh0, splats.shN), 1)
    inputs = _Inputs(splats.means, splats.quats, splats.scales, splats.opacities, colors, splats.rgb_offset)
    rendered = _render(rasterizer, inputs, 1 + splats.shN.shape[1], camera, depth=depth)
    if means2d is None:
        means2d = rendered.rendering.means2d.clone().requires_grad_()
    else:
        means2d.data.copy_(rendered.rendering.means2d)
    return _in_graph(rendered, inputs, means2d)


class _Inputs(NamedTuple):
    """The tensors that a drawing is a function of. The colours are one tensor, as hosts have them: autograd would fill others as
    wide with zeros for the gradient of a slice.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    colors: Float[Tensor, "N K 3"]
    rgb_offset: Float[Tensor, "N 3"] | None

    def splats(self, bands: int) -> Splats:
        """The same without their graph, with the first bands of the colours."""
        means, quats, scales, opacities, colors, offset = (x if x is None else x.detach() for x in self)
        return Splats(means, quats, scales, opacities, colors[:, :1], colors[:, 1:bands], offset)  # type: ignore[arg-type, index]


class _Rendered(NamedTuple):
    rendering: Rendering
    rasterizer: Rasterizer
    camera: Camera
    bands: int  # of the colours


def _render(rasterizer: Rasterizer, inputs: _Inputs, bands: int, camera: Camera, *, depth: bool) -> _Rendered:
    if depth:
        require_depth(rasterizer)
    _require_still(camera.world_to_camera)
    splats = inputs.splats(bands)
    with torch.no_grad():
        rendering = rasterizer(splats, camera, depth=True) if depth else _ahead.draw(rasterizer, splats, camera)
    return _Rendered(rendering, rasterizer, camera, bands)


def _require_still(poses: Tensor) -> None:
    if torch.is_grad_enabled() and poses.requires_grad:  # silence would leave the pose as it is
        raise ValueError(
            "poses have no gradient in this package, and camera.world_to_camera (viewmats) requires one; detach it, or draw "
            "with gsplat's own rasterization on a GPU."
        )


def cameras_of(viewmats: Float[Tensor, "C 4 4"], Ks: Float[Tensor, "C 3 3"], width: int, height: int) -> list[Camera]:
    """Gsplat's cameras. Equal ones are the same object, whose numbers a backend then has on the device."""
    poses = zip(viewmats.detach().tolist(), Ks.detach().tolist(), strict=True)
    return [_camera(tuple(map(tuple, pose)), viewmats.dtype, *K[0][::2], *K[1][1:], width, height) for pose, K in poses]


@functools.lru_cache(maxsize=1024)
def _camera(
    pose: tuple[tuple[float, ...], ...], dtype: torch.dtype, fx: float, cx: float, fy: float, cy: float, width: int, height: int
) -> Camera:  # fmt: skip
    return Camera(torch.tensor(pose, dtype=dtype, device="cpu"), fx, fy, cx, cy, width, height)


def _in_graph(
    rendered: _Rendered, inputs: _Inputs, means2d: Float[Tensor, "M 2"], rows: Int[Tensor, " M"] | None = None
) -> Drawn:
    """What was rendered, as a function of the inputs and of the projected centres, those of all or of these rows."""
    hook = BackwardHook()
    image, alpha, visible, depth = _Draw.apply(rendered, rows, hook, means2d, *inputs)  # type: ignore[no-untyped-call]
    for drawings in _recordings.running if image.grad_fn is not None else ():
        drawings.append(
            Drawing(rendered.rendering, {k: x for k, x in inputs._asdict().items() if k != "rgb_offset"}, image, hook)
        )
    return Drawn(image, alpha, means2d, visible, depth)


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rendered: _Rendered, rows: Tensor | None, hook: BackwardHook, means2d: Tensor, *inputs: Tensor | None
    ) -> Any:  # fmt: skip
        ctx.rendered, ctx.rows, ctx.hook, rendering = rendered, rows, hook, rendered.rendering
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(visible := rendering.visible.data)
        ctx.set_materialize_grads(False)
        # Other tensors over the same memory: an output that ctx holds would hold ctx in turn, and nothing would free either.
        depth = None if rendering.depth is None else rendering.depth.data
        return rendering.image.data, rendering.alpha.data, visible, depth

    @staticmethod
    @once_differentiable  # a second derivative would silently be 0
    def backward(ctx: Any, d_image: Tensor | None, d_alpha: Tensor | None, _: None, d_depth: Tensor | None) -> Any:
        if d_depth is not None and bool(d_depth.any()):  # silence would leave out a part of the loss
            raise NotImplementedError(
                "the loss depends on a rendered depth, which has no gradient in this package; detach it, or draw with "
                "gsplat's own rasterization on a GPU."
            )
        take_colours = ctx.hook.reached()
        rendering, rasterizer, camera, bands = ctx.rendered
        inputs = _Inputs(*ctx.saved_tensors)  # raises if one was changed in place since it was drawn
        if d_image is None:
            d_image = torch.zeros_like(rendering.image)
        if d_alpha is None or not bool(d_alpha.any()):
            drawn = [(rendering, d_image)]
        else:
            # With C the colour and T = 1 - alpha, I(b) = C + T b. The difference of two backgrounds has the gradient of T.
            b = rasterizer.background
            other = (0.0 if b[0] > 0.5 else 1.0, *b[1:])
            d_red = torch.zeros_like(d_image)
            d_red[..., 0] = d_alpha / (other[0] - b[0])
            over_other = over(rasterizer, other)(inputs.splats(bands), camera)
            drawn = [(rendering, d_image + d_red), (over_other, -d_red)]
        each = [image.vjp(cotangent[None]) for image, cotangent in drawn]
        names = ("screen", "means", "quats", "scales", "opacities", "rgb")
        screen, *geometry, rgb = (
            sum((getattr(g, name)[0] for g in each[1:]), getattr(each[0], name)[0]) for name in names
        )
        screen = screen if ctx.rows is None else screen[ctx.rows]
        basis, colors = each[0].basis, None
        if take_colours is not None:
            take_colours(rgb, basis)
        elif ctx.needs_input_grad[8]:
            colors = outer(rgb, basis, inputs.colors.shape[1])
        return None, None, None, screen, *geometry, colors, None if inputs.rgb_offset is None else rgb


def outer(rgb: Float[Tensor, "N 3"], basis: Float[Tensor, "N B1"], bands: int) -> Float[Tensor, "N K 3"]:
    """The gradient of the colours from its factors, Y ⊗ ∇rgb, for as many bands; those that were not drawn have gradient 0."""
    drawn = basis[..., None] * rgb[:, None]
    return drawn if bands == basis.shape[1] else torch.nn.functional.pad(drawn, (0, 0, 0, bands - basis.shape[1]))


@uncompiled
def rasterization(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    colors: Float[Tensor, "N ..."],
    viewmats: Float[Tensor, "C 4 4"],
    Ks: Float[Tensor, "C 3 3"],
    width: int,
    height: int,
    *,  # gsplat has its other arguments in another order
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    backgrounds: Float[Tensor, "C 3"] | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    backend: str = "auto",
    rgb_offset: Float[Tensor, "N 3"] | None = None,
    **more: Any,
) -> tuple[Float[Tensor, "C H W D"], Float[Tensor, "C H W 1"], dict[str, Any]]:
    """Stands in for gsplat's `rasterization` with a backend of this package: pinhole cameras, RGB and expected depth.

    Args:
        colors: [N, K, 3] spherical harmonics with `sh_degree` the active degree, or [N, 3] RGB in
            any range, e.g. normals, if `sh_degree` is None.
        render_mode: "RGB", or "RGB+ED" with the expected depth as a fourth channel of the images, to look at: a loss of
            it raises `NotImplementedError` in `backward`.
        packed: `info` is that of the visible Gaussians of each camera, one after the other. gsplat's default is True, and here
            False, since on a CPU its ellipses take half as long as the image.
        more: gsplat's other arguments. Those that change only how it computes (sparse_grad, tile_size …) have no effect.
        backend: a name of `rasterizers.load`.
        rgb_offset: added to the colours before their clamp at 0, with `sh_degree` only; gsplat has no such argument.

    Returns:
        images, alphas, and what gsplat's strategies read: `means2d` [C, N, 2] (`retain_grad` works),
        `radii` [C, N, 2] (1 for the visible, 0 for the others), `width`, `height`, `n_cameras`. Packed, of M visible Gaussians:
        `means2d` [M, 2], `gaussian_ids`, `camera_ids` and `batch_ids` [M], and in the graph of what they depend on, `depths` [M],
        `conics` [M, 3] and `opacities` [M], times the factor of `rasterize_mode="antialiased"`; `radii` [M, 2] in pixels.

    Raises:
        ValueError: a mode or an argument that only gsplat supports, poses that require a gradient, or a wrong shape.
        TypeError: an argument after `height` is given by position.
    """
    _require_supported(render_mode, rasterize_mode, absgrad, more)
    _require_shapes(len(means), colors, viewmats, Ks, backgrounds, sh_degree)
    behind = [[0.0] * 3] * len(viewmats) if backgrounds is None else backgrounds.tolist()
    low, span = (0.0, 1.0) if sh_degree is not None else _low_and_span(colors, behind)
    if sh_degree is None and rgb_offset is not None:
        raise ValueError(
            "rgb_offset is an offset of spherical harmonics, give sh_degree; RGB takes it as colors + rgb_offset."
        )
    if sh_degree is None:
        colors, sh_degree = ((colors - low) / span - 0.5)[:, None] / SH_C0, 0
    colors = colors.to(means.dtype)  # gsplat takes spherical harmonics in float16, too
    inputs, bands = _Inputs(means, quats, scales, opacities, colors, rgb_offset), (sh_degree + 1) ** 2
    each = []
    _require_still(viewmats)
    for camera, over_color in zip(cameras_of(viewmats, Ks, width, height), behind, strict=True):
        background = tuple((x - low) / span for x in over_color)
        rasterizer = over(
            _loaded(backend, means.device.type, near_plane, eps2d, rasterize_mode == "antialiased"), background
        )
        each.append(_render(rasterizer, inputs, bands, camera, depth=render_mode == "RGB+ED"))
    info, centres, rows = _packed_info(each, inputs) if packed else _info(each)
    info |= {"width": width, "height": height, "n_cameras": len(each)}
    views = [_in_graph(rendered, inputs, u, i) for rendered, u, i in zip(each, centres, rows, strict=True)]
    images, alphas = _stacked([view.image for view in views]), _stacked([view.alpha for view in views])[..., None]
    if (low, span) != (0.0, 1.0):
        images = low + span * images
    if backgrounds is not None and backgrounds.requires_grad:  # adds 0, whose gradient is the background's
        images = images + (1 - alphas.detach()) * (backgrounds - backgrounds.detach())[:, None, None]
    depths = [view.depth for view in views if view.depth is not None]
    return torch.cat((images, torch.stack(depths)[..., None]), -1) if depths else images, alphas, info


def rasterizer_of(arguments: Mapping[str, Any], backend: str) -> Rasterizer:
    """The rasterizer that draws the colours of a call of gsplat's `rasterization`, over a black background.

    Args:
        arguments: of the call, by name. backend: of `rasterizers.load`.

    Raises:
        ValueError: this package does not draw the same: an argument that only gsplat supports, other colours than spherical
            harmonics, several cameras.
        BackendUnavailable: the backend is not installed, or has no such device.
    """
    more = {name: value for name, value in arguments.items() if name not in _TAKEN}
    mode = arguments.get("rasterize_mode", "classic")
    _require_supported("RGB", mode, False, more)
    n, colors, sh_degree = len(arguments["means"]), arguments["colors"], arguments.get("sh_degree")
    if sh_degree is None or arguments["means"].dim() != 2 or arguments["means"].dtype != torch.float32:
        raise ValueError("only float32 Gaussians of one scene with spherical harmonics are drawn.")
    _require_shapes(n, colors, arguments["viewmats"], arguments["Ks"], arguments.get("backgrounds"), sh_degree)
    near, eps2d = arguments.get("near_plane", 0.01), arguments.get("eps2d", 0.3)
    return _loaded(backend, arguments["means"].device.type, near, eps2d, mode == "antialiased")


def _info(each: Sequence[_Rendered]) -> tuple[dict[str, Any], Sequence[Tensor], Sequence[None]]:
    """What gsplat's strategies read, and the centres of each image."""
    means2d = torch.stack([rendering.means2d for rendering, *_ in each]).requires_grad_()
    radii = _stacked([rendering.visible for rendering, *_ in each]).int()[..., None].expand(-1, -1, 2)
    return {"means2d": means2d, "radii": radii, "gaussian_ids": None}, means2d.unbind(), [None] * len(each)


def _packed_info(
    each: Sequence[_Rendered], splats: _Inputs
) -> tuple[dict[str, Any], Sequence[Tensor], Sequence[Tensor]]:
    """The same of the visible alone, and which these are."""
    rows = [rendering.visible.nonzero()[:, 0] for rendering, *_ in each]
    columns = []
    for i, (rendering, rasterizer, camera, _) in zip(rows, each, strict=True):
        settings = cast(RasterSettings, rasterizer)  # `over` has checked it
        f = footprints(splats.means[i], splats.quats[i], splats.scales[i], camera, settings.kernel)
        opacities = splats.opacities[i] * f.compensation if settings.antialiased else splats.opacities[i]
        with torch.no_grad():  # where alpha falls below what is drawn
            radii = (2 * (opacities / settings.alpha_min).log()).clamp_min(0).sqrt()[:, None] * f.deviations
        columns.append((rendering.means2d[i], radii.ceil().clamp_min(1).int(), f.depths, f.conics, opacities))
    means2d, radii, depths, conics, opacities = map(torch.cat, zip(*columns, strict=True))
    means2d.requires_grad_()
    ids = torch.cat(rows)
    camera_ids = torch.cat([torch.full_like(i, camera) for camera, i in enumerate(rows)])
    info = {
        "means2d": means2d, "radii": radii, "depths": depths, "conics": conics, "opacities": opacities,
        "gaussian_ids": ids, "camera_ids": camera_ids, "batch_ids": torch.zeros_like(ids),
    }  # fmt: skip
    return info, torch.split(means2d, [len(i) for i in rows]), rows


def _stacked(tensors: Sequence[Tensor]) -> Tensor:
    """One tensor of all; a single one is not copied."""
    return tensors[0][None] if len(tensors) == 1 else torch.stack(list(tensors))


def _low_and_span(colors: Float[Tensor, "N 3"], backgrounds: Sequence[Sequence[float]]) -> tuple[float, float]:
    """RGB in any range is drawn as (RGB - low) / span, with colours >= 0 over backgrounds in [0, 1].

    The weights of a pixel's colours and background sum to 1, so the image is low + span times what is drawn.
    """
    finite = colors.detach().nan_to_num(0, 0, 0)  # NaN is refused by the rasterizer
    low = min(0.0, float(finite.min()) if len(finite) else 0.0, *map(min, backgrounds))
    return low, max(1.0, max(map(max, backgrounds)) - low)


def _require_shapes(
    n: int, colors: Tensor, viewmats: Tensor, Ks: Tensor, backgrounds: Tensor | None, sh_degree: int | None
) -> None:
    cameras = len(viewmats)
    shapes = {
        "viewmats": (viewmats, (cameras, 4, 4)),
        "Ks": (Ks, (cameras, 3, 3)),
        "backgrounds": (backgrounds, (cameras, 3)),
    }
    for name, (value, shape) in shapes.items():
        if value is not None and value.shape != shape:
            inner = ", ".join(map(str, shape[1:]))
            raise ValueError(f"{name} must have the shape [C, {inner}] for C cameras, got {list(value.shape)}.")
    if sh_degree is None and colors.shape != (n, 3):
        raise ValueError(
            f"colors without sh_degree must be RGB of the shape [{n}, 3], got {list(colors.shape)}; draw other channels three "
            "at a time."
        )
    if sh_degree is not None and (colors.dim() != 3 or colors.shape[1] < (sh_degree + 1) ** 2):
        raise ValueError(
            f"colors with sh_degree={sh_degree} must have the shape [{n}, K, 3] with K >= {(sh_degree + 1) ** 2}, got "
            f"{list(colors.shape)}."
        )


def _require_supported(render_mode: str, rasterize_mode: str, absgrad: bool, more: Mapping[str, Any]) -> None:
    refused = []
    for name in more.keys() - _WITHOUT_EFFECT:
        value, supported = more[name], _SUPPORTED.get(name)
        value = value.name if isinstance(value, Enum) else value
        if value is not supported and not (isinstance(value, str | bool) and value == supported):
            refused.append(f"{name}={value!r}" if isinstance(value, str | bool | int | float) else name)
    if refused:
        raise ValueError(
            f"this stand-in for gsplat's rasterization does not support {', '.join(sorted(refused))}. gsplat's own needs CUDA."
        )
    if render_mode not in ("RGB", "RGB+ED") or rasterize_mode not in ("classic", "antialiased") or absgrad:
        raise ValueError(
            "this stand-in for gsplat's rasterization draws render_mode='RGB' or 'RGB+ED', rasterize_mode='classic' or "
            f"'antialiased', absgrad=False; got {render_mode!r}, {rasterize_mode!r}, {absgrad}. gsplat's own needs CUDA."
        )


@functools.lru_cache(maxsize=8)
def _loaded(name: str, device: str, near: float, kernel: float, antialiased: bool) -> Rasterizer:
    name = rasterizers.fastest(device) if name == "auto" else name
    return rasterizers.load(name, near=near, kernel=kernel, antialiased=antialiased)
