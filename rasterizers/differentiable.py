"""Renderings in the autograd graph of what they show: `autograd.draw` and `as_gsplat.rasterization` are made of `render`, which
draws outside of it, and `in_graph`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any, Final, NamedTuple, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from rasterizers import ahead, replayed_drawing
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, Rendering, SplatGradients, Splats, over
from rasterizers.modes import in_full_precision
from rasterizers.native import empty_for
from rasterizers.pose import pose_gradient
from rasterizers.torch_internals import is_transformed


class Drawn(NamedTuple):
    """An image, and its depth if `draw` had `depth=True`, in the autograd graph of their splats.

    Args:
        depth: the expected depth, see `rasterizers.interface.Rendering.depth`. A loss may depend on it where the rasterizer has
            the trait `depth_gradient`.
        means2d: projected centres, pixels. After `backward()` its `.grad` is the screen gradient in 1/pixel; the gradient
            of the positions does not pass through it.
    """

    image: Float[Tensor, "H W 3"]
    alpha: Float[Tensor, "H W"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    depth: Float[Tensor, "H W"] | None = None


TakeColours = Callable[[Float[Tensor, "N 3"], Float[Tensor, "N B1"]], None]
"""Takes a gradient of the spherical harmonics, Y ⊗ ∇rgb, as its factors ∇rgb and Y."""


@dataclass(slots=True, eq=False)
class BackwardHook:
    """A caller's hook on the backward passes that reach a drawing.

    Attributes:
        reached: called in the pass, before the drawing's gradients are computed. If it returns a function, that takes the
            gradient of the colours, and `colors` gets none; None: `colors` gets it.
    """

    reached: Callable[[], TakeColours | None] = lambda: None


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """A rendering, and what it shows.

    Args:
        inputs: the arguments of `draw`, in the autograd graph.
        bands: the number of bands of their colours that are drawn.
        hook: called by backward passes that reach the drawing.
        output: the image in the graph, see `in_graph`.
    """

    rendering: Rendering
    rasterizer: Rasterizer
    camera: Camera
    inputs: Inputs
    bands: int
    hook: BackwardHook = field(default_factory=BackwardHook)
    output: Float[Tensor, "H W 3"] | None = None

    @property
    def image(self) -> Float[Tensor, "H W 3"]:
        """The image in the graph; the rendering's where there is none."""
        return self.rendering.image if self.output is None else self.output

    @property
    def splats(self) -> Splats:
        """What is drawn, outside of any graph."""
        return self.inputs.splats(self.bands)


_collecting: Final = ContextVar[tuple[list[Drawing], ...]]("collecting", default=())
"""The lists to which this thread's drawings are appended, the innermost last."""


@contextmanager
def collected_drawings() -> Iterator[list[Drawing]]:
    """Collects all drawings with gradients that this thread makes in the context. Their VJP takes several cotangents in one pass
    and stops at the drawn tensors.
    """
    drawings: list[Drawing] = []
    before = _collecting.set((*_collecting.get(), drawings))
    try:
        yield drawings
    finally:
        _collecting.reset(before)


def render(
    rasterizer: Rasterizer, inputs: Inputs, bands: int, camera: Camera, *, depth: bool, replays: bool = False
) -> Drawing:
    """Draw without autograd; `in_graph` makes the result differentiable.

    Args:
        replays: allows a replay, which expects a backward pass.
    """
    if is_transformed():
        raise NotImplementedError(
            "the transforms of torch.func (grad, vmap, jvp …) do not pass through a rasterizer. Use torch.autograd.grad, one "
            "drawing at a time."
        )
    if depth:
        _require_trait(rasterizer, "depth")
    with torch.no_grad():
        if replays and not ahead.is_active():
            rendering = replayed_drawing.draw(rasterizer, inputs.drawn(bands), camera, depth=depth)
        else:
            rendering = ahead.draw(rasterizer, inputs.splats(bands), camera, depth=depth)
    return Drawing(rendering, rasterizer, camera, inputs, bands)


def in_graph(
    drawing: Drawing,
    means2d: Float[Tensor, "M 2"],
    rows: Int[Tensor, " M"] | None = None,
    *,
    pose: Float[Tensor, "4 4"] | None = None,
    absgrad: Float[Tensor, "M 2"] | None = None,
) -> Drawn:
    """The drawing as a differentiable function of its inputs, the projected centres and the pose.

    Args:
        rows: the Gaussians whose centres `means2d` holds; None: all.
        absgrad: each backward pass adds Σ|∂L/∂u| over the pixels, of these rows.
    """
    if absgrad is not None:
        _require_trait(drawing.rasterizer, "absgrad")
    image, alpha, visible, depth = _Draw.apply(  # type: ignore[no-untyped-call]
        drawing, rows, absgrad, pose, means2d, *drawing.inputs
    )
    for drawings in _collecting.get() if image.grad_fn is not None else ():
        drawings.append(replace(drawing, output=image))
    return Drawn(image, alpha, means2d, visible, depth)


_WITH: Final = {
    "depth": ("draws no depth", "cpp, torch, warp and gsplat do"),
    "absgrad": ("has no absolute gradients", "cpp, torch and warp do"),
}


def _require_trait(rasterizer: Rasterizer, name: str) -> None:
    """Raise a ValueError for a rasterizer without the trait "depth" or "absgrad"."""
    if not getattr(rasterizer.traits, name):
        lacks, others = _WITH[name]
        raise ValueError(f"{type(rasterizer).__name__} {lacks} (its traits.{name} is False); {others}.")


_POSE: Final = 3  # among the arguments of `_Draw.forward`
_COLORS: Final = 5 + Inputs._fields.index("colors")


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, drawing: Drawing, rows: Tensor | None, absgrad: Tensor | None, pose: Tensor | None, means2d: Tensor,
        *inputs: Tensor | None
    ) -> Any:  # fmt: skip
        ctx.drawing, ctx.rows, ctx.absgrad, rendering = drawing, rows, absgrad, drawing.rendering
        ctx.pose = None if pose is None else (pose.device, pose.dtype)
        ctx.mark_non_differentiable(visible := rendering.visible.data)
        ctx.set_materialize_grads(False)
        # `.data` makes other tensors with the same memory: ctx and an output that it holds would keep each other alive.
        alpha, depth = rendering.alpha.data, None if rendering.depth is None else rendering.depth.data
        # The gradient of depth reads alpha and depth: saved tensors let torch refuse it if one was changed in place.
        ctx.save_for_backward(*inputs, *([] if depth is None else [alpha, depth]))
        return rendering.image.data, alpha, visible, depth

    @staticmethod
    @in_full_precision
    @once_differentiable  # a second derivative would silently be 0
    def backward(ctx: Any, d_image: Tensor | None, d_alpha: Tensor | None, _: None, d_depth: Tensor | None) -> Any:
        drawing = ctx.drawing
        rendering, rasterizer, camera, inputs = drawing.rendering, drawing.rasterizer, drawing.camera, drawing.inputs
        layers: dict[str, Any] = {"alpha": d_alpha, "depth": d_depth}
        layers = {name: d[None] for name, d in layers.items() if d is not None and bool(d.any())}
        takes_layers = rasterizer.traits.depth_gradient
        if "depth" in layers and not takes_layers:  # else a part of the loss would silently have no gradient
            raise NotImplementedError(
                f"the loss depends on a rendered depth, which has no gradient in {type(rasterizer).__name__} (its "
                "traits.depth_gradient is False); detach it, draw with cpp or torch, or let rasterizers.rasterization draw it."
            )
        take_colours = drawing.hook.reached()
        ctx.saved_tensors  # noqa: B018 - raises if one was changed in place since it was drawn
        if d_image is None:
            d_image = torch.zeros_like(rendering.image)
        if takes_layers or not layers:
            drawn, more = [(rendering, d_image)], layers
        else:
            # I(b) = C + T b with the colour C, T = 1 - alpha and the background b: the difference of two images has T's gradient.
            b = rasterizer.background
            other = (0.0 if b[0] > 0.5 else 1.0, *b[1:])
            d_red = torch.zeros_like(d_image)
            d_red[..., 0] = layers["alpha"][0] / (other[0] - b[0])
            over_other = over(rasterizer, other)(drawing.splats, camera)
            drawn, more = [(rendering, d_image + d_red), (over_other, -d_red)], {}
        if ctx.absgrad is not None:
            more = more | {"absgrad": True}
        each = [cast(Any, image).vjp(cotangent[None], **more) for image, cotangent in drawn]
        if ctx.absgrad is not None:
            total = sum(g.absgrad[0] for g in each)
            ctx.absgrad.add_(total if ctx.rows is None else total[ctx.rows])
        names = ("screen", "means", "quats", "scales", "opacities", "rgb")
        screen, *geometry, rgb = (
            sum((getattr(g, name)[0] for g in each[1:]), getattr(each[0], name)[0]) for name in names
        )
        basis, colors = each[0].basis, None
        if take_colours is not None:
            take_colours(rgb, basis)
        elif ctx.needs_input_grad[_COLORS]:
            colors = outer(rgb, basis, inputs.colors.shape[1])
        pose = None
        if ctx.needs_input_grad[_POSE]:
            means, quats, scales, opacities = (x[None] for x in geometry)
            g = SplatGradients(means, quats, scales, opacities, screen[None], rgb[None], basis)
            pose = pose_gradient(drawing.splats, camera, g).to(*ctx.pose)
        screen = screen if ctx.rows is None else screen[ctx.rows]
        return None, None, None, pose, screen, *geometry, colors, None if inputs.rgb_offset is None else rgb


def outer(rgb: Float[Tensor, "N 3"], basis: Float[Tensor, "N B1"], bands: int) -> Float[Tensor, "N K 3"]:
    """The gradient of the colours from its factors, Y ⊗ ∇rgb; of the `bands`, those that were not drawn have gradient 0."""
    drawn = torch.mul(basis[..., None], rgb[:, None], out=empty_for(basis, (*basis.shape, 3)))
    return drawn if bands == basis.shape[1] else torch.nn.functional.pad(drawn, (0, 0, 0, bands - basis.shape[1]))


def stacked(tensors: Sequence[Tensor]) -> Tensor:
    """The tensors stacked; a single one is not copied."""
    together: Tensor = tensors[0][None] if len(tensors) == 1 else _Stack.apply(*tensors)  # type: ignore[no-untyped-call]
    return together


class _Stack(torch.autograd.Function):
    """`torch.stack` into recycled memory: new pages for eight images take a tenth of the time of drawing them."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        return torch.stack(tensors, out=empty_for(tensors[0], (len(tensors), *tensors[0].shape)))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        return gradient.unbind()
