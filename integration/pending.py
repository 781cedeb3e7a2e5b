"""A rendering whose gradients are not merged yet, and the host's backward passes over it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import attrgetter
from typing import Any, Final, cast
from weakref import WeakMethod, WeakValueDictionary

import torch
from torch import Tensor

from clear_strategies.core.gradients import Colour, Grads
from clear_strategies.errors import HostError
from clear_strategies.kernels.reconcile import dense
from clear_strategies.merging.iteration import HrSide
from integration.autograd_shot import HostOutput, OfOthers
from integration.colours import are_accumulated, are_joined
from integration.graph import edge_of
from rasterizers.differentiable import TakeColours
from rasterizers.native import empty_for
from rasterizers.torch_internals import current_pass, hooks_after_accumulation, hooks_on_gradient, version

Reached = Callable[[int], TakeColours | None]
"""Called when a backward pass has reached the nth rendering and no parameter yet; returns the same as
`rasterizers.differentiable.BackwardHook.reached`.
"""


@dataclass(slots=True, eq=False, weakref_slot=True)
class BackwardPass:
    """A backward pass of the host that has reached a rendering. The host's hooks on what it accumulates are called at its end, so
    that they see the merged gradients.

    Args:
        task: torch's number of the pass.
        params: the leaves when it reached the rendering. others: those of `Pending.others`.
        renderings: the numbers of all renderings that it has reached.
        colour: the gradient of sh0 and shN that it has brought as factors, which their `.grad` lacks.

    Attributes:
        before: `.grad` when it reached the rendering, by name, of parameters that had one.
        hooks: of the parameters that it has accumulated.
    """

    task: int
    params: Mapping[str, Tensor]
    others: Sequence[Tensor] = ()
    renderings: set[int] = field(default_factory=set)
    colour: Colour | None = None
    before: dict[str, Tensor] = field(init=False)
    hooks: list[Callable[[], Any]] = field(default_factory=list)
    _found: dict[int, tuple[Tensor | None, int]] = field(init=False)

    def __post_init__(self) -> None:
        grads = {name: p.grad for name, p in self.params.items()}
        self.before = {name: g.detach().clone() for name, g in grads.items() if g is not None}
        leaves = [*self.params.values(), *self.others]
        self._found = {id(p): (p.grad, 0 if p.grad is None else version(p.grad)) for p in leaves}
        _PASSES[self.task] = self
        for hooks in filter(None, map(hooks_after_accumulation, leaves)):
            hooks.update({key: hook if isinstance(hook, _AtTheEnd) else _AtTheEnd(hook) for key, hook in hooks.items()})

    def take(self, rgb: Tensor, basis: Tensor) -> None:
        """Keep the gradient of the colours."""
        self.colour = Colour(rgb, basis)

    def accumulated(self) -> list[str]:
        """The parameters, except for f_det, that the pass has given a gradient."""
        of_colour = () if self.colour is None else ("sh0", "shN")
        given = (name for name, p in self.params.items() if name in of_colour or self.has_given(p))
        return [name for name in given if name != "detail"]

    def has_given(self, leaf: Tensor) -> bool:
        """Whether the pass has added to `.grad` of this leaf."""
        before, written = self._found[id(leaf)]
        now = leaf.grad
        return now is not before or (now is not None and version(now) != written)

    def added(self, names: Iterable[str], scale: float) -> tuple[Grads, dict[str, Tensor]]:
        """∇(λ_LR L_LR), which the pass has added to `.grad` of these parameters times `scale`, and memory for the merged gradient
        of those that are not frozen, in float32 or float64. f_det has no gradient of LR.
        """
        factored = ("detail",) if self.colour is None else ("detail", "sh0", "shN")
        g_lr, out = Grads(), {}
        if self.colour is not None:
            g_lr.colour = self.colour if scale == 1 else Colour(self.colour.rgb * (1 / scale), self.colour.basis)
        for name in names:
            p = self.params[name]
            g = None if p.grad is None or name == "detail" else widened(p.grad.detach())
            if g is not None:
                g = g - self.before[name] if name in self.before else g
                g_lr[name] = g = g if scale == 1 else g * (1 / scale)
            if p.grad is not None or name in factored:
                out[name] = g if g is not None and g.is_contiguous() else empty_for(widened(p.detach()))
        return g_lr, out

    def replace(self, merged: Mapping[str, Tensor], scale: float) -> None:
        """Set `.grad`, in its memory, to what it was before the pass plus the merged gradient times `scale`."""
        for name, gradient in merged.items():
            p, scaled = self.params[name], gradient if scale == 1 else gradient.mul_(scale)
            if name == "detail":  # a pass over LR does not reach it, and calls no hook with HR's gradient
                for hook in [*hooks_on_gradient(p).values()]:
                    changed = hook(scaled)
                    scaled = scaled if changed is None else changed
                if not self.has_given(p):
                    self.hooks += [partial(hook, p) for hook in hooks_after_accumulation(p).values()]
            g = scaled.add_(self.before[name]) if name in self.before else scaled
            if p.grad is None:
                p.grad = g.to(p.dtype)
            elif p.grad.data_ptr() != g.data_ptr():
                p.grad.copy_(g)


_HALF: Final = (torch.float16, torch.bfloat16)


def widened(x: Tensor) -> Tensor:
    """The tensor in the type in which gradients are merged: float32 in place of half precision."""
    return x.float() if x.dtype in _HALF else x


_PASSES: Final = WeakValueDictionary[int, BackwardPass]()
"""Those that run, by their task."""


@dataclass(frozen=True, slots=True)
class _AtTheEnd:
    """A hook on an accumulated gradient, called at the end of a pass that has reached a rendering, and at once in others."""

    hook: Callable[[Tensor], Any]

    def __call__(self, p: Tensor) -> Any:
        if (running := _PASSES.get(current_pass())) is None:
            return self.hook(p)
        return running.hooks.append(partial(self.hook, p))


@dataclass(slots=True, eq=False)
class Pending:
    """A rendering of a training view that waits for the host's backward pass.

    Args:
        nth: its number. t: the iteration. output: None once all trained parameters are merged.
        hr: the gradients of HR; None: HR takes no part. others: what is still to be added of its gradients of other leaves.
        screen: the screen gradient of LR by the number of its pass, if a densifier reads it.
        merged: the parameters whose gradients are merged.
    """

    nth: int
    t: int
    view: str
    output: HostOutput | None
    hr: HrSide | None
    others: OfOthers = field(default_factory=list)
    screen: dict[int, Tensor] = field(default_factory=dict)
    merged: set[str] = field(default_factory=set)

    def listen(self, reached: WeakMethod[Reached], *, to_screen: bool) -> None:
        """Register `reached` for every backward pass over the rendering.

        Hooks that autograd holds must not refer to the attachment or to this object, whose tensors would then never be freed.
        """
        output, nth, screen = cast(HostOutput, self.output), self.nth, self.screen

        def called() -> TakeColours | None:
            return None if (alive := reached()) is None else alive(nth)

        for drawing in output.shot.drawings:
            drawing.hook.reached = called

        def on_gradient(_: Sequence[Tensor]) -> None:  # returns None, so that the gradient stays
            called()

        if any(mark.is_leaf and mark.requires_grad for mark in output.marks):
            raise HostError(
                f"a mark of {self.view} is a leaf, which a backward pass may reach after other parameters. Mark what the loop "
                "gets, e.g. the image."
            )
        for mark in filter(attrgetter("requires_grad"), output.marks):
            edge_of(mark).node.register_prehook(on_gradient)  # stays if the host writes to the mark in place
        centres = output.shot.gradient_slot.tensor
        if to_screen and centres.requires_grad:

            def keep(gradient: Tensor) -> None:
                screen.clear()
                screen[current_pass()] = gradient.detach()

            centres.register_hook(keep)  # type: ignore[no-untyped-call]

    def may_take_factors(self, params: Mapping[str, Tensor]) -> bool:
        """Conditions 2 and 3 of colours.py: whether a pass may bring the colours' gradient as factors."""
        drawing = None if self.output is None else self.output.shot.drawing
        if drawing is None or not self.merged.isdisjoint(("sh0", "shN")):
            return False
        return are_joined(drawing.inputs.colors, params) and are_accumulated(params)

    def routed_of(self, names: Iterable[str], params: Mapping[str, Tensor]) -> Grads:
        """g^HR of these parameters only, and the gradient of f_det."""
        g, wanted = Grads() if self.hr is None else self.hr.routed, {*names, "detail"}
        if wanted.issuperset(params):
            return g
        if g.colour is not None:
            bands = {name: params[name].detach() for name in ("sh0", "shN")}
            g = Grads(g) + dense(Grads(colour=g.colour), bands)
        return Grads({name: rows for name, rows in g.items() if name in wanted})

    def require_alone(self, of: BackwardPass) -> None:
        """Raise a HostError if the pass has also reached another rendering."""
        if of.renderings == {self.nth}:
            return
        if self.nth in of.renderings:
            raise HostError(
                "one backward pass reaches two renderings of training views, but each is merged by itself. With several views "
                "for a step, call backward() after each rendering (see accumulation=), or use joint_loss. For a second pass "
                "over the same view, and for a view that is compared with no photo, call the function that was wrapped, its "
                "__wrapped__."
            )
        raise HostError(
            f"a backward pass reaches an earlier rendering than that of {self.view}, but only the last can be merged. Call "
            "backward() after each rendering; with several views for a step, see accumulation=."
        )

    def has_no_part(self) -> bool:
        """Return True if HR gives a gradient to f_det alone, where all parameters are frozen: LangSplat trains features."""
        return self.hr is not None and not any(bool(g.any()) for _, g in self.others)

    def require_first(self, names: Iterable[str], correcting: str) -> None:
        """Raise a HostError if an earlier pass over the rendering had gradients of these parameters, and a strategy used them."""
        if correcting and (again := [name for name in names if name in self.merged]):
            raise HostError(
                f"a second backward pass over the rendering of {self.view} adds to the gradient of {', '.join(again)}, which is "
                f"merged already, and {correcting} must compare HR with the gradient of the whole loss. Sum the losses and call "
                "backward() once; what is only looked at, take by torch.autograd.grad. For a second pass over the same view, "
                "call the function that was wrapped, its __wrapped__."
            )


def why_nothing_was_merged(pending: Pending | None, trained: Sequence[str]) -> tuple[str, str]:
    """Why a host steps without a merge, and what to do about it.

    Args:
        pending: the last rendering. trained: names of the parameters that require gradients.
    """
    if not trained:
        return (
            "all parameters of the Gaussians are frozen",
            "Let those that should train require gradients, attach once they do, or remove() what was attached.",
        )
    if pending is None or pending.output is None:
        return (
            "none of its renderings was recognised as that of a training view",
            "Check that the training loop renders with the function that was replaced, and with the cameras that were "
            "passed. A loop with `attach` that moves its cameras names the view: with clear.rendering(view): … A loss that has a "
            "step of its own, e.g. of the depth, belongs into the sum with that of the photo.",
        )
    drawings, names = pending.output.shot.drawings, ", ".join(trained)
    if not pending.output.marks and not any(x.requires_grad for d in drawings for x in d.inputs.attributes().values()):
        return (
            f"the rendering of {pending.view} does not depend on {names}",
            "Pass the function tensors that are made of the parameters, with gradients enabled and not detached.",
        )
    return (
        f"no backward() has given {names} a gradient by the rendering of {pending.view}",
        "Take the gradients by loss.backward(), not by torch.autograd.grad, of a loss of that rendering, and render the "
        "parameters that were passed, not copies of them.",
    )
