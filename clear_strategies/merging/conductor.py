"""Floor 3: asks the strategies in the paper's order and does the arithmetic. Every host uses this one object.
Eq. 8, 13
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.deferred import Number, Scalar
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, Shot, conflict_ratio, to_ndc
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import StrategyConflict
from clear_strategies.merging.objective import Objective
from clear_strategies.strategies.base import ScreenGradients, Strategy, answers

if TYPE_CHECKING:
    from clear_strategies.core.view import View

_log = logging.getLogger(__name__)

_ONE_ANSWER: Final = ("gate", "observe", "route", "correct", "score")


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What one iteration decided.

    Args:
        grads: the merged gradient by attribute, for the optimizer; empty where a merger has stepped already.
        score: S_i, what densification goes by; `ordinary` is what it would go by without strategies.
        conflict: share of Gaussians in conflict before correction, by group and as "gaussian"; empty without HR.
        losses: scalars by name. readings: the strategies' own numbers, for logs.

    On a device, losses, conflict and readings are not floats yet: `late.read`.
    """

    grads: Grads
    score: Float[Tensor, " N"]
    ordinary: Float[Tensor, " N"]
    evidence: Evidence | None
    conflict: Mapping[str, Number] = field(default_factory=dict)
    losses: Mapping[str, Scalar] = field(default_factory=dict)
    readings: Mapping[str, Number] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class HrGradients:
    """What the HR scale said of one view: its gradients, the evidence, and how much of g_HF each Gaussian gets.

    `HrGradients()` is silence: HR was not drawn.

    Args:
        base, hf: ∇L_base and ∇L_HF, each with `.screen` in 1/pixel of an image of `size` (width, height); hf None where
            λ_HF = 0. lr: ∇(λ_LR L_LR), where Î_LR is made of Î_HR.
        m: what `route` answered.
    """

    base: Any | None = None
    hf: Any | None = None
    lr: Any | None = None
    size: tuple[int, int] = (1, 1)
    evidence: Evidence | None = None
    m: float | Float[Tensor, " N"] = 1.0
    losses: Mapping[str, Scalar] = field(default_factory=dict)


@runtime_checkable
class Merger(Protocol):
    """Who pulls a view's gradients and merges them. The conductor itself does, readably; a kernel may do the same."""

    @property
    def stage(self) -> str:
        """Under which name the work_log counts it."""
        ...

    def vjp(self, shot: Any, cotangents: Float[Tensor, "K H W 3"]) -> Sequence[Any]:
        """One gradient a cotangent, each with `.screen` [N, 2]; what else it is only `merge` knows."""
        ...

    def merge(
        self,
        params: Mapping[str, Tensor],
        g_lr: Any,
        g_base: Any | None,
        g_hf: Any | None,
        m: float | Float[Tensor, " N"],
        e: Evidence | None,
        t: int,
    ) -> tuple[Grads, Mapping[str, Number]]:
        """The merged gradient and the conflict ratio by group; see `Conductor.merge`."""
        ...


class Conductor:
    """Strategies in concert.

    Args:
        strategies: in any order: the hook decides when each is asked. None at all is the paper's baseline.
        objective: the losses and their weights.
        statistics_from: iteration from which densification statistics want the HR render although λ_HR = 0; None:
            as soon as λ_HR > 0 (METHOD, F11).

    Raises:
        StrategyConflict: two strategies answer a question that only one may.
    """

    stage: Final = "strategies"

    def __init__(
        self, *strategies: Strategy, objective: Objective | None = None, statistics_from: int | None = None
    ) -> None:
        self.strategies = strategies
        self.objective = objective if objective is not None else Objective()
        self.work_log = WorkLog()
        self._statistics_from = statistics_from
        self._one: dict[str, Strategy] = {}
        for hook in _ONE_ANSWER:
            owners = [s for s in strategies if answers(s, hook)]
            if len(owners) > 1:
                first, second = (type(s).__name__ for s in owners[:2])
                raise StrategyConflict(
                    f"{first} and {second} both implement {hook}(); exactly one strategy may. Remove one, or write a "
                    "strategy that combines them."
                )
            if owners:
                self._one[hook] = owners[0]
        self._regularizers = [s for s in strategies if answers(s, "regularize")]
        for s in strategies:
            if not any(answers(s, hook) for hook in (*_ONE_ANSWER, "regularize", "may_densify", "after_step")):
                _log.warning("%s implements no hook; it has no effect.", type(s).__name__)

    def on_fit_start(self, n_views: int, seed: int, device: torch.device | str = "cpu") -> None:
        """Once, before the first iteration; `device` is where the field lies."""
        self.work_log.device = torch.device(device)
        for s in self.strategies:
            s.on_fit_start(n_views, seed)
            s.to(device)

    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | None:
        """zᵗ, before render; None: every Gaussian takes part."""
        if "gate" not in self._one:
            return None
        z = self._one["gate"].gate(t, n)
        if z is None:
            self.work_log.skip("gate", "no Gaussian is dropped at this rate")
        return z

    def wants_hr(self, t: int) -> bool:
        """Whether the HR scale has any use at t: λ_HR > 0, Î_LR is made of it, or a densification score needs it."""
        if self.objective.lambda_hr(t) > 0 or not self.wants_lr:
            return True
        collecting = self._statistics_from is not None and t > self._statistics_from
        if "score" in self._one and collecting and self.may_densify(t):
            return True
        self.work_log.skip("render LR + HR", "lambda_HR = 0")
        return False

    @property
    def wants_lr(self) -> bool:
        """Whether the LR scale has any use; else Î_LR is the area mean of Î_HR."""
        return self.objective.draws_lr

    def update(
        self,
        params: Mapping[str, Tensor],
        lr: Shot | None,
        hr: Shot | None,
        view: View,
        t: int,
        merger: Merger | None = None,
    ) -> Update:
        """The merged gradient of one view, in place of `backward()`.

        Args:
            params: raw parameters by attribute. lr, hr: this view rendered at both scales. hr None skips it; lr None
                stands for the area mean of hr, and is not looked at where `wants_lr` says no.
            merger: who pulls and merges the gradients; None: the conductor itself, as written below.

        Raises:
            ValueError: a scale that the objective needs was not rendered.
        """
        o, stage = self.objective, self.work_log.stage
        how: Merger = self if merger is None else merger
        reduced = not self.wants_lr
        through = hr if reduced else lr
        if through is None:
            raise ValueError(
                f"this objective needs the {'HR' if reduced else 'LR'} scale at t={t}, got None. Render what wants_lr "
                "and wants_hr(t) ask for."
            )
        with stage("losses LR"):
            low = through.image.detach()
            l_lr = o.lr(images.area_mean(low, view.factor) if reduced else low, view.lr.image)  # Eq. 4
        if not reduced:
            with stage("backward LR"):
                (g_lr,) = how.vjp(through, l_lr.cotangents)
        if hr is None:
            hr_grads = HrGradients()
            self.work_log.skip("backward HR", "HR was not drawn")
        else:
            spread = images.area_mean_transposed(l_lr.cotangents, view.factor) if reduced else None
            hr_grads = self.hr_gradients(hr, view, how, spread)
        if reduced:
            g_lr = hr_grads.lr
        with stage(how.stage):
            score, ordinary = self.scores(to_ndc(_screen(g_lr), _size(through.image)), hr_grads, t)  # S^dens    Eq. 14
            g, conflict = how.merge(params, g_lr, hr_grads.base, hr_grads.hf, hr_grads.m, hr_grads.evidence, t)
        return Update(
            g, score, ordinary, hr_grads.evidence, conflict, {**l_lr.values, **hr_grads.losses}, self.readings()
        )

    def hr_gradients(
        self, hr: Shot, view: View, how: Merger | None = None, spread: Float[Tensor, "1 H W 3"] | None = None
    ) -> HrGradients:
        """Compare Î_HR with its reference, vjp the gradients in one pass, and ask what they are worth.

        Args:
            spread: a cotangent of Î_HR more, that of L_LR where Î_LR is made of Î_HR.
        """
        puller, stage = self if how is None else how, self.work_log.stage
        with stage("losses HR"):
            losses = self.objective.hr(hr.image.detach(), view.hr.image)  # Eq. 5
        with stage("backward HR"):  # one pass for all cotangents
            cotangents = losses.cotangents if spread is None else torch.cat((spread, losses.cotangents))
            pulled = list(puller.vjp(hr, cotangents))
        lr = pulled.pop(0) if spread is not None else None
        base, hf = pulled if len(pulled) > 1 else (pulled[0], None)
        with stage("evidence"):
            e = self._ask("observe", None, view, hr)  # q, a, w        Eq. 9, 10
            m = 1.0 if hf is None else self._ask("route", 1.0, e)  # m              Eq. 12
        return HrGradients(base, hf, lr, _size(hr.image), e, m, losses.values)

    def scores(
        self, screen_lr: Float[Tensor, "N 2"], hr_grads: HrGradients, t: int
    ) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
        """Where to densify: as the strategies say, and ‖∇_u L‖, as it would be without them.

        Args:
            screen_lr: ∇_u(λ_LR L_LR) in NDC units.
        """
        λ, total, base, hf = self.objective.lambda_hr(t), screen_lr, None, None
        if hr_grads.base is not None:
            base = to_ndc(_screen(hr_grads.base), hr_grads.size)
            total = total + λ * base
        if hr_grads.hf is not None:
            hf = to_ndc(_screen(hr_grads.hf), hr_grads.size)
            total = total + λ * self.objective.lambda_hf * hf
        screens = ScreenGradients(screen_lr, base, hf, torch.linalg.vector_norm(total, dim=-1))
        score = None if base is None else self._ask("score", None, hr_grads.evidence, screens)
        return screens.ordinary if score is None else score, screens.ordinary

    def vjp(self, shot: Shot, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        return shot.vjp(cotangents)

    def merge(
        self,
        params: Mapping[str, Tensor],
        g_lr: Grads,
        g_base: Grads | None,
        g_hf: Grads | None,
        m: float | Float[Tensor, " N"],
        e: Evidence | None,
        t: int,
    ) -> tuple[Grads, Mapping[str, Number]]:
        """The gradient g_LR + λ_HR ĝ_HR + λ∇L_stab, and the conflict ratio before correction."""
        if g_base is None:
            return g_lr + self._regularize(params, t), {}
        λ, λ_hf = self.objective.lambda_hr(t), self.objective.lambda_hf
        g_hr = g_base
        if g_hf is not None:
            g_hf = g_hf * m * λ_hf
            g_hr = g_base + g_hf  # g^HR           Eq. 13
        base_lr, base_hr = _without_detail(g_lr), _without_detail(g_hr)
        conflict: Mapping[str, Number] = {}
        if λ > 0:
            conflict = conflict_ratio(base_lr, base_hr)  # before correction
            base_hr = self._ask("correct", base_hr, base_lr, base_hr, e)  # corrected      Eq. 6, 7, 11
        g = base_lr + base_hr * λ  # Eq. 8
        if g_hf is not None and "detail" in g_hf:
            g["detail"] = g_hf["detail"] * λ  # f_det: never corrected, never from L_base
        return g + self._regularize(params, t), conflict  # Eq. 16

    def after_step(self, params: Mapping[str, Tensor], t: int) -> None:
        for s in self.strategies:
            s.after_step(params, t)

    def may_densify(self, t: int) -> bool:
        return all(s.may_densify(t) for s in self.strategies)

    def on_resize(self, parents: Int[Tensor, " M"]) -> None:
        for s in self.strategies:
            s.on_resize(parents)

    def state_dict(self) -> dict[str, Tensor]:
        """Every strategy's per-Gaussian tensors, as "<class>.<name>" ("<class>2.<name>" for a second of one class)."""
        return {f"{owner}.{name}": rows for owner, s in self._by_name().items() for name, rows in s.state.items()}

    def load_state_dict(self, tensors: Mapping[str, Tensor]) -> None:
        """Give each strategy its tensors back.

        Raises:
            ValueError: a tensor belongs to no strategy that is here.
        """
        by_name = self._by_name()
        for s in self.strategies:
            s.state.clear()
        for key, rows in tensors.items():
            owner, _, name = key.partition(".")
            if owner not in by_name:
                raise ValueError(f"state {key!r} belongs to no strategy of this run ({', '.join(by_name) or 'none'}).")
            by_name[owner].state[name] = rows.to(by_name[owner].device, copy=True)

    def _by_name(self) -> dict[str, Strategy]:
        named: dict[str, Strategy] = {}
        for s in self.strategies:
            kind = type(s).__name__
            same = sum(type(other).__name__ == kind for other in named.values())
            named[kind if same == 0 else f"{kind}{same + 1}"] = s
        return named

    def owner(self, hook: str) -> Strategy | None:
        """The strategy that answers a hook which only one may."""
        return self._one.get(hook)

    def _ask(self, hook: str, unanswered: Any, *arguments: Any) -> Any:
        owner = self._one.get(hook)
        return unanswered if owner is None else getattr(owner, hook)(*arguments)

    def _regularize(self, params: Mapping[str, Tensor], t: int) -> Grads:
        total = Grads()
        for s in self._regularizers:
            g = s.regularize(params, t)
            if g is None:
                self.work_log.skip("regularize", "no anchor yet")
            else:
                total = total + g
        return total

    def readings(self) -> dict[str, Number]:
        """The strategies' own numbers of the last iteration."""
        return {name: value for s in self.strategies for name, value in s.readings.items()}


def _without_detail(g: Grads) -> Grads:
    return Grads({name: value for name, value in g.items() if name != "detail"})


def _screen(g: Any) -> Tensor:
    screen: Tensor | None = g.screen
    if screen is None:
        raise ValueError("a Shot's vjp() must set .screen on every Grads it returns.")
    return screen


def _size(image: Float[Tensor, "H W 3"]) -> tuple[int, int]:
    return image.shape[1], image.shape[0]
