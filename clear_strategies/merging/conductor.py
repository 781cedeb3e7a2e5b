"""The conductor: the merged gradient of a view, from its two renderings and the answers of the strategies.  Eq. 8, 13

It is the same in every trainer. The order of an iteration is that of `Conductor.gradients`, then of `Conductor.merge`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.conflicts import Weights
from clear_strategies.core.finite import require_finite, require_finite_losses
from clear_strategies.core.gradients import Grads, ScreenGradients, Shot, screen_norm, screen_of, summed, to_ndc
from clear_strategies.core.step import Losses, Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.kernels import per_gaussian, reconcile
from clear_strategies.kernels.reconcile import dense
from clear_strategies.merging.detail import DetailRates
from clear_strategies.merging.hooks import Hooks
from clear_strategies.merging.iteration import (
    VJP,
    HrSide,
    LossWeights,
    Merged,
    Update,
    guarded,
    require_finite_parts,
)
from clear_strategies.merging.logs import IterationLogs
from clear_strategies.merging.objective import Objective
from clear_strategies.merging.skips import SkipPolicy, Skips
from clear_strategies.signatures import signature_of
from clear_strategies.strategies.base import RunFacts, Scale, Strategy
from rasterizers.guards import iteration
from rasterizers.interface import Color
from rasterizers.modes import apart_from_the_loop
from rasterizers.native import empty_for
from rasterizers.recording import running

P = TypeVar("P")


class Conductor(Hooks):
    """Merges the gradients of a view. Methods that call the strategies are those of `Hooks`.

    Args:
        strategies: in any order, which has an effect on `compare` alone. None at all is the paper's baseline.
        objective: the losses and their weights.
        statistics_from: iteration from which densification statistics need the HR render although λ_HR = 0; None:
            as soon as λ_HR > 0 (F11).
        decorators: each takes a prior and returns one, e.g. `BackProjected`; `prior` applies them in this order.
        detail: the rates of f_det, for hosts.
        skips: work that is left out; None: only what changes nothing.

    Attributes:
        skips: which work of the run is left out.
        decorated: whether `prior` has been called, or there are no decorators.
        sr: the argument of `prior`; None before it is called.

    Raises:
        StrategyConflict: two strategies answer a question that only one may.
    """

    def __init__(
        self, *strategies: Strategy, objective: Objective | None = None, statistics_from: int | None = 500,
        decorators: Sequence[Callable[[Any], Any]] = (), detail: DetailRates | None = None, skips: Skips | None = None,
    ) -> None:  # fmt: skip
        super().__init__(strategies, objective if objective is not None else Objective())
        self.statistics_from = statistics_from
        self.decorators = tuple(decorators)
        self.detail = detail if detail is not None else DetailRates()
        self.skips = SkipPolicy(skips)
        self.decorated = not self.decorators
        self.sr: Any = None
        self._hr_cotangents: Tensor | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The settings, and the prior. A copy of a conductor that takes part in a run has to begin its own."""
        of_run = {"logs": IterationLogs(self.strategies), "work_log": WorkLog(), "views": (), "_hr_cotangents": None}
        run, skips = None if self.run is None else RunFacts(), SkipPolicy(self.skips.skips)
        return {**vars(self), **of_run, "run": run, "skips": skips}

    def prior(self, prior: P) -> P:
        """The prior with every decorator around it, which makes the SR images of a run with this conductor."""
        self.sr = prior
        for decorate in self.decorators:
            prior = decorate(prior)
        self.decorated = True
        return prior

    @property
    def wants_lr(self) -> bool:
        """True if the LR render has any use; else Î_LR is the area mean of Î_HR."""
        return self.objective.lr_from == "lr" and self.objective.lambda_lr > 0

    @property
    def uses_hr(self) -> bool:
        """True if HR has any use in some iteration, see `wants_hr`."""
        return self.hr_from() is not None

    def hr_from(self, *, scored: bool = True) -> int | None:
        """The iteration after which HR may have a use, see `wants_hr`; None: it has none in any."""
        if not self.wants_lr:
            return 0
        starts = [self.objective.lambda_hr.zero_until]
        if scored and self.owner("score") is not None:
            starts.append(self.statistics_from)
        return min((t for t in starts if t is not None), default=None)

    def wants_hr(self, t: int, *, scored: bool = True) -> bool:
        """Return True if the HR render is used at t: λ_HR > 0, Î_LR is its area mean, or a densification score needs it.

        Args:
            scored: False: no densification reads the scores of this iteration; `skips.hr_every` may leave HR out then.
        """
        if self.objective.lambda_hr(t) == 0 and self.wants_lr:
            collecting = scored and self.statistics_from is not None and t > self.statistics_from
            if self.owner("score") is None or not collecting or not self.may_densify(t):
                self.work_log.skip("render LR + HR", "lambda_HR = 0")
                return False
        if scored or not self.wants_lr or not self.skips.leaves_out_hr(t):
            return True
        reason = f"HR in one of {self.skips.skips.hr_every} iterations (skips.hr_every)"
        self.work_log.skip("render LR + HR", reason)
        return False

    def lr_due(self, view: View, hr_due: bool) -> bool:
        """Return True if LR is rendered beside HR, or alone where HR is not due.

        Args:
            view: of the iteration, from `SkipPolicy.view`.
        """
        if self.wants_lr and hr_due and self.skips.serves_lr(view):
            self.work_log.skip("render LR", "HR at half its size is as large (skips.coarse_until)")
            return False
        return self.wants_lr

    def update(
        self, params: Mapping[str, Tensor], lr: Shot | None, hr: Shot | None, view: View, t: int, *,
        scored: bool = True, looked_up: Tensor | None = None,
    ) -> Update:  # fmt: skip
        """The merged gradient of one view, in place of `backward()`.

        Args:
            params: raw parameters by attribute.
            lr, hr: this view rendered at both scales. hr=None leaves HR out; with lr=None, LR is the area mean of hr, if
                `wants_lr` is False or both scales have one size.
            scored, looked_up: see `gradients`.

        Raises:
            ValueError: a scale that the objective needs was not rendered.
            StrategyConflict: one of the strategies has begun the run of another conductor.
            DivergedError: a loss or a gradient is not finite; `params` and the optimizer are unchanged.
        """
        g_lr, from_hr, update = self.gradients(params, lr, hr, view, t, scored=scored, looked_up=looked_up)
        with self.work_log.stage("strategies"):
            g_hr = Grads() if from_hr is None else from_hr.routed
            merged = self.merge(params, g_lr, g_hr, update.step, t, finite=True)
        return replace(update, grads=merged.grads, conflict=merged.conflict)

    @apart_from_the_loop
    def gradients(
        self,
        params: Mapping[str, Tensor],
        lr: Shot | None,
        hr: Shot | None,
        view: View,
        t: int,
        vjp: VJP | None = None,
        *,
        scored: bool = True,
        weights: LossWeights | None = None,
        looked_up: Tensor | None = None,
    ) -> tuple[Grads, HrSide | None, Update]:
        """The first part of `update`: g_LR without f_det, the HR side, and the update without what the merge adds to it.

        Args:
            vjp: of both renderings; None: `Shot.vjp`.
            scored: False: no densification reads the scores of this iteration.
            weights: as of `Objective.weights`, on the device in a recording.
            looked_up: see `Step.looked_up`.
        """
        self.require_run(self.run)
        self.logs.begin(t)
        stage, vjp = self.work_log.stage, vjp or _vjp
        reduced = not self.wants_lr or (lr is None and view.factor == 1)
        rendered = hr if reduced else lr
        if rendered is None:
            raise ValueError(
                f"this objective needs the {'HR' if reduced else 'LR'} scale at t={t}, got None. Render what wants_lr "
                "and wants_hr(t) ask for."
            )
        step = Step(t, view, params=params, looked_up=looked_up)
        _require_size(view, "hr" if reduced else "lr", rendered.image)
        image = rendered.image.detach()
        l_lr = self._losses("lr", images.area_mean(image, view.factor) if reduced else image, step)  # Eq. 4
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
            from_hr = self.hr_gradients(hr, step, vjp, lr_cotangents=through_mean)
            g_lr = from_hr.lr if reduced else g_lr
        score = ordinary = None
        if scored:
            with stage("densification score"):
                weights = self.objective.weights(t) if weights is None else weights
                screen_lr = to_ndc(screen_of(g_lr), _size(rendered.image))
                score, ordinary = self.scores(screen_lr, from_hr, weights)  # S^dens   Eq. 14
        require_finite_parts(_where(step), g_lr, from_hr)
        of_hr: Any = {} if from_hr is None else from_hr.losses  # scalars, as of all that is no replay
        told = self._told(step) if from_hr is None else from_hr.step
        update = Update(told, None, score, ordinary, {}, {**l_lr.values, **of_hr}, l_lr.cotangents)
        return g_lr.without_detail(), from_hr, update

    @apart_from_the_loop
    def hr_gradients(
        self,
        hr: Shot,
        step: Step,
        vjp: VJP | None = None,
        *,
        apart: bool = True,
        lr_cotangents: Float[Tensor, "1 H W 3"] | None = None,
    ) -> HrSide:
        """Compare Î_HR with the SR image, ask for the evidence, and backpropagate both losses in one pass.

        Args:
            step: the iteration. vjp: of the rendering; None: `Shot.vjp`.
            apart: False: one cotangent, of L_base + λ_HF L_HF, unless a strategy routes or scores by L_HF.
            lr_cotangents: of λ_LR L_LR, if its gradient passes through this render, too.
        """
        stage, λ_hf = self.work_log.stage, self.objective.lambda_hf
        _require_size(step.view, "hr", hr.image)
        step = replace(step, visible=hr.visible)
        losses = self._losses("hr", hr.image.detach(), step)  # Eq. 5
        of_hr = losses.cotangents
        if len(of_hr) == 2 and not (apart or self.owner("route") is not None or self.owner("score") is not None):
            of_hr = torch.add(of_hr[:1], of_hr[1:], alpha=λ_hf)
        has_hf, n = len(of_hr) == 2, len(hr.visible)
        with stage("evidence"):
            step = self.observed(self._told(step), hr)  # q, a, w        Eq. 9, 10
            m = self.route(step, n) if has_hf else 1.0  # m              Eq. 12
        with stage("backward HR"):  # one pass for all cotangents
            cotangents = of_hr if lr_cotangents is None else torch.cat((lr_cotangents, of_hr))
            detail = None
            if has_hf:
                rows = m.to(hr.image.dtype) if isinstance(m, Tensor) else hr.image.new_full((n,), float(m))
                *of_lr, g, detail = (vjp or _vjp)(hr, cotangents, rows * λ_hf)  # g^HR        Eq. 13
            else:
                *of_lr, g = (vjp or _vjp)(hr, cotangents)
        g_lr = of_lr[0] if of_lr else None
        return HrSide(g.without_detail(), detail, _size(hr.image), step, m, losses.values, g_lr)

    @apart_from_the_loop
    def extra_loss(self, image: Float[Tensor, "h w 3"], extra: ExtraView, t: int) -> Losses:
        """The LR loss of a render of `extra`, and its cotangent [1, h, w, 3], each pixel's times its weight.  Eq. 4

        Where the weight is 0, both images count as black; else the loss itself has no weights.

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
        return self.score(hr.step, screen), screen.ordinary

    @apart_from_the_loop
    def merge(
        self, params: Mapping[str, Tensor], g_lr: Grads, g_hr: Grads, step: Step | None, t: int,
        out: Mapping[str, Tensor] | None = None, lambda_hr: Float[Tensor, " 1"] | None = None, finite: bool = False,
    ) -> Merged:  # fmt: skip
        """The merge: g_LR + λ_HR ĝ_HR + λ∇L_stab.

        Args:
            params: raw parameters by attribute. g_lr: ∇(λ_LR L_LR), without f_det.
            g_hr: g^HR of Eq. 13, and m λ_HF ∇L_HF of f_det; empty without HR. step: the iteration, with the evidence.
            out: receives the merged gradient, by attribute, contiguous; None: new tensors, for what has a gradient.
            lambda_hr: λ_HR(t) > 0 on the device, in a recording.
            finite: check that the strategies' answers and the merged gradient are finite.

        Raises:
            DivergedError: the merged gradient is not finite.
        """
        λ = self.objective.lambda_hr(t) if lambda_hr is None else lambda_hr
        compared = (lambda_hr is not None or λ > 0) and reconcile.common_groups(g_lr, g_hr)
        products, like = reconcile.products(g_lr, g_hr) if compared else None, params if out is None else out
        weights, plus, conflict = self.answers(  # ĝ^HR           Eq. 6, 7, 11
            products, lambda: (dense(g_lr, like), dense(g_hr.without_detail(), like)), params, step, t, finite=finite
        )
        if not isinstance(weights, Weights):
            g_hr, weights = Grads({**weights, **{name: g for name, g in g_hr.items() if name == "detail"}}), Weights()
        if out is None:
            known = [name for name in params if name in plus or reconcile.has(g_lr, name) or reconcile.has(g_hr, name)]
            out = {name: empty_for(params[name]) for name in known}
        is_finite = reconcile.apply(out, g_lr, g_hr, weights, lambda_hr=λ, plus=plus)  # Eq. 8, 16
        if finite:
            require_finite(f"t={t}{'' if step is None else f', view {step.view.name}'}: the merged gradient", out)
        return Merged(Grads(out), conflict, is_finite)

    def on_fit_end(self) -> None:
        """Once, after the last iteration."""
        self._hr_cotangents = None
        super().on_fit_end()

    def _losses(self, scale: Scale, image: Float[Tensor, "H W 3"], step: Step) -> Losses:
        """The losses of a render against the photo of its scale, which lies over the background of the iteration."""
        view, is_lr = step.view, scale == "lr"
        with self.work_log.stage(f"losses {scale.upper()}"):
            photo = self._over_background(view.lr if is_lr else view.hr, step.t, view.background)
            losses = self.objective.lr if is_lr else self._hr_losses
            compare = self.comparison(scale, photo, self._told(step), lambda x: losses(x, photo.image, photo.shown))
            found = compare(image)
        target = "the LR photo" if is_lr else "the SR image"
        compared = {target: photo.image, f"the {scale.upper()} render": image}
        require_finite_losses(_where(step), found.values, compared)
        return found

    def _hr_losses(
        self, image: Float[Tensor, "H W 3"], sr: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"] | None
    ) -> Losses:  # fmt: skip
        """L_base and L_HF. Their cotangents take the memory of the last ones: an allocator would map tens of megabytes anew each
        time, with a page fault for every 4 KB.
        """
        losses, has_hf = self.objective.hr(image, sr, shown, self._hr_cotangents), self.objective.lambda_hf > 0
        if (found := len(losses.cotangents)) != 1 + has_hf:
            rule = f"must give {1 + has_hf} cotangents, of L_base{' and of L_HF' * has_hf}, got {found}"
            raise ValueError(f"{type(self.objective).__name__}.hr() {rule}. Add another loss to one of them.")
        self._hr_cotangents = losses.cotangents  # not those that a strategy returns, which may be stored
        return losses

    def _told(self, step: Step) -> Step:
        """The iteration as strategies see it; in a recording, they cannot read from it what differs between replays."""
        if running() is None:
            return step
        view = guarded(step.view, over_changing=self.owner("background") is not None)
        return replace(step, t=iteration(step.t), view=view)

    def _over_background(self, photo: Photo, t: int, background: Color) -> Photo:
        """The photo composited over the background of iteration t instead of its own. Those of a recording are so already."""
        is_final = photo.transparency is None or running() is not None
        return photo if is_final else photo.over(self.background(t), background)


def _vjp(
    shot: Shot, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None
) -> Sequence[Grads]:
    if weight is None:
        return shot.vjp(cotangents)
    return shot.vjp(cotangents, weight) if _sums(type(shot)) else summed(shot.vjp(cotangents), weight)


@cache
def _sums(kind: Any) -> bool:
    """Whether `vjp` of this class of shots takes `weight`, which one's own may lack."""
    return "weight" in signature_of(kind.vjp).parameters


def _require_size(view: View, scale: Scale, render: Tensor) -> None:
    image = (view.lr if scale == "lr" else view.hr).image
    if render.shape != image.shape:
        rule = f"the {scale.upper()} rendering must have the shape {[*image.shape]} of its {scale.upper()} image"
        raise ValueError(f"view {view.name}: {rule}, got {[*render.shape]}. Draw it by view.{scale}.camera.")


def _where(step: Step) -> str:
    return f"t={step.t}, view {step.view.name}"


def _size(image: Float[Tensor, "H W 3"]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
