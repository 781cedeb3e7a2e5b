"""A host's rendering as a `Shot`, whose gradients pass through the host's own autograd graph."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.gradients import Grads, gradients_of, summed
from clear_strategies.errors import HostError
from clear_strategies.kernels.reconcile import dense
from clear_strategies.merging.iteration import HrSide
from integration.colours import are_joined
from integration.structure import rows_drawn
from rasterizers.differentiable import Drawing, Rendered, outer
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, summed_vjp
from rasterizers.torch_internals import accumulator, hooks_on_gradient, is_hooked, leaf_of

_GOLDEN: Final = 0.6180339887498949  # its multiples modulo 1 differ most for neighbouring rows
_SAME_CODE: Final = 0.1  # tolerance of the ratio of a row's gradients, which e.g. the mean of all rows changes a little


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
        drawn: the rasterizer's means, quats, scales, opacities and colors, none of them with a hook; None: the raw parameters.
            `joint_loss` finds those of this package's rasterizers itself.
        drawings: of this image by this package's rasterizers; a single one takes all cotangents in one pass.
        mask: the image is a drawing outside of any graph, times this mask.
    """

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    params: Mapping[str, Tensor]
    slot: ScreenGradientSlot | None = None
    drawn: Mapping[str, Tensor] | None = None
    drawings: Sequence[Drawing] = ()
    mask: Float[Tensor, "H W 1"] | None = None

    @property
    def drawing(self) -> Drawing | None:
        """The only one of `drawings`; None: another rasterizer drew the image, or it is composed of several drawings."""
        return self.drawings[0] if len(self.drawings) == 1 else None

    @property
    def inputs(self) -> Mapping[str, Tensor] | None:
        """The tensors by whose names `gradients` are; None: the raw parameters."""
        return self.drawn if self.drawing is None else self.drawing.inputs

    @property
    def gradient_slot(self) -> ScreenGradientSlot:
        """`slot`, or `means2d` as one."""
        return self.slot or ScreenGradientSlot(self.means2d, (self.image.shape[1], self.image.shape[0]))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        """∇θ of every cotangent, each with `.screen`; the graph is kept. Frozen parameters have gradient 0."""
        results = []
        for g in self.gradients(cotangents):
            raw, _ = to_leaves(g, self.inputs, self.params)
            detail = g.get("detail") if g.colour is None else g.colour.rgb
            if "detail" in self.params and detail is not None:
                raw["detail"] = detail
            results.append(Grads(every_number(raw, self.params), screen=g.screen))
        return results

    def gradients(
        self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None
    ) -> list[Grads]:  # fmt: skip
        """The first part for every cotangent, by the names of `drawn`; for this package's rasterizers the colours' gradient is
        factors. With `weight`, the result of `core.gradients.summed`.
        """
        if self.drawing is not None:
            return gradients_of(summed_vjp(self.drawing.rendering, self._at_drawing(cotangents), weight))
        each = self._gradients_of_host(cotangents)
        return each if weight is None else summed(each, weight)

    def _gradients_of_host(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        slot = self.gradient_slot
        tensors = {name: x for name, x in (self.drawn or self.params).items() if x.requires_grad}
        projected = [slot.tensor] if slot.tensor.requires_grad else []  # gsplat's 3DGUT draws without projected centres
        f_det = [x for name, x in self.params.items() if name == "detail"]
        results = []
        for cotangent in cotangents:
            with without_hooks(f_det):  # which are called with its merged gradient
                gradients = torch.autograd.grad(
                    self.image, [*tensors.values(), *projected], cotangent, retain_graph=True, allow_unused=True,
                    materialize_grads=True,
                )  # fmt: skip
            screen = gradients[-1] if projected else torch.zeros_like(slot.tensor)
            values = dict(zip(tensors, gradients, strict=False))
            if "detail" in self.params and "detail" not in values and "colors" in values:  # of which f_det is an offset
                rgb = values["colors"]
                values["detail"] = rgb if rgb.dim() == 2 else rgb[:, 0] / SH_C0
            results.append(Grads(values, screen=slot.per_gaussian(screen, len(self.visible))))
        return results

    def _at_drawing(self, cotangents: Float[Tensor, "K H W 3"]) -> Float[Tensor, "K H W 3"]:
        """The cotangents of the rasterizer's image, from which the host may have computed `image`."""
        if self.mask is not None:
            return cotangents * self.mask
        image, drawn = self.image, self.drawing.image  # type: ignore[union-attr]
        if image.data_ptr() == drawn.data_ptr() and image.shape == drawn.shape and image.stride() == drawn.stride():
            return cotangents  # `image` is the whole of it
        return torch.stack([torch.autograd.grad(image, drawn, c, retain_graph=True)[0] for c in cotangents])


OfOthers = list[tuple[Tensor, Tensor]]
"""Other leaves that the loop trains (of a network, an embedding), each with its gradient."""


def side_of_leaves(
    hr: HrSide, drawn: Mapping[str, Tensor] | None, params: Mapping[str, Tensor], scale: float
) -> tuple[HrSide, OfOthers]:
    """The HR side with the gradients of the raw parameters in place of those of the drawn tensors, each with its `.screen`; and
    those of other leaves.

    Args:
        params: without "detail", f_det has no gradient. scale: see `to_leaves`.
    """
    (g, others), detail = to_leaves(hr.g, drawn, params, scale), hr.detail
    g.screen = hr.g.screen
    if detail is not None and "detail" not in params:
        detail = Grads(screen=detail.screen)
    return replace(hr, g=g, detail=detail), others


def to_leaves(
    g: Grads, drawn: Mapping[str, Tensor] | None, params: Mapping[str, Tensor], scale: float = 1.0
) -> tuple[Grads, OfOthers]:
    """The gradients of the raw parameters, without f_det, from those of the drawn tensors, through the host's own graph; and
    those of the other leaves that the drawn tensors were computed from.

    Args:
        g: by the names of `drawn`; the colours' gradient as factors if this package drew them. It stays so if `are_joined`.
        drawn: None: the raw parameters.
        scale: of a gradient scaler, so that small gradients pass through half precision in the graph.
    """
    raw, colour = trained(params), None
    if drawn is None:
        return Grads({name: g[name] for name in raw}), []  # which hooks may have changed
    if g.colour is not None:
        if are_joined(drawn["colors"], params):
            colour = g.colour
        else:
            g = Grads({**g, "colors": outer(g.colour.rgb, g.colour.basis, drawn["colors"].shape[1])})
    direct = {name: g[name] for name, p in raw.items() if drawn.get(name) is p and not is_hooked(p)}
    graph = {name: x for name, x in drawn.items() if name in g and name not in direct and x.requires_grad}
    known = {id(p) for p in params.values()}
    others = [leaf for leaf in graph_of(*graph.values()).leaves if id(leaf) not in known]
    leaves = [*raw.values(), *others]
    if not graph or not leaves:
        return Grads(direct, colour=colour), []
    at_drawn = [g[name] if scale == 1 else g[name] * scale for name in graph]
    through = torch.autograd.grad([*graph.values()], leaves, at_drawn, retain_graph=True, allow_unused=True)
    values = [x if x is None or scale == 1 else x / scale for x in through]
    found = {name: x for name, x in zip(raw, values, strict=False) if x is not None}
    both = {name: direct[name] + found[name] for name in direct.keys() & found.keys()}
    of_others = [(leaf, x) for leaf, x in zip(others, values[len(raw) :], strict=True) if x is not None]
    return Grads({**direct, **found, **both}, colour=colour), of_others


def every_number(g: Grads, params: Mapping[str, Tensor]) -> Grads:
    """The gradients of all parameters in full; 0 for one without a gradient."""
    known = dense(g, params)
    return Grads({name: torch.zeros_like(p) for name, p in params.items() if name not in known} | known)


def are_in_order(drawn: Mapping[str, Tensor] | None, params: Mapping[str, Tensor]) -> bool:
    """Return True if row i of the drawn tensors is computed from row i of the parameters; None: the parameters are drawn.

    A tensor with the parameter's memory is. Any other is tested by two cotangents, whose rows i are 1 and c_i: in the same order,
    the gradients of the parameter's row i are g and c_i g, otherwise g and c_j g. If no tensor has a gradient, positions are
    compared.
    """
    if drawn is None:
        return True
    asked = list[tuple[Tensor, Tensor]]()
    for name in ("opacities", "scales", "means", "quats", "colors"):
        x, p = drawn.get(name), params.get("sh0" if name == "colors" else name)
        if x is None or p is None or x.shape[:1] != p.shape[:1]:
            continue
        if x.data_ptr() == p.data_ptr() and x.stride() == p.stride():
            return True
        if x.requires_grad and p.requires_grad and not is_hooked(p):
            asked.append((x, p))
    answers = set[bool | None]()
    for x, p in asked:
        if (answer := _is_in_order(x, p)) is True:
            return True
        answers.add(answer)
    if asked or "means" not in drawn:
        return False not in answers
    return rows_drawn(drawn["means"].detach(), params["means"].detach()) is None


def _is_in_order(x: Tensor, p: Tensor) -> bool | None:
    """None: x does not depend on p."""
    code = 1 + (torch.arange(len(x), device=x.device, dtype=torch.float64) * _GOLDEN).frac().to(x.dtype)
    plain, coded = (
        torch.autograd.grad(x, p, c, retain_graph=True, allow_unused=True)[0]
        for c in (torch.ones_like(x), code.view(-1, *[1] * (x.dim() - 1)).expand_as(x))
    )
    if plain is None or not bool(plain.any()):
        return None
    plain, coded = plain.reshape(len(p), -1), coded.reshape(len(p), -1)
    off = torch.addcmul(coded, code.to(plain)[:, None], plain, value=-1)
    return bool((off.abs_().sum(1) <= _SAME_CODE * plain.abs_().sum(1)).all())


def trained(params: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The parameters, except for f_det, that require gradients."""
    return {name: p for name, p in params.items() if p.requires_grad and name != "detail"}


def require_leaves(params: Mapping[str, Tensor]) -> None:
    """Raise a HostError if torch would give the gradient of a parameter to another tensor."""
    for name, p in params.items():
        if p.requires_grad and not p.is_leaf:
            raise HostError(
                f"{name} must be a leaf, whose .grad becomes the merged gradient, but it was computed from other tensors (a "
                "slice or a product of a parameter, torch.func.functional_call). Make it a Parameter of its own, and compute "
                "with that in the call of the renderer."
            )


def require_named(shot: object, params: Mapping[str, Tensor]) -> None:
    """Raise a HostError if a rendering names other tensors as its parameters, whose gradients the parameters would get."""
    of_shot = shot.params if isinstance(shot, AutogradShot) else {}
    if other := [name for name, p in of_shot.items() if name in params and p is not params[name]]:
        raise HostError(
            f"AutogradShot.params must hold the parameters themselves, got other tensors as {', '.join(other)}. Pass what is "
            "computed from them, e.g. activated scales, as drawn=."
        )


@contextmanager
def without_hooks(leaves: Sequence[Tensor]) -> Iterator[None]:
    """A context in which gradients reach these leaves past their hooks, which are called with the merged gradient."""
    held = [(hooks, dict(hooks)) for hooks in map(hooks_on_gradient, leaves)]
    for hooks, _ in held:
        hooks.clear()
    try:
        yield
    finally:
        for hooks, each in held:
            hooks.update(each)


class Graph(NamedTuple):
    """The leaves that tensors were computed from, and what this package's rasterizers drew for them."""

    leaves: list[Tensor]
    drawn: list[Rendered]


def graph_of(*tensors: Tensor) -> Graph:
    """The leaves and drawings behind tensors, in one walk. A leaf is its own."""
    graph, seen, nodes = Graph([], []), set[Any](), [accumulator(x) for x in tensors if x.requires_grad]
    while nodes:
        if (node := nodes.pop()) is None or node in seen:
            continue
        seen.add(node)
        if (leaf := leaf_of(node)) is not None:
            graph.leaves.append(leaf)
        elif isinstance(drawn := getattr(node, "rendered", None), Rendered):
            graph.drawn.append(drawn)
        nodes += [before for before, _ in node.next_functions]
    return graph


Target = Literal["lr", "hr"] | Camera
"""What a host renders: the view of this iteration at LR or HR, or the scene from another camera."""


@dataclass(frozen=True, slots=True, eq=False)
class HostOutput:
    """The result of a host's render function, as its adapter passes it to an `Attachment`.

    Args:
        marks: tensors that every backward pass over the rendering reaches before any parameter; a drawing by this package's
            rasterizers needs none. The host must not change them in place.
        returned: the return value of the host's render function.
    """

    shot: AutogradShot
    returned: Any
    marks: Sequence[Tensor] = ()
