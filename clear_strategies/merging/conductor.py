"""The conductor calls the strategies in the paper's order and merges the gradients, in every host.  Eq. 8, 13"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Number
from clear_strategies.core.finite import require_finite, require_finite_losses
from clear_strategies.core.gradients import Grads, Shot, screen_norm, screen_of, summed, to_ndc
from clear_strategies.core.step import Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import StrategyConflict
from clear_strategies.kernels import per_gaussian, reconcile
from clear_strategies.kernels.reconcile import dense
from clear_strategies.merging.detail import DetailRates
from clear_strategies.merging.iteration import (
    HrSide,
    LossWeights,
    Merged,
    Stepper,
    Update,
    guarded,
    require_finite_parts,
)
from clear_strategies.merging.logs import IterationLogs
from clear_strategies.merging.objective import Losses, Objective
from clear_strategies.merging.skips import SkipPolicy, Skips
from clear_strategies.strategies import answers
from clear_strategies.strategies.base import LAMBDA_HR, ScreenGradients, Strategy, by_class, misspelled, overrides
from rasterizers.guards import iteration
from rasterizers.interface import Camera, Color
from rasterizers.modes import apart_from_the_loop
from rasterizers.native import empty_for
from rasterizers.recording import running

_log = logging.getLogger(__name__)

P = TypeVar("P")

_UNKNOWN: Final[Mapping[str, Tensor]] = {}
_ONE_ANSWER: Final = ("densifier", "background", "gate", "observe", "route", "reconcile", "score")
_ALSO_BY: Final = {"reconcile": ("correct",)}  # hooks that may be overridden instead


class Conductor:
    """Calls strategies and merges gradients.

    Args:
        strategies: in any order, which has no effect. None at all is the paper's baseline.
        objective: the losses and their weights.
        statistics_from: iteration from which densification statistics need the HR render although λ_HR = 0; None:
            as soon as λ_HR > 0 (F11).
        decorators: each takes a prior and returns one, e.g. `BackProjected`; `prior` applies them in this order.
        detail: the rates of f_det, for hosts.
        skips: work that is left out; None: only what changes nothing.

    Attributes:
        skips: which work of the run is left out.
        regularizers: the strategies that override `regularize`.
        showing: the strategies that override `extra_views`.
        decorated: whether `prior` has been called, or there are no decorators.
        sr: the argument of `prior`; None before it is called.
        views: the argument of `on_fit_start`.
        logs: the scalars that the strategies log.

    Raises:
        StrategyConflict: two strategies answer a question that only one may.
    """

    def __init__(
        self, *strategies: Strategy, objective: Objective | None = None, statistics_from: int | None = 500,
        decorators: Sequence[Callable[[Any], Any]] = (), detail: DetailRates | None = None, skips: Skips | None = None,
    ) -> None:  # fmt: skip
        self.strategies = strategies
        self.objective = objective if objective is not None else Objective()
        self.statistics_from = statistics_from
        self.decorators, self.detail = tuple(decorators), detail if detail is not None else DetailRates()
        self.skips = SkipPolicy(skips)
        self.decorated = not self.decorators
        self.sr: Any = None
        self.work_log = WorkLog()
        self.views: tuple[View, ...] = ()
        self._hr_cotangents: Tensor | None = None
        self.logs = IterationLogs(strategies)
        self._owner = dict.fromkeys(_ONE_ANSWER, Strategy())  # whose hooks are the defaults
        for hook in _ONE_ANSWER:
            hooks = [hook, *_ALSO_BY.get(hook, ())]
            owners = [s for s in strategies if any(overrides(s, name) for name in hooks)]
            if len(owners) > 1:
                first, second = (type(s).__name__ for s in owners[:2])
                raise StrategyConflict(
                    f"{first} and {second} both implement {'() or '.join(hooks)}(); exactly one strategy may. Remove one, or "
                    "write a strategy that combines them."
                )
            if owners:
                self._owner[hook] = owners[0]
        self.regularizers = [s for s in strategies if overrides(s, "regularize")]
        self.showing = [s for s in strategies if overrides(s, "extra_views")]
        others = ("regularize", "draw", "extra_views", "may_densify", "after_step")
        for s in strategies:
            if not any(overrides(s, hook) for hook in (*_ONE_ANSWER, "correct", *others)):
                _log.warning("%s implements no hook; it has no effect.", type(s).__name__)
            for hook, name in misspelled(type(s)).items():
                _log.warning("%s.%s() is no hook: nothing calls it. There is %s().", type(s).__name__, name, hook)

    @apart_from_the_loop
    def on_fit_start(
        self, n_views: int, seed: int, device: torch.device | str = "cpu", views: Sequence[View] = ()
    ) -> None:
        """Once, before the first iteration.

        Args:
            device: of the field. views: all training views, where the caller has them.
        """
        self.work_log.device, self.views = torch.device(device), tuple(views)
        for s in self.strategies:
            s.on_fit_start(n_views, seed)
            answers.require_started(s, seed)
            s.to(device)
            s.cache[LAMBDA_HR] = self.objective.lambda_hr
            if overrides(s, "on_views"):
                with self.work_log.stage("views prepared"):
                    s.on_views(views)

    def on_fit_end(self) -> None:
        """Once, after the last iteration."""
        self._hr_cotangents, self.views = None, ()
        for s in self.strategies:
            s.on_fit_end()

    def prior(self, prior: P) -> P:
        """The prior with every decorator around it, which makes the SR images of a run with this conductor."""
        self.sr = prior
        for decorate in self.decorators:
            prior = decorate(prior)
        self.decorated = True
        return prior

    @apart_from_the_loop
    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | Float[Tensor, "2 N"] | None:
        """zᵗ, before render; None: every Gaussian takes part."""
        z = self._owner["gate"].gate(t, n)
        answers.require_gate(self._owner["gate"], z, n)
        if z is None and self.owner("gate") is not None:
            self.work_log.skip("gate", "no Gaussian is dropped at this rate")
        return None if z is None else z.detach().float()  # kernels read no other type

    def looked_up(self, view: View) -> Tensor | None:
        """`Strategy.looked_up` of the strategy that observes, for `Step.looked_up`."""
        return self._owner["observe"].looked_up(view)

    def background(self, t: int) -> Color | None:
        """The colour behind every rendering of iteration t; None: the scene's own."""
        color = self._owner["background"].background(t)
        answers.require_background(self._owner["background"], color)
        return color

    def wants_hr(self, t: int) -> bool:
        """Whether the HR render is used at t: λ_HR > 0, Î_LR is its area mean, or a densification score needs it."""
        if self.objective.lambda_hr(t) > 0 or not self.wants_lr:
            return True
        collecting = self.statistics_from is not None and t > self.statistics_from
        if self.owner("score") is not None and collecting and self.may_densify(t):
            return True
        self.work_log.skip("render LR + HR", "lambda_HR = 0")
        return False

    @property
    def uses_hr(self) -> bool:
        """Whether HR has any use in some iteration, see `wants_hr`."""
        λ = self.objective.lambda_hr
        return λ.peak > 0 or λ.final > 0 or not self.wants_lr or self.owner("score") is not None

    @property
    def wants_lr(self) -> bool:
        """Whether the LR render has any use; else Î_LR is the area mean of Î_HR."""
        return self.objective.draws_lr

    @apart_from_the_loop
    def update(
        self,
        params: Mapping[str, Tensor],
        lr: Shot | None,
        hr: Shot | None,
        view: View,
        t: int,
        stepper: Stepper | None = None,
        *,
        scored: bool = True,
        looked_up: Tensor | None = None,
    ) -> Update:
        """The merged gradient of one view, in place of `backward()`.

        Args:
            params: raw parameters by attribute. lr, hr: this view rendered at both scales. hr None skips HR; lr None
                stands for the area mean of hr, where `wants_lr` is False or both scales have one size.
            stepper: merges and steps in one pass; None: `merge`, and the caller steps.
            scored: False: no densification reads the scores of this iteration.
            looked_up: see `Step.looked_up`.

        Raises:
            ValueError: a scale that the objective needs was not rendered.
            DivergedError: a loss or a gradient is not finite; `params` and the optimizer are unchanged.
        """
        o, stage = self.objective, self.work_log.stage
        vjp: Callable[..., Sequence[Grads]] = _vjp if stepper is None else stepper.vjp
        reduced = not self.wants_lr or (lr is None and view.factor == 1)
        rendered = hr if reduced else lr
        if rendered is None:
            raise ValueError(
                f"this objective needs the {'HR' if reduced else 'LR'} scale at t={t}, got None. Render what wants_lr "
                "and wants_hr(t) ask for."
            )
        self.logs.keep()
        with stage("losses LR"):
            low, photo = rendered.image.detach(), self._over_background(view.lr, t, view.background)
            _require_size(view, "HR" if reduced else "LR", low, view.hr.image if reduced else photo.image)
            l_lr = o.lr(images.area_mean(low, view.factor) if reduced else low, photo.image, photo.shown)  # Eq. 4
        where = _where(view, t)
        require_finite_losses(where, l_lr.values, {"the LR photo": photo.image, "the LR render": low})
        g_lr: Any = None
        from_hr: HrSide | None = None
        if not reduced:
            with stage("backward LR"):
                (g_lr,) = vjp(rendered, l_lr.cotangents)
        if hr is None:
            self.work_log.skip("backward HR", "HR was not drawn")
        else:
            # Where Î_LR is the area mean of Î_HR, the cotangent of L_LR passes through the same HR render.
            through_mean = images.area_mean_transposed(l_lr.cotangents, view.factor) if reduced else None
            hr_step = Step(iteration(t), self._guarded(view), hr.visible, params=params, looked_up=looked_up)
            g_mean, from_hr = self._backward_hr(hr, view, hr_step, t, vjp, through_mean)
            g_lr = g_mean if reduced else g_lr
        step = Step(iteration(t), self._guarded(view), params=params) if from_hr is None else from_hr.step
        with stage("strategies" if stepper is None else "per-Gaussian pass"):
            score = ordinary = None
            if scored:
                weights = (o if stepper is None else stepper).weights(t)
                screen_lr = to_ndc(screen_of(g_lr), _size(rendered.image))
                score, ordinary = self.scores(screen_lr, from_hr, weights)  # S^dens   Eq. 14
            require_finite_parts(where, g_lr, from_hr)
            if stepper is None:
                merged = self.merge(params, g_lr, from_hr, t)
                require_finite(f"{where}: the merged gradient", merged.grads)
                grads, conflict = merged.grads, merged.conflict
            else:
                grads, conflict = None, stepper.step(params, rendered, g_lr, from_hr, t)
        losses = {} if from_hr is None else from_hr.losses
        logs = self.logs.counted_since_kept()
        return Update(step, grads, score, ordinary, conflict, {**l_lr.values, **losses}, logs)

    @apart_from_the_loop
    def hr_gradients(
        self,
        hr: Shot,
        view: View,
        t: int,
        vjp: Callable[..., Sequence[Grads]] | None = None,
        *,
        apart: bool = True,
        params: Mapping[str, Tensor] = _UNKNOWN,
        looked_up: Tensor | None = None,
    ) -> HrSide:
        """Compare Î_HR with the SR image, ask for the evidence, and backpropagate both losses in one pass.

        Args:
            vjp: as `Stepper.vjp`; None: by `Shot.vjp`.
            apart: False: one cotangent, of L_base + λ_HF L_HF, unless a strategy routes or scores by L_HF.
            params, looked_up: see `Step`.
        """
        apart = apart or self.owner("route") is not None or self.owner("score") is not None
        step = Step(iteration(t), self._guarded(view), hr.visible, params=params, looked_up=looked_up)
        return self._backward_hr(hr, view, step, t, vjp or _vjp, apart=apart)[1]

    @apart_from_the_loop
    def draw(self, t: int, means: Float[Tensor, "N 3"], enlarged: Callable[[Camera, int], Photo]) -> None:
        """Let the strategies render the field, before `extra_views`."""
        for s in self.strategies:
            s.draw(t, means, enlarged)

    @apart_from_the_loop
    def extra_views(self, t: int) -> list[ExtraView]:
        """The pictures that the field should match at t in addition to the view; each gets a step on `extra_loss`."""
        if self.objective.lambda_lr == 0 or not self.showing:
            return []
        with self.work_log.stage("pictures of extra views"):  # a pseudo view is made when it is first asked for
            return [extra for s in self.showing for extra in answers.extra_views(s, s.extra_views(t))]

    @apart_from_the_loop
    def extra_loss(self, image: Float[Tensor, "h w 3"], extra: ExtraView, t: int) -> Losses:
        """The LR loss of a render of `extra`, weighted by pixel: its value and its cotangent [1, h, w, 3].  Eq. 4

        Where the weight is 0, both images count as black.

        Raises:
            DivergedError: the loss is not finite.
        """
        weight = extra.weight[..., None]
        photo = self._over_background(extra.photo, t, extra.background)
        target = torch.where(weight > 0, photo.image, 0.0)
        render = torch.where(weight > 0, image.detach(), 0.0)
        if extra.robust:
            weight = weight * images.agreement(render, target, extra.weight > 0)
        loss = self.objective.lr(render, target)
        require_finite_losses(f"t={t}, an extra view", loss.values, {"its picture": target, "the render": image})
        return loss._replace(cotangents=loss.cotangents * weight)

    def merge(self, params: Mapping[str, Tensor], g_lr: Grads, hr: HrSide | None, t: int) -> Merged:
        """The merge: g_LR + λ_HR ĝ_HR + λ∇L_stab.

        Args:
            params: raw parameters by attribute. g_lr: ∇(λ_LR L_LR). hr: None where HR was not rendered.
        """
        g_lr = g_lr.without_detail()
        if hr is None:
            return self.merge_routed(params, g_lr, Grads(), None, t, finite=True)
        return self.merge_routed(params, g_lr, hr.routed, hr.step, t, finite=True)

    @apart_from_the_loop
    def merge_routed(
        self, params: Mapping[str, Tensor], g_lr: Grads, g_hr: Grads, step: Step | None, t: int,
        out: Mapping[str, Tensor] | None = None, lambda_hr: Float[Tensor, " 1"] | None = None, finite: bool = False,
    ) -> Merged:  # fmt: skip
        """The merge after routing.

        Args:
            g_hr: g^HR of Eq. 13, and m λ_HF ∇L_HF of f_det; empty without HR. step: the iteration, with the evidence.
            out: receives the merged gradient, by attribute, contiguous; None: new tensors, for what has a gradient.
            lambda_hr: λ_HR(t) > 0 on the device, in a recording.
            finite: check also that the strategies' answers are finite.
        """
        λ = self.objective.lambda_hr(t) if lambda_hr is None else lambda_hr
        plus = self.regularized(params, t, finite=finite)
        if out is None:
            known = [name for name in params if name in plus or reconcile.has(g_lr, name) or reconcile.has(g_hr, name)]
            out = {name: empty_for(params[name]) for name in known}
        conflict: Mapping[str, Number] = {}
        weights = Weights()
        if (lambda_hr is not None or λ > 0) and reconcile.common_groups(g_lr, g_hr):
            products = reconcile.products(g_lr, g_hr)
            conflict = products.conflict()  # before correction
            answer = self.reconciled(
                products, step, lambda: (dense(g_lr, out), dense(g_hr.without_detail(), out)), finite=finite
            )
            if isinstance(answer, Weights):
                weights = answer  # ĝ^HR           Eq. 6, 7, 11
            else:
                g_hr = Grads({**answer, **{name: g for name, g in g_hr.items() if name == "detail"}})
        is_finite = reconcile.apply(out, g_lr, g_hr, weights, lambda_hr=λ, plus=plus)  # Eq. 8, 16
        return Merged(Grads(out), conflict, is_finite)

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
        s = self._owner["reconcile"]
        if overrides(s, "correct"):
            g_lr, g_hr = both()
            return answers.corrected(s, s.correct(g_lr, g_hr, step), g_hr, finite=finite)
        weights = s.reconcile(products, step)
        answers.require_weights(s, weights, *products.dot.shape, finite=finite)
        return weights

    def regularized(self, params: Mapping[str, Tensor], t: int, *, finite: bool = False) -> Grads:
        """What the strategies add to the merged gradient; empty: nothing.  Eq. 16

        Args:
            finite: check also that the answers are finite.
        """
        total = Grads()
        for s in self.regularizers:
            g = answers.regularized(s, s.regularize(params, iteration(t)), params, finite=finite)
            if g is None:
                self.work_log.skip("regularize", "no anchor yet")
            else:
                total = g if not total else total + g
        return total

    @apart_from_the_loop
    def pulls(self, params: Mapping[str, Tensor], t: int) -> bool:
        """Whether a strategy adds a gradient at t, which moves even Gaussians that no view draws."""
        return any(s.regularize(params, t) is not None for s in self.regularizers)

    def scores(
        self, screen_lr: Float[Tensor, "N 2"], hr: HrSide | None, weights: LossWeights
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """The densification score of the strategies, and the ordinary one, ‖∇_u L‖.

        Args:
            screen_lr: ∇_u(λ_LR L_LR) in NDC units. weights: λ_HR and λ_HR λ_HF.
        """
        if hr is None:
            ordinary = screen_norm(screen_lr)
            return ordinary, ordinary
        hf = None if hr.detail is None else screen_of(hr.detail)
        screen = ScreenGradients(screen_lr, *per_gaussian.screens(screen_lr, screen_of(hr.g), hf, hr.size, weights))
        score = self._owner["score"].score(hr.step, screen)
        answers.require_score(self._owner["score"], score, len(screen_lr))
        return screen.ordinary if score is None else score, screen.ordinary

    @apart_from_the_loop
    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """After the optimizer steps of an iteration."""
        params = MappingProxyType(params)  # to replace an entry would have no effect
        for s in self.strategies:
            s.after_step(params, step)
            answers.require_state(s, params)

    def may_densify(self, t: int) -> bool:
        return all(s.may_densify(t) for s in self.strategies)

    @apart_from_the_loop
    def on_resize(self, parents: Int[Tensor, " M"]) -> None:
        for s in self.strategies:
            s.on_resize(parents)

    def state_dict(self) -> dict[str, Tensor]:
        """Every strategy's per-Gaussian tensors, as "<class>.<name>" ("<class>2.<name>" for a second of one class)."""
        return {
            f"{owner}.{name}": rows for owner, s in by_class(self.strategies).items() for name, rows in s.state.items()
        }

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Give each strategy its tensors back.

        Raises:
            ValueError: a tensor belongs to no strategy of this conductor.
        """
        by_name = by_class(self.strategies)
        for s in self.strategies:
            s.state.clear()
        for key, rows in tensors.items():
            owner, _, name = key.partition(".")
            if owner not in by_name:
                raise ValueError(f"state {key!r} belongs to no strategy of this run ({', '.join(by_name) or 'none'}).")
            by_name[owner].state[name] = rows.to(by_name[owner].device, copy=True)

    def owner(self, hook: str) -> Strategy | None:
        """The strategy that answers a hook which only one may answer; None: no strategy does."""
        s = self._owner[hook]
        return None if type(s) is Strategy else s

    def _over_background(self, photo: Photo, t: int, background: Color) -> Photo:
        """The photo composited over the background of iteration t instead of its own. Those of a recording are so already."""
        is_final = photo.transparency is None or running() is not None
        return photo if is_final else photo.over(self.background(t), background)

    def _guarded(self, view: View) -> View:
        return guarded(view, over_changing=self.owner("background") is not None)

    def _backward_hr(
        self,
        hr: Shot,
        view: View,
        step: Step,
        t: int,
        vjp: Callable[..., Sequence[Grads]],
        lr_cotangents: Tensor | None = None,
        apart: bool = True,
    ) -> tuple[Grads | None, HrSide]:
        """∇(λ_LR L_LR) if its cotangents [1, H, W, 3] are passed, else None; and the gradients of the HR losses."""
        stage = self.work_log.stage
        with stage("losses HR"):
            sr = self._over_background(view.hr, t, view.background)
            _require_size(view, "HR", hr.image, sr.image)
            # The memory is reused: an allocator would map tens of megabytes anew each time, with a page fault for every 4 KB.
            losses = self.objective.hr(hr.image.detach(), sr.image, sr.shown, reuse=self._hr_cotangents)  # Eq. 5
            self._hr_cotangents = losses.cotangents
        require_finite_losses(_where(view, t), losses.values, {"the SR image": sr.image, "the HR render": hr.image})
        of_hr, λ_hf = losses.cotangents, self.objective.lambda_hf
        if len(of_hr) != 1 + (λ_hf > 0):
            rule = f"must give {1 + (λ_hf > 0)} cotangents, of L_base{' and of L_HF' * (λ_hf > 0)}, got {len(of_hr)}"
            raise ValueError(f"{type(self.objective).__name__}.hr() {rule}. Add another loss to one of them.")
        if not apart and len(of_hr) == 2:
            of_hr = torch.add(of_hr[:1], of_hr[1:], alpha=λ_hf)
        with stage("evidence"):
            n, evidence = len(hr.visible), self._owner["observe"].observe(step, hr)  # q, a, w        Eq. 9, 10
            answers.require_evidence(self._owner["observe"], evidence, n)
            step = replace(step, evidence=evidence)
            m = 1.0 if len(of_hr) == 1 else self._owner["route"].route(step)  # m              Eq. 12
            answers.require_route(self._owner["route"], m, n)
        with stage("backward HR"):  # one pass for all cotangents
            both = of_hr if lr_cotangents is None else torch.cat((lr_cotangents, of_hr))
            detail = None
            if len(of_hr) == 1:
                *of_lr, g = vjp(hr, both)
            else:
                rows = m.to(hr.image.dtype) if isinstance(m, Tensor) else hr.image.new_full((n,), float(m))
                *of_lr, g, detail = vjp(hr, both, rows * λ_hf)  # g^HR        Eq. 13
        return of_lr[0] if of_lr else None, HrSide(g.without_detail(), detail, _size(hr.image), step, m, losses.values)


def _vjp(
    shot: Shot, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None
) -> Sequence[Grads]:  # fmt: skip
    """`Stepper.vjp` for any shot."""
    if weight is None:
        return shot.vjp(cotangents)
    of_shot = getattr(shot, "summed_vjp", None)
    return summed(shot.vjp(cotangents), weight) if of_shot is None else of_shot(cotangents, weight)


def _require_size(view: View, scale: str, render: Tensor, image: Tensor) -> None:
    if render.shape != image.shape:
        (h, w, *_), (height, width, *_) = render.shape, image.shape
        rule = f"must have the {width}x{height} pixels of its {scale} image"
        raise ValueError(
            f"view {view.name}: the {scale} rendering {rule}, got {w}x{h}. Draw it by view.{scale.lower()}.camera."
        )


def _where(view: View, t: int) -> str:
    return f"t={t}, view {view.name}"


def _size(image: Float[Tensor, "H W 3"]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
