"""Changes of a host's densification by strategies: its end (SVS: anchor_start), and the score that it reads.  Eq. 14"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.checks import require_whole
from clear_strategies.core.gradients import screen_norm, to_ndc
from clear_strategies.density.threshold import count_passing, topk_threshold
from clear_strategies.errors import SettingError
from clear_strategies.merging.conductor import Conductor
from integration.autograd_shot import ScreenGradientSlot

_log = logging.getLogger(__name__)
_VIEWS_PER_FIT: Final = 10  # sorting N scores at every view would cost more than a newer factor gains
_MANY: Final = 0.1  # of the first Gaussians


def end_with_strategies(conductor: Conductor, settings: Any, name: str, first: int = 1) -> None:
    """Lower `settings.<name>`, the iteration at which the host stops densifying, to that at which a strategy ends densification.

    Args:
        settings: an object of the host that its loop reads at every iteration; without this field, nothing is done.
        first: the host's number of its first iteration, 0 or 1.
    """
    until = getattr(settings, name, None)
    if until is not None and (end := _end_of_densification(conductor, int(until), first)) < until:
        _log.info(
            "densification ends at %s=%d instead of %d (%s).", name, end, until, _forbidding(conductor, end - first)
        )
        setattr(settings, name, end)


def require_end(conductor: Conductor, until: int | None, name: str, first: int = 1) -> None:
    """Raise an error, or warn, if the host's densification outlasts the strategies' and cannot be ended from here.

    Args:
        until: the host's setting `name`, the iteration at which it stops densifying; None: unknown.

    Raises:
        SettingError: a strategy takes an anchor before the structure stops changing.
    """
    if until is None or (end := _end_of_densification(conductor, until, first)) >= until:
        return
    if any(getattr(s, "anchor_strength", 0.0) > 0 for s in conductor.strategies):  # SVS keeps a copy of every row
        raise SettingError(
            f"{name}: densification must end before the anchor is taken, got {until}. Set {name}={end}, or raise "
            "strategies.svs.anchor_start."
        )
    _log.warning(
        "the host densifies until %s=%d, but %s ends densification at %d. Lower %s to that iteration.",
        name, until, _forbidding(conductor, end - first), end, name,
    )  # fmt: skip


def _end_of_densification(conductor: Conductor, until: int, first: int) -> int:
    """The iteration, in the host's count, from which on the strategies no longer allow densification; at most `until`.

    A host's change of structure in iteration t reaches the strategies before `after_step(t)`, like a change after iteration t - 1
    in this package's trainer. Only the end of a host's densification can be set; a warning names earlier iterations at which a
    strategy forbids it.
    """
    allowed = [i for i in range(first, until) if conductor.may_densify(max(1, i - first))]
    end = allowed[-1] + 1 if allowed else first
    if gaps := sorted({*range(first, end)} - {*allowed}):
        _log.warning(
            "%s forbids densification at %d of the iterations before %d, the first is %d, but the host densifies there: "
            "only the end can be set from here.", _forbidding(conductor, gaps[0] - first), len(gaps), end, gaps[0],
        )  # fmt: skip
    return end


def _forbidding(conductor: Conductor, t: int) -> str:
    """The strategies that forbid densification at iteration t, at least 1."""
    return ", ".join(type(s).__name__ for s in conductor.strategies if not s.may_densify(max(1, t)))


class ScoreScaler:
    """Scales a score so that as many Gaussians pass the host's threshold as pass by the ordinary statistic.

    S_i is 3 to 30 times smaller than the statistic that hosts compare with their threshold. The factor is computed from
    means over the views of about one densification interval. It is the same for all Gaussians, so their order stays.

    Args:
        threshold: the host's densification threshold, on the mean over views of ‖∇_u‖ in NDC units.
        half_life: number of views after which a view counts half in the means.

    Attributes:
        factor: by which the score was last multiplied.
    """

    def __init__(self, threshold: float, half_life: int = 100) -> None:
        if not threshold > 0:
            raise SettingError(f"threshold: the host's densification threshold must be > 0, got {threshold}.")
        require_whole("half_life", half_life, least=1)
        self.threshold, self.factor = threshold, 1.0
        self._decay = 0.5 ** (1 / half_life)
        self._sums: Float[Tensor, "3 N"] | None = None
        self._views = 0

    def __call__(
        self, score: Float[Tensor, " N"], ordinary: Float[Tensor, " N"], visible: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """The scaled score of one view; a change of the number of Gaussians resets the means."""
        if self._sums is None or self._sums.shape[1] != len(score):
            self._sums, self._views = score.new_zeros(3, len(score)), 0
        self._sums = self._sums.to(score)  # a checkpoint may have been loaded onto another device
        self._sums *= self._decay
        self._sums += torch.stack((score, ordinary, torch.ones_like(score))) * visible
        if self._views % _VIEWS_PER_FIT == 0:
            mean_score, mean_ordinary = self._sums[:2] / self._sums[2].clamp_min(1e-12)
            self.factor = self._fit_factor(mean_score, mean_ordinary)
        self._views += 1
        return score * self.factor

    def state_dict(self) -> dict[str, Any]:
        """The means so far, for a checkpoint."""
        return {"factor": self.factor, "sums": None if self._sums is None else self._sums.clone(), "views": self._views}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.factor, self._sums, self._views = float(state["factor"]), state["sums"], int(state["views"])

    def _fit_factor(self, score: Float[Tensor, " N"], ordinary: Float[Tensor, " N"]) -> float:
        passing = count_passing(ordinary, self.threshold)
        # Without a passing Gaussian, the highest score becomes half the threshold.
        equivalent = topk_threshold(score, passing) if passing else 2 * float(score.max())
        return self.threshold / equivalent if equivalent > 0 else 1.0


def score_for_host(
    slot: ScreenGradientSlot,
    score: Float[Tensor, " N"],
    ordinary: Float[Tensor, " N"],
    visible: Bool[Tensor, " N"],
    scaler: ScoreScaler | None,
    loss_scale: float = 1.0,
) -> Float[Tensor, " N"] | None:
    """The values in NDC units that the host's densifier should read; None: its own.

    Args:
        score, ordinary: from `Conductor.scores`; the same tensor if no strategy has a score.
        loss_scale: the factor that the slot's own gradients carry.
    """
    absgrad = slot.absgrad(len(score))
    if absgrad is not None:
        # The host's threshold is for Σ|∂L/∂u|, so this statistic decides how many Gaussians pass.
        if score is ordinary:
            return None
        ordinary = screen_norm(to_ndc(absgrad / loss_scale, slot.size))
    return score if score is ordinary or scaler is None else scaler(score, ordinary, visible)


def warn_if_score_is_unused(conductor: Conductor, densifier: Any, threshold: float | None) -> None:
    """Warn if a strategy has a score, but the host's densifier has no threshold on the screen gradient."""
    scoring = conductor.owner("score")
    if scoring is not None and densifier is not None and threshold is None:
        _log.warning(
            "%s has no threshold on the screen gradient (gsplat's grow_grad2d, 3DGS's opt.densify_grad_threshold): the "
            "densification score of %s has no effect.", type(densifier).__name__, type(scoring).__name__,
        )  # fmt: skip


def warn_of_pruning_by_size(strategy: Any, state: Mapping[str, Any], scales: Float[Tensor, "N 3"]) -> None:
    """Warn if gsplat's strategy will remove many of the first Gaussians for their size.

    Args:
        state: of the strategy. scales: the logarithms.
    """
    begins, share = getattr(strategy, "reset_every", math.inf), getattr(strategy, "prune_scale3d", math.inf)
    largest = share * state.get("scene_scale", math.inf)
    removed = float((scales.detach().amax(1).exp() > largest).float().mean())
    if begins < getattr(strategy, "refine_stop_iter", 0) and removed > _MANY:
        _log.warning(
            "after step %d, gsplat removes Gaussians larger than prune_scale3d times the scale of the scene, %.3g. Of the first "
            "Gaussians, %.0f %% are. If the photos are few or small, this costs PSNR: set prune_scale3d=1e9.",
            begins, largest, 100 * removed,
        )  # fmt: skip
