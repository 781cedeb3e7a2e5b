"""The hooks of a run's strategies: which strategy answers each, and its answer, checked."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from numbers import Real
from typing import Any, Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.checks import is_color
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, ScreenGradients, Shot, in_our_shapes
from clear_strategies.core.step import Losses, Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import AnswerError, SettingError, StrategyConflict
from clear_strategies.merging.logs import IterationLogs
from clear_strategies.merging.objective import Objective
from clear_strategies.strategies.answers import (
    is_real,
    refuse,
    require_finite,
    require_finite_cotangents,
    require_not_negative,
    require_stored,
    rows_like,
    unchanged,
)
from clear_strategies.strategies.base import (
    ONE_ANSWER,
    RunFacts,
    Scale,
    Strategy,
    begin,
    by_class,
    by_exp_and_sigmoid,
    overrides,
    unused,
)
from rasterizers.guards import iteration
from rasterizers.interface import Camera, Color, Rasterizer, Splats
from rasterizers.modes import apart_from_the_loop

_log = logging.getLogger(__name__)

_ALSO_BY: Final = {"reconcile": ("correct",)}  # hooks that may be overridden instead


class Hooks:
    """Calls the strategies, in the order of the methods. `Conductor` computes losses and merges gradients.

    Args:
        strategies: in any order, which has an effect on `compare` alone.
        objective: the losses and their weights.

    Attributes:
        comparing: the strategies that override `compare`, the outermost first.
        regularizers: the strategies that override `regularize`.
        showing: the strategies that override `extra_views`.
        views: the argument of `on_fit_start`.
        run: what the strategies know of the run, which `on_fit_start` begins; None before it.
        logs: the scalars that the strategies have logged in this iteration, which begins with `gate` or `Conductor.gradients`.
        work_log: which work was done, and which was skipped.

    Raises:
        SettingError: what is given is no strategy.
        StrategyConflict: two strategies answer a question that only one may.
    """

    def __init__(self, strategies: Sequence[Strategy], objective: Objective) -> None:
        for given in strategies:
            # An __init__ of one's own makes no state.
            if not (isinstance(given, Strategy) and hasattr(given, "state")):
                raise SettingError(
                    "a conductor takes strategies one by one, made by the __init__ of their dataclass, as "
                    f"Conductor(GCO(), P2G()), got {given!r:.80}."
                )
        self.strategies = tuple(strategies)
        self.objective = objective
        self.views: tuple[View, ...] = ()
        self.run: RunFacts | None = None
        self.logs = IterationLogs(strategies)
        self.work_log = WorkLog()
        self.comparing = [s for s in strategies if overrides(s, "compare")]
        self.regularizers = [s for s in strategies if overrides(s, "regularize")]
        self.showing = [s for s in strategies if overrides(s, "extra_views")]
        self._pulled_at: int | None = None  # the last iteration in which `regularized` found a gradient
        self._answering = {hook: _only(strategies, hook) for hook in ONE_ANSWER}
        for s in strategies:
            for sentence in unused(type(s)):
                _log.warning("%s", sentence)

    def owner(self, hook: str) -> Strategy | None:
        """The strategy that answers a hook which only one may answer; None: no strategy does."""
        s = self._answering[hook]
        return None if type(s) is Strategy else s

    @apart_from_the_loop
    def on_fit_start(
        self, n_views: int, seed: int, device: torch.device | str = "cpu", views: Sequence[View] = (),
        splats: Callable[[Mapping[str, Tensor]], Splats] | None = None, rasterizer: Rasterizer | None = None,
    ) -> None:  # fmt: skip
        """Once, before the first iteration.

        Args:
            device: of the field. views: all training views, where the caller has them.
            splats: see `Strategy.splats`; None: exp and sigmoid. rasterizer: see `Strategy.rasterizer`.
        """
        self.work_log.device, self.views, self.logs = torch.device(device), tuple(views), IterationLogs(self.strategies)
        # Arithmetic with numpy's numbers overflows.
        λ = self.objective.lambda_hr
        self.run = RunFacts(self.work_log.device, int(seed), λ, splats or by_exp_and_sigmoid, rasterizer)
        for s in self.strategies:
            begin(s, self.run, n_views)
            if overrides(s, "on_views"):
                with self.work_log.stage("views prepared"):
                    s.on_views(views)

    def warn_without_effect(self, lambda_hr: float) -> None:
        """Log the strategies that change nothing, where the largest λ_HR(t) of the run is this."""
        for s in self.strategies:
            why = s.without_effect(
                lambda_lr=self.objective.lambda_lr, lambda_hr=lambda_hr, lambda_hf=self.objective.lambda_hf
            )
            if why is not None:
                _log.warning("%s has no effect: %s.", type(s).__name__, why)

    def trains(self, run: RunFacts | None) -> bool:
        """Return True if this conductor and its strategies have begun `run`, and no other one since."""
        return run is self.run and (run is None or all(s.of_run is run for s in self.strategies))

    def require_run(self, run: RunFacts | None) -> None:
        """Raise a StrategyConflict if the conductor or one of its strategies takes part in another run by now."""
        if not self.trains(run):
            raise StrategyConflict(
                "the strategies of this loop have begun anew for another one since, or are copies. Make a conductor for each "
                "loop, with strategies of its own."
            )

    @apart_from_the_loop
    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | Float[Tensor, "2 N"] | None:
        """zᵗ, before render; None: every Gaussian takes part."""
        self.logs.begin(t)
        s = self._answering["gate"]
        z = s.gate(t, n)
        if z is None:
            if self.owner("gate") is not None:
                self.work_log.skip("gate", "no Gaussian is dropped at this rate")
            return None
        shape, scales = ((n,), "") if s.shares_gate else ((2, n), ", a row for LR and one for HR,")
        if not is_real(z, shape):
            refuse(s, "gate", f"a tensor {[*shape]}{scales} or None", z)
        require_not_negative(s, "gate", "z", z)
        return z.detach().float().contiguous()  # kernels read nothing else

    def background(self, t: int) -> Color | None:
        """The colour behind every rendering of iteration t; None: the scene's own."""
        s = self._answering["background"]
        color: Any = s.background(t)
        if color is None:
            return None
        if not is_color(color):
            refuse(s, "background", "three numbers in [0, 1] or None", color)
        return color[0], color[1], color[2]

    def looked_up(self, view: View) -> Tensor | None:
        """`Strategy.looked_up` of the strategy that observes, for `Step.looked_up`."""
        return self._answering["observe"].looked_up(view)

    def comparison(
        self, scale: Scale, photo: Photo, step: Step, losses: Callable[[Tensor], Losses]
    ) -> Callable[[Tensor], Losses]:
        """The comparison of an image with its photo: `losses`, the objective's, within those of the strategies."""
        for s in reversed(self.comparing):
            losses = partial(_compared, s, scale, photo, step, losses)
        return losses

    def observed(self, step: Step, hr: Shot) -> Step:
        """The step with the evidence q, a, w of the HR render.  Eq. 9, 10"""
        s = self._answering["observe"]
        e, n = s.observe(step, hr), len(hr.visible)
        if e is None:
            return replace(step, evidence=None)
        if not isinstance(e, Evidence):
            refuse(s, "observe", "an Evidence or None", e)
        for name in ("reliability", "demand"):
            if not is_real(getattr(e, name), (n,)):
                refuse(s, "observe", f"an Evidence whose {name} is a tensor [{n}]", getattr(e, name))
        return replace(step, evidence=e)

    def route(self, step: Step, n: int) -> float | Float[Tensor, " N"]:
        """m, how much of its high-frequency gradient each of the n Gaussians gets.  Eq. 12"""
        s = self._answering["route"]
        answer: Any = s.route(step)
        if not (isinstance(answer, Real) or is_real(answer, (n,))):
            refuse(s, "route", f"a number or a tensor [{n}]", answer)
        m: float | Tensor = answer
        if not isinstance(m, Tensor):
            require_finite(s, "route", {"m": m})
        return m

    def score(self, step: Step, screen: ScreenGradients) -> Float[Tensor, " N"]:
        """The densification score; the ordinary one where no strategy has another.  Eq. 14"""
        s = self._answering["score"]
        score, n = s.score(step, screen), len(screen.ordinary)
        if score is None:
            return screen.ordinary
        if not is_real(score, (n,)):
            refuse(s, "score", f"a tensor [{n}] or None", score)
        require_finite(s, "score", {"S": score})  # a Gaussian whose score is NaN would never grow
        return score.to(screen.ordinary.dtype)  # kernels read nothing else

    def answers(
        self, products: Products | None, both: Callable[[], tuple[Grads, Grads]], params: Mapping[str, Tensor],
        step: Step | None, t: int, *, finite: bool = False,
    ) -> tuple[Weights | Grads, Grads, Mapping[str, Number]]:  # fmt: skip
        """The answers of `reconciled` and `regularized`, and the share of Gaussians in conflict before correction, by group.

        Args:
            products: of g_LR and g^HR; None: HR takes no part.
        """
        answer = Weights() if products is None else self.reconciled(products, step, both, finite=finite)
        conflict = {} if products is None else products.conflict()
        return answer, self.regularized(params, t, finite=finite), conflict

    def reconciled(
        self, products: Products, step: Step | None, both: Callable[[], tuple[Grads, Grads]], *, finite: bool = False
    ) -> Weights | Grads:  # fmt: skip
        """How the strategies reconcile g_HR with g_LR: the weights of `reconcile`, or ĝ_HR if one overrides `correct`.

        Args:
            both: returns g_LR and g^HR in full, which only `correct` needs.
            finite: check also that the answer is finite.

        Raises:
            AnswerError: the answer is not valid.
        """
        s = self._answering["reconcile"]
        if overrides(s, "correct"):
            g_lr, g_hr = both()
            answer = s.correct(in_our_shapes(g_lr), in_our_shapes(g_hr), step)
            # By attributes of g_HR; those that the answer leaves out are 0.
            return rows_like(s, "correct", answer, g_hr, "of g_HR", finite=finite)
        weights, (n, groups), at = s.reconcile(products, step), products.dot.shape, products.dot.device
        if not isinstance(weights, Weights):
            refuse(s, "reconcile", "Weights(keep, remove)", weights)
        for name, w in weights._asdict().items():
            if not (isinstance(w, Real) or is_real(w, (), (n,), (n, groups))):
                by_group = "; w.expand_as(products.dot) gives each Gaussian those of its groups" * is_real(w, (groups,))
                rule = f"Weights whose {name} is a number or a tensor [{n}] or [{n}, {groups}]{by_group}"
                refuse(s, "reconcile", rule, w)
            if isinstance(w, Tensor) and w.device != at:
                rule = f"Weights whose {name} is on {at}, as products.dot, not on {w.device}"
                refuse(s, "reconcile", f"{rule}; {name}.to(products.dot.device) is there", w)
        if finite:
            require_finite(s, "reconcile", weights._asdict())
        return weights

    def regularized(self, params: Mapping[str, Tensor], t: int, *, finite: bool = False) -> Grads:
        """What the strategies add to the merged gradient; empty: nothing.  Eq. 16

        Args:
            finite: check also that the answers are finite.
        """
        total, self._pulled_at = Grads(), None
        for s in self.regularizers:
            with unchanged(s, "regularize", params, "return a gradient, or change it in after_step()"):
                answer = s.regularize(in_our_shapes(params), iteration(t))
            if answer is None:
                self.work_log.skip("regularize", "it adds nothing yet")
                continue
            self._pulled_at = t
            g = rows_like(s, "regularize", answer, params, "of the parameters", finite=finite)
            total = g if not total else total + g
        return total

    @apart_from_the_loop
    def pulls(self, params: Mapping[str, Tensor], t: int) -> bool:
        """Return True if a strategy adds a gradient at t, which moves even Gaussians that no view draws. One that has done so is
        not asked again, since it may count its calls.
        """
        return self._pulled_at == t or any(s.regularize(params, t) is not None for s in self.regularizers)

    @apart_from_the_loop
    def draw(self, t: int, means: Float[Tensor, "N 3"], enlarged: Callable[[Camera, int], Photo]) -> None:
        """Let the strategies render the field, before `extra_views`."""
        for s in self.strategies:
            s.draw(t, means, enlarged)

    @apart_from_the_loop
    def extra_views(self, t: int) -> list[ExtraView]:
        """The pictures that the field should match at t in addition to the view; each gets a step on the LR loss."""
        if self.objective.lambda_lr == 0 or not self.showing:
            return []
        with self.work_log.stage("pictures of extra views"):  # a pseudo view is made when it is first asked for
            return [extra for s in self.showing for extra in _extra_views(s, t)]

    @apart_from_the_loop
    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """After the optimizer steps of an iteration."""
        params = in_our_shapes(params)
        for s in self.strategies:
            asked = dict(params) if overrides(s, "after_step") else {}
            before = {name: _memory(p) for name, p in asked.items()}
            s.after_step(asked, step)  # `asked[name] += …` stores the same tensor again
            of_own = (name for name in {**asked, **before} if asked.get(name) is not params.get(name))
            if moved := [*of_own, *(name for name, memory in before.items() if _memory(params[name]) != memory)]:
                way = f"{moved[0]} in place, by {moved[0]}.copy_(…), {moved[0]} += … or {moved[0]}[…] = …"
                raise AnswerError(f"{type(s).__name__}.after_step() must change {way}; other memory changes nothing.")
            require_stored(s, params)

    def may_densify(self, t: int) -> bool:
        for s in self.strategies:
            answer: Any = s.may_densify(t)
            if answer not in (True, False):  # a forgotten return would end densification
                refuse(s, "may_densify", "True or False", answer)
            if not answer:
                return False
        return True

    @apart_from_the_loop
    def on_resize(self, parents: Int[Tensor, " M"]) -> None:
        for s in self.strategies:
            s.on_resize(parents)

    def on_fit_end(self) -> None:
        """Once, after the last iteration."""
        self.views = ()
        for s in self.strategies:
            s.on_fit_end()
        if self.run is not None:
            self.run.splats = by_exp_and_sigmoid  # the run's own keeps the field

    def state_dict(self) -> dict[str, Tensor]:
        """Every strategy's `state`, as "<class>.<name>", and `run_state`, as "<class>:<name>" ("<class>2" for a second of one
        class).
        """
        return {
            f"{owner}{mark}{name}": x
            for owner, s in by_class(self.strategies).items()
            for mark, tensors in ((".", s.state), (":", s.run_state))
            for name, x in tensors.items()
        }

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Give each strategy its tensors back.

        Raises:
            ValueError: a tensor belongs to no strategy of this conductor.
        """
        by_name = by_class(self.strategies)
        for s in self.strategies:
            s.state.clear()
            s.run_state.clear()
        for key, rows in tensors.items():
            owner, mark, name = re.split(r"([.:])", key, maxsplit=1)
            if owner not in by_name:
                raise ValueError(f"state {key!r} belongs to no strategy of this run ({', '.join(by_name) or 'none'}).")
            s = by_name[owner]
            known = in_our_shapes({name: rows})[name]  # earlier versions stored the host's
            (s.state if mark == "." else s.run_state)[name] = known.to(s.device, copy=True)


def _only(strategies: Sequence[Strategy], hook: str) -> Strategy:
    """The one strategy that answers the hook, or `Strategy` itself with its default."""
    hooks = [hook, *_ALSO_BY.get(hook, ())]
    owners = [s for s in strategies if any(overrides(s, name) for name in hooks)]
    if len(owners) > 1:
        first, second = (type(s).__name__ for s in owners[:2])
        raise StrategyConflict(
            f"{first} and {second} both implement {'() or '.join(hooks)}(); exactly one strategy may. Remove one, or write a "
            "strategy that combines them."
        )
    return owners[0] if owners else Strategy()


def _compared(
    s: Strategy,
    scale: Scale,
    photo: Photo,
    step: Step,
    losses: Callable[[Tensor], Losses],
    image: Float[Tensor, "H W 3"],
) -> Losses:
    """The answer of `compare`."""
    inner: list[Losses] = []

    def noted(image: Float[Tensor, "H W 3"]) -> Losses:
        if inner:  # the memory of the first cotangents is used again
            raise AnswerError(f"{type(s).__name__}.compare() must call losses(image) once, but calls it again.")
        inner.append(losses(image))
        return inner[0]

    with unchanged(s, "compare", {"the image": image}, "it is the rendering; change a copy, image.clone()"):
        found = s.compare(scale, image, photo, step, noted)
    if not inner or not isinstance(found, Losses):
        refuse(s, "compare", "the Losses that losses(image) returns, or these with changes", found)
    shape = inner[0].cotangents.shape
    if not is_real(found.cotangents, tuple(shape)):
        rule = f"Losses whose cotangents are a tensor {[*shape]}; add a loss to one of them"
        refuse(s, "compare", rule, found.cotangents)
    require_finite_cotangents(s, scale, inner[0], found.cotangents)
    return found._replace(values={**inner[0].values, **found.values})


def _memory(p: Tensor) -> tuple[int, torch.Size]:
    """Where a tensor lies, and its shape."""
    return p.data_ptr(), p.shape


def _extra_views(s: Strategy, t: int) -> list[ExtraView]:
    """The answer of `extra_views`."""
    answer: Any = s.extra_views(t)
    extras = [*answer] if isinstance(answer, Iterable) else refuse(s, "extra_views", "a sequence of ExtraView", answer)
    for extra in extras:
        if not isinstance(extra, ExtraView):
            refuse(s, "extra_views", "a sequence of ExtraView", extra)
        shape = extra.photo.image.shape[:2]
        if not is_real(extra.weight, shape):
            refuse(s, "extra_views", f"an ExtraView whose weight is a tensor {[*shape]}, as its photo", extra.weight)
        require_not_negative(s, "extra_views", "the weight", extra.weight)
    return extras
