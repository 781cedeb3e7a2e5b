"""A host's rendering as a `Shot`, whose gradients pass through the host's own autograd graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.gradients import Grads, gradients_of, summed
from clear_strategies.errors import HostError
from clear_strategies.kernels.reconcile import dense
from clear_strategies.merging.iteration import HrSide
from integration.colours import are_joined
from integration.graph import (
    Edge,
    Graph,
    Inputs,
    centres_drawn,
    copied_to,
    edge_of,
    graph_of,
    has_gradient,
    inputs_of,
    joined,
    reaching,
    without_hooks,
)
from rasterizers.differentiable import Drawing, outer
from rasterizers.interface import Camera, summed_vjp
from rasterizers.torch_internals import is_hooked, of_gradient, version

OfOthers = list[tuple[Tensor, Tensor]]
"""Other leaves that the loop trains (of a network, an embedding), each with its gradient."""


@dataclass(frozen=True, slots=True, eq=False)
class ScreenGradientSlot:
    """The tensor in which a host keeps the screen gradient ∇_u, the gradient of the projected centres.

    Args:
        tensor: [N, 2 or more]. It may have leading dimensions of 1 (hosts that batch views), or one row per entry of
            `rows` (hosts that pack visible Gaussians).
        size: (width, height) of the image in pixels.
        to_pixels: factors from the tensor's gradient to a gradient in 1/pixel: (1, 1) in gsplat, whose tensor is in
            pixels; (2 / width, 2 / height) in 3DGS, whose tensor is in NDC.
        rows: the Gaussian of each row; None: row i is Gaussian i.
        ranked: a column after the second that the host only ranks Gaussians by (Mip-Splatting's absolute gradient).
    """

    tensor: Tensor
    size: tuple[int, int]
    to_pixels: tuple[float, float] = (1.0, 1.0)
    rows: Int[Tensor, " M"] | None = None
    ranked: int | None = None

    def per_gaussian(self, gradient: Tensor, n: int) -> Float[Tensor, "N 2"]:
        """∇_u of all N Gaussians in 1/pixel, from a gradient of the tensor."""
        columns = gradient.reshape(-1, gradient.shape[-1]).T
        g = torch.stack([column * factor for column, factor in zip(columns, self.to_pixels, strict=False)], 1)
        return g if self.rows is None else g.new_zeros(n, 2).index_add_(0, self.rows, g)

    def absgrad(self, n: int) -> Float[Tensor, "N 2"] | None:
        """Σ|∂L/∂u| over pixels of all N Gaussians in 1/pixel; None: the host does not keep gsplat's `absgrad`."""
        absgrad = getattr(self.tensor, "absgrad", None)
        return None if absgrad is None else self.per_gaussian(absgrad, n)

    def write(self, norms: Float[Tensor, " N"]) -> None:
        """Set the tensor's `.grad` (and gsplat's `.absgrad`) so that its row norms in NDC units are `norms`.

        Columns after the second keep the host's values, some store absolute gradients there; only `ranked` is written too.
        """
        gradient = torch.zeros_like(self.tensor)
        if self.tensor.grad is not None:
            gradient[..., 2:] = self.tensor.grad[..., 2:]
        rows = norms if self.rows is None else norms[self.rows]
        gradient.view(-1, gradient.shape[-1])[:, 0] = rows.to(gradient) * (2 / self.size[0] / self.to_pixels[0])
        if self.ranked is not None:
            gradient[..., self.ranked] = gradient[..., 0]
        self.tensor.grad = gradient
        if hasattr(self.tensor, "absgrad"):
            self.tensor.absgrad = gradient


@dataclass(frozen=True, slots=True, eq=False)
class AutogradShot:
    """A rendering by a host, differentiable by autograd.

    Gradients are taken in two parts: from the image to the rasterizer's inputs, by a backward pass of the rasterizer, and from
    there through the host's activations to the raw parameters. Both parts are linear, and each Gaussian is activated by itself,
    so gradients can be weighted by Gaussian between the two, and the second part is computed once.

    Args:
        image: a function of `params` and of the tensor that holds the screen gradient.
        means2d: projected centres in pixels.
        visible: Gaussians that contribute to the image.
        params: raw parameters by gsplat's names. A parameter that the image does not depend on has gradient 0.
        slot: where the host keeps the screen gradient; None: the image is a function of `means2d` itself.
        drawn: the rasterizer's means, quats, scales, opacities and colors, none of them with a hook or computed from another;
            None: `joint_loss` and hosts find them where a network needs them.
        drawings: the drawings by this package's rasterizers from which the image is made; a single one takes all cotangents in
            one pass.
        mask: factor of the image, if it is a drawing outside of any autograd graph.
        found: the inputs of another rasterizer, which `joint_loss` and hosts set.
        around: other inputs of the rasterizer, such as the camera; what they are computed from learns from LR alone.
        of_others: receives the gradients of other leaves in each `vjp`.

    Raises:
        HostError: one of `drawn` has no row for each Gaussian.
    """

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    params: Mapping[str, Tensor]
    slot: ScreenGradientSlot | None = None
    drawn: Mapping[str, Tensor] | None = None
    drawings: Sequence[Drawing] = ()
    mask: Float[Tensor, "H W 1"] | None = None
    found: Inputs | None = None
    around: Sequence[Tensor] = ()
    of_others: OfOthers = field(default_factory=list)

    def __post_init__(self) -> None:
        for name, x in (self.drawn or {}).items():
            if x.shape[:1] != self.visible.shape:
                raise HostError(
                    f"AutogradShot: {name} of drawn must have a row for each of the {len(self.visible):,} Gaussians, got "
                    f"{[*x.shape]}. Draw and name what has: of one camera, gsplat's colours without their first dimension."
                )

    @property
    def drawing(self) -> Drawing | None:
        """The only one of `drawings`; None: another rasterizer drew the image, or it is composed of several drawings."""
        return self.drawings[0] if len(self.drawings) == 1 else None

    @property
    def inputs(self) -> Mapping[str, Tensor] | None:
        """The rasterizer's inputs, if they are known."""
        return self.drawn if self.drawing is None else self.drawing.inputs.attributes()

    @property
    def edges(self) -> Mapping[str, Edge] | None:
        """By whose names `gradients` are; None: the raw parameters."""
        return self.inputs if self.found is None else self.found.edges

    @property
    def shared(self) -> Sequence[Tensor]:
        """Leaves beside the parameters of whose gradients `gradients` bring a part only, see `Inputs`."""
        return () if self.found is None else self.found.shared

    @property
    def gradient_slot(self) -> ScreenGradientSlot:
        """`slot`, or `means2d` as one."""
        return self.slot or ScreenGradientSlot(self.means2d, (self.image.shape[1], self.image.shape[0]))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        """See `Shot`; the graph is kept. Frozen parameters have gradient 0."""
        found = self.gradients(cotangents, weight)
        of_hf = [] if weight is None else [found.pop()]  # of f_det alone
        results = []
        for g in found:
            raw, self.of_others[:] = to_leaves(g, self.edges, self.params, shared=self.shared)
            if "detail" in self.params and weight is None:
                detail = g.get("detail") if g.colour is None else self._of_detail(*g.colour)
                raw |= {} if detail is None else {"detail": detail}
            results.append(Grads(every_number(raw, self.params), screen=g.screen))
        return results + [Grads({k: x for k, x in g.items() if k in self.params}, screen=g.screen) for g in of_hf]

    def gradients(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        """The first part of `vjp`, by the names of `drawn`; for this package's rasterizers the colours' gradient is factors."""
        if self.drawing is not None:
            drawn = gradients_of(summed_vjp(self.drawing.rendering, self._at_drawing(cotangents), weight))
            if weight is not None and (colour := drawn[0].colour) is not None:
                drawn[-1]["detail"] = self._of_detail(drawn[-1]["detail"], colour.basis)
            return drawn
        each = self._gradients_of_host(cotangents)
        return each if weight is None else summed(each, weight)

    def _gradients_of_host(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        slot, inputs = self.gradient_slot, self.found or Inputs((), {})
        f_det = {name: x for name, x in self.params.items() if name == "detail"}
        named = {**({} if self.found is not None else self.drawn or self.params), **f_det}
        tensors = {name: x for name, x in named.items() if x.requires_grad}
        projected = [slot.tensor] if slot.tensor.requires_grad else []  # gsplat's 3DGUT draws without projected centres
        asked: list[Any] = [*tensors.values(), *projected]
        edges = [*asked, *inputs.edges.values()]
        # Those of f_det are called with its merged gradient, those of the others as `to_leaves` reaches them.
        hooked = [*f_det.values()] if self.found is None else [*self.params.values()]
        results = []
        for cotangent in cotangents:
            with without_hooks(hooked), inputs.collected() as found:
                # Torch's own nodes and those in C++ compute only what is asked for: the edges, too.
                each: Sequence[Any] = ()
                if edges:  # the loop may have frozen all
                    each = torch.autograd.grad(self.image, edges, cotangent, retain_graph=True, allow_unused=True)
            gradients = [torch.zeros_like(x) if g is None else g for x, g in zip(asked, each, strict=False)]
            screen = gradients[-1] if projected else torch.zeros_like(slot.tensor)
            values = {**found, **dict(zip(tensors, gradients, strict=False))}
            results.append(Grads(values, screen=slot.per_gaussian(screen, len(self.visible))))
        return results

    def _of_detail(self, rgb: Float[Tensor, "N 3"], basis: Float[Tensor, "N B1"]) -> Float[Tensor, "N 3"]:
        """The gradient of f_det from that of the drawn colours: it is their offset, or both are computed from it."""
        detail, inputs = self.params.get("detail"), self.drawing.inputs  # type: ignore[union-attr]
        colors, offset = inputs.colors, inputs.rgb_offset
        if detail is None or (offset is detail and not graph_of(colors).reaches([detail])):
            return rgb
        ways = [(edge_of(x), bands) for x, bands in joined(colors) if graph_of(x).reaches([detail])]
        edges = [edge for edge, _ in ways]
        gradients = [outer(rgb, basis[:, bands], bands.stop - bands.start) for _, bands in ways]
        if offset is not None and graph_of(offset).reaches([detail]):
            edges, gradients = [*edges, edge_of(offset)], [*gradients, rgb]
        if not edges:
            return torch.zeros_like(rgb)
        with without_hooks([detail]):
            return torch.autograd.grad(edges, detail, gradients, retain_graph=True)[0]

    def _at_drawing(self, cotangents: Float[Tensor, "K H W 3"]) -> Float[Tensor, "K H W 3"]:
        """The cotangents of the rasterizer's image, from which the host may have computed `image`."""
        if self.mask is not None:
            return cotangents * self.mask
        image, drawn = self.image, self.drawing.image  # type: ignore[union-attr]
        if image.data_ptr() == drawn.data_ptr() and image.shape == drawn.shape and image.stride() == drawn.stride():
            return cotangents  # `image` is the whole of it
        return torch.stack([torch.autograd.grad(image, drawn, c, retain_graph=True)[0] for c in cotangents])


def of_whole_image(shot: AutogradShot) -> AutogradShot:
    """Without its drawing or `drawn`, if the image depends on parameters by another way, too. Also without its drawing, if the
    image was changed in place, which left no picture to take cotangents of; and without `drawn`, if one of them is computed from
    another, whose ways only a single drawing tells apart.
    """
    return _whole(shot)[0]


def _whole(shot: AutogradShot) -> tuple[AutogradShot, Graph | None]:
    """`of_whole_image`, and the graph beside what is drawn if it was walked."""
    own, drawing, has_drawings = trained(shot.params).values(), shot.drawing, bool(shot.drawings)
    if drawing and (version(drawing.image) or graph_of(shot.image, before=[drawing.image.grad_fn]).reaches(own)):
        shot = replace(shot, drawings=())
    if shot.drawing or shot.drawn is None:
        return shot, None
    around = _beside(shot)
    is_part = around.reaches(own) or (has_drawings and reaching(shot.drawn))
    return (replace(shot, drawn=None), None) if is_part else (shot, around)


def _beside(shot: AutogradShot) -> Graph:
    """The graph of the image around what is known to be drawn."""
    drawn = *(shot.drawn or {}).values(), *shot.around
    return graph_of(shot.image, before=[edge_of(x).node for x in drawn if x.requires_grad])


def at_inputs(shot: AutogradShot, warn: Callable[..., None]) -> AutogradShot:
    """The rendering with its gradients taken at the inputs of its rasterizer, where other leaves than the parameters lie behind
    them (a network, an embedding), so that these learn from HR, too.

    Args:
        warn: called if the inputs are not found, with a message and its values.
    """
    shot, walked = _whole(shot)
    if shot.drawing is not None:
        return shot
    around, centres = walked or _beside(shot), shot.gradient_slot.tensor
    known = {*map(id, shot.params.values())}
    for edge, tensor in ((centres, centres), *centres_drawn(around)):
        known |= {*map(id, copied_to(edge, tensor, shot.params["means"]))}

    def others(behind: Graph) -> list[Tensor]:
        return [leaf for leaf in behind.leaves if id(leaf) not in known]

    def names(leaves: Sequence[Tensor]) -> str:
        return ", ".join(f"{leaf.dtype} {[*leaf.shape]}" for leaf in leaves[:3])

    if not (found := others(around)):
        return shot
    graph = graph_of(shot.image)
    if (inputs := inputs_of(shot.image, graph, centres, shot.params, others(graph))) is None:
        warn(
            "the loop trains %d tensors beside the Gaussians (%s), which learn from LR alone: the inputs of the rasterizer were "
            "not found, or their rows are not those of the parameters. Name them by AutogradShot(drawn=…), or compute them "
            "outside of the function that attach has wrapped.",
            len(found), names(found),
        )  # fmt: skip
        return shot
    if shared := inputs.shared:
        told = "%d tensors (%s) reach the image beside the rasterizer, too, and learn from LR alone."
        warn(told, len(shared), names(shared))
    return replace(shot, found=inputs) if others(graph_of(*inputs.edges.values())) else shot


def side_of_leaves(
    hr: HrSide, drawn: Mapping[str, Edge] | None, params: Mapping[str, Tensor], scale: float, shared: Sequence[Tensor] = ()
) -> tuple[HrSide, OfOthers]:  # fmt: skip
    """The HR side with the gradients of the raw parameters in place of those of the drawn tensors, each with its `.screen`; and
    those of other leaves.

    Args:
        params: without "detail", f_det has no gradient. scale, shared: see `to_leaves`.
    """
    (g, others), detail = to_leaves(hr.g, drawn, params, scale, shared), hr.detail
    g.screen = hr.g.screen
    if detail is not None and "detail" not in params:
        detail = Grads(screen=detail.screen)
    return replace(hr, g=g, detail=detail), others


def to_leaves(
    g: Grads, drawn: Mapping[str, Edge] | None, params: Mapping[str, Tensor], scale: float = 1.0, shared: Sequence[Tensor] = ()
) -> tuple[Grads, OfOthers]:  # fmt: skip
    """The gradients of the raw parameters, without f_det, from those of the drawn tensors, through the host's own graph; and
    those of the other leaves that the drawn tensors were computed from.

    Args:
        g: by the names of `drawn`; the colours' gradient as factors if this package drew them. It stays so if `are_joined`.
        drawn: None: the raw parameters.
        scale: of a gradient scaler, so that small gradients pass through half precision in the graph.
        shared: other leaves that are left out, see `AutogradShot.shared`.
    """
    raw, colour = trained(params), None
    if drawn is None:
        return Grads({name: g[name] for name in raw}), []  # which hooks may have changed
    if g.colour is not None:
        colors = cast(Tensor, drawn["colors"])
        if are_joined(colors, params):
            colour = g.colour
        else:
            g = Grads({**g, "colors": outer(g.colour.rgb, g.colour.basis, colors.shape[1])})
    direct = {name: g[name] for name, p in raw.items() if drawn.get(name) is p and not is_hooked(p)}
    graph = {name: x for name, x in drawn.items() if name in g and name not in direct and has_gradient(x)}
    known = {*map(id, params.values()), *map(id, shared)}
    others = [leaf for leaf in graph_of(*graph.values()).leaves if id(leaf) not in known]
    leaves = [*raw.values(), *others]
    if not graph or not leaves:
        return Grads(direct, colour=colour), []
    edges = [*map(edge_of, graph.values())]
    at_drawn = [g[name].view(of_gradient(edge)[0]) for name, edge in zip(graph, edges, strict=True)]  # some [1, N, …]
    at_drawn = at_drawn if scale == 1 else [x * scale for x in at_drawn]
    through = torch.autograd.grad(edges, leaves, at_drawn, retain_graph=True, allow_unused=True)
    values = [x if x is None or scale == 1 else x / scale for x in through]
    found = {name: x for name, x in zip(raw, values, strict=False) if x is not None}
    both = {name: direct[name] + found[name] for name in direct.keys() & found.keys()}
    of_others = [(leaf, x) for leaf, x in zip(others, values[len(raw) :], strict=True) if x is not None]
    return Grads({**direct, **found, **both}, colour=colour), of_others


def every_number(g: Grads, params: Mapping[str, Tensor]) -> Grads:
    """The gradients of all parameters in full; 0 for one without a gradient."""
    known = dense(g, params)
    return Grads({name: torch.zeros_like(p) for name, p in params.items() if name not in known} | known)


def trained(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parameters, except for f_det, that require gradients."""
    return {name: p for name, p in params.items() if p.requires_grad and name != "detail"}


def require_named(shot: object, params: Mapping[str, Tensor]) -> None:
    """Raise a HostError if a rendering names other tensors as its parameters, whose gradients the parameters would get."""
    of_shot = shot.params if isinstance(shot, AutogradShot) else {}
    if other := [name for name, p in of_shot.items() if name in params and p is not params[name]]:
        raise HostError(
            f"AutogradShot.params must hold the parameters themselves, got other tensors as {', '.join(other)}. Pass what is "
            "computed from them, e.g. activated scales, as drawn=."
        )


Target = Literal["lr", "hr"] | Camera
"""What a host renders: the view of this iteration at LR or HR, or the scene from another camera."""


@dataclass(frozen=True, slots=True, eq=False)
class HostOutput:
    """The result of a host's render function, as its adapter passes it to an `Attachment`.

    Args:
        marks: tensors that every backward pass over the rendering reaches before any parameter, such as the image; not needed
            if one of this package's rasterizers drew it. For a torch view, pass its base, whose autograd node stays if the host
            writes to the view in place.
        returned: the return value of the host's render function.
    """

    shot: AutogradShot
    returned: Any
    marks: Sequence[Tensor] = ()
