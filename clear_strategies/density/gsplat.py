"""Density control by a strategy of gsplat's interface, over this trainer's field.

gsplat's strategies rewrite dicts of parameters and of optimizers by gathering rows, and read the gradient of the projected
centres. They receive the field's parameters, Adam's moments and the score in that form (`lent`), and their result is copied back.
"""

from __future__ import annotations

import inspect
import logging
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal

import torch
from jaxtyping import Int
from torch import Tensor, nn

from clear_strategies.core.finite import require_finite
from clear_strategies.core.gradients import Shot
from clear_strategies.core.seeds import seed_at
from clear_strategies.density.base import DensityError, require_in_range, structure_marks
from clear_strategies.density.lent import (
    ROWS,
    Info,
    Optimizer,
    RowNumbers,
    ViewScores,
    gsplat_version,
    info_of,
    lend,
    take_back,
)
from clear_strategies.density.strategy_class import strategy_class, unusable
from clear_strategies.density.threshold import topk_threshold
from clear_strategies.errors import SettingError
from clear_strategies.merging.iteration import Update
from clear_strategies.schedules import milestone
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam

_log = logging.getLogger(__name__)

# gsplat's name of a setting -> ours.
_OURS: Final = {
    "refine_start_iter": "start",
    "refine_stop_iter": "stop",
    "refine_every": "every",
    "reset_every": "reset_every",
    "grow_grad2d": "threshold",
    "cap_max": "max_gaussians",
}
# Settings that need statistics which this trainer does not report -> the value that needs none, and what they need.
_NOT_REPORTED: Final = {
    "absgrad": (False, "absolute screen gradients"),
    "refine_scale2d_stop_iter": (0, "screen radii"),
    "key_for_gradient": ("means2d", "other gradients than that of the projected centre"),
}


@dataclass(frozen=True, slots=True)
class GsplatSettings:
    """The strategy, and the settings that it shares with `DensitySettings`, by the names there; start < t < stop.

    Args:
        strategy: `_target_`, the dotted name of a class of gsplat's interface, and its other settings by their own names. It
            is imported when training starts.
        threshold: gsplat's grow_grad2d, on the mean over views of ‖∇_u‖ in NDC units; None: the strategy's own.
        mode: "quantile" moves the threshold so that as many Gaussians pass it by the score as would by the ordinary
            statistic; "fixed" leaves it. The same where the score is the ordinary one.
        start, stop, every: gsplat's refine_start_iter, refine_stop_iter and refine_every.
        reset_every: iterations between opacity resets; 0: never (DefaultStrategy then never prunes by size either).
        statistics_from: iteration before which no Gaussian counts as visible.
        max_gaussians: gsplat's cap_max; DefaultStrategy has none, so its threshold rises until the cap holds.
        min_gaussians: fewer are an error.

    Raises:
        SettingError: a setting is outside its range, or given in `strategy` instead of beside it.
    """

    strategy: Mapping[str, Any]
    threshold: float | None = None
    mode: Literal["quantile", "fixed"] = "quantile"
    start: int = milestone(500)
    stop: int = milestone(5_000)
    every: int = milestone(100, least=1)
    reset_every: int = milestone(3_000)
    statistics_from: int = milestone(500)
    max_gaussians: int = 1_000_000
    min_gaussians: int = 10

    def __post_init__(self) -> None:
        for theirs, ours in _OURS.items():
            if theirs in self.strategy:
                raise SettingError(f"strategy.{theirs} must stand beside the strategy, not in it: density.{ours}.")
        if self.threshold is not None and not self.threshold > 0:
            raise SettingError(f"threshold must be > 0, got {self.threshold}.")
        require_in_range(self)

    def densifier(
        self, n: int, *, extent: float, seed: int, white_background: bool, device: torch.device | str = "cpu"
    ) -> GsplatDensifier:
        """Import and build the strategy.

        Raises:
            DataError: it cannot be imported or built, or asks for what this trainer does not have.
        """
        device = torch.device(device)
        return GsplatDensifier(self, self._build(device), n, extent=extent, seed=seed, device=device)

    def _build(self, device: torch.device) -> Any:
        given = dict(self.strategy)
        kind = strategy_class(given.pop("_target_", None), device)
        for name, (silent, what) in _NOT_REPORTED.items():
            if given.get(name, silent) != silent:
                raise unusable(name, f"asks for {what}, which our rasterizers do not report", f"leave it at {silent}")
        ours = {theirs: getattr(self, name) for theirs, name in _OURS.items()}
        ours["reset_every"] = self.reset_every or sys.maxsize
        accepted = inspect.signature(kind).parameters
        taken = {name: value for name, value in ours.items() if name in accepted and value is not None}
        for theirs, name in _OURS.items():
            capped = name == "max_gaussians" and "grow_grad2d" in accepted
            if theirs not in accepted and getattr(self, name) and not capped:
                _log.warning("%s has no %s: density.%s has no effect.", kind.__name__, theirs, name)
        try:
            return kind(**given, **taken)
        except (TypeError, ValueError) as error:
            raise unusable("", f"{kind.__name__} cannot be built: {error}", "see its own documentation") from error


class GsplatDensifier:
    """Runs a strategy of gsplat's interface on our field and our Adam.

    Args:
        strategy: has check_sanity, initialize_state, step_pre_backward and step_post_backward. Tensors and numbers in
            its `state` dict are saved with the run.
        extent: 3DGS's cameras_extent, world units: gsplat's scene_scale. seed: of the strategy's random numbers.
        device: that of the field.
    """

    def __init__(
        self,
        settings: GsplatSettings,
        strategy: Any,
        n: int,
        *,
        extent: float,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.settings, self.strategy, self.extent, self.seed = settings, strategy, extent, seed
        self.kind = type(strategy).__name__
        self.state = self._initial_state()
        self.score, self.ordinary, self.count = (torch.zeros(n, device=device) for _ in range(3))
        self._view_scores: ViewScores | None = None
        self._checked = False
        self._warned: set[str] = set()

    @property
    def name(self) -> str:
        version = gsplat_version()
        return self.kind if version is None else f"{self.kind} (gsplat {version})"

    @property
    def marks(self) -> Mapping[str, int]:
        return structure_marks(self.settings.stop, self.settings.reset_every)

    def accumulate(self, update: Update, shot: Shot, t: int) -> None:
        """Keep this view's scores for `step`."""
        height, width = shot.image.shape[:2]
        visible = shot.visible if t > self.settings.statistics_from else torch.zeros_like(shot.visible)
        self._view_scores = ViewScores(update.score, update.ordinary, visible, shot.means2d.detach(), width, height)

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        """Run the strategy for iteration t.

        Raises:
            DensityError: it left too few Gaussians, or rows that do not belong together.
            DivergedError: a parameter was not finite.
        """
        seen, self._view_scores = self._view_scores, None
        if seen is None:
            raise ValueError(f"t={t}: step() must follow accumulate() of the same iteration.")
        n = len(field)
        self.score += torch.where(seen.visible, seen.score, 0.0)
        self.ordinary += torch.where(seen.visible, seen.ordinary, 0.0)
        self.count += seen.visible
        rates = optimizer.rates.at(optimizer.steps, optimizer.extent)
        before = field.raw()
        params, optimizers = lend(field, optimizer, rates)
        if not self._checked:
            self._check(params, optimizers)
        info = Info(info_of(seen))
        accepted = inspect.signature(self.strategy.step_post_backward).parameters
        rest = {"lr": rates["means"]} if "lr" in accepted else {}
        lent = RowNumbers(params[ROWS])
        with torch.no_grad(), _seeded(seed_at(self.seed, t), lent.rows.device), self._threshold(t):
            self.strategy.step_pre_backward(params, optimizers, self.state, t, info)
            self.strategy.step_post_backward(params, optimizers, self.state, t, info, **rest)
        moved = not lent.unchanged(params[ROWS])
        if moved:  # NaN fails every comparison: such a Gaussian would be pruned as if it were faint
            require_finite(f"t={t}: before densification, the parameter", before)
        parents = take_back(field, optimizer, params, optimizers, self.kind, moved=moved)
        self._remark(t, seen, info, optimizer)
        changed = moved and not torch.equal(parents, torch.arange(n, device=parents.device))
        if changed:
            self.score, self.ordinary, self.count = (x[parents] for x in (self.score, self.ordinary, self.count))
            self._report(parents, n, t)
            resized(parents)
        self._begin_anew()
        return changed

    def state_dict(self) -> dict[str, Tensor]:
        own = {"score": self.score, "ordinary": self.ordinary, "count": self.count}
        for name, value in self.state.items():
            if isinstance(value, Tensor):
                own[f"state.{name}"] = value
            elif isinstance(value, bool | int | float):
                own[f"state.{name}"] = torch.tensor(value, dtype=torch.float64 if isinstance(value, float) else None)
            elif value is not None:
                self._warn_once(
                    name,
                    f"checkpoints cannot hold {self.kind}'s {name!r}, a {type(value).__name__}: a resumed run starts it "
                    "anew.",
                )
        return own

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        device = self.score.device
        self.score, self.ordinary, self.count = (
            tensors[name].to(device, copy=True) for name in ("score", "ordinary", "count")
        )
        self.state = self._initial_state()
        for key, value in tensors.items():
            if key.startswith("state."):
                name = key.removeprefix("state.")
                number = isinstance(self.state.get(name), bool | int | float)
                self.state[name] = value.item() if number else value.to(device, copy=True)

    def _initial_state(self) -> dict[str, Any]:
        make = self.strategy.initialize_state
        scene = {"scene_scale": self.extent} if "scene_scale" in inspect.signature(make).parameters else {}
        return dict(make(**scene))

    def _check(self, params: dict[str, nn.Parameter], optimizers: Mapping[str, Optimizer]) -> None:
        try:
            self.strategy.check_sanity(params, optimizers)
        except AssertionError as error:
            raise DensityError(f"{self.kind} refuses these parameters: {error}") from error
        self._checked = True

    @contextmanager
    def _threshold(self, t: int) -> Iterator[None]:
        """Set a threshold that the right number of Gaussians pass, while the strategy may grow."""
        own = getattr(self.strategy, "grow_grad2d", None)
        if own is None or t % getattr(self.strategy, "refine_every", 1) != 0:
            yield
            return
        self.strategy.grow_grad2d = self._selective(own)
        try:
            yield
        finally:
            self.strategy.grow_grad2d = own

    def _selective(self, threshold: float) -> float:
        """A threshold that as many Gaussians pass by the score as by the ordinary statistic, within the cap."""
        s, seen = self.settings, self.count.clamp_min(1)
        score, ordinary = self.score / seen, self.ordinary / seen
        wanted = int(((ordinary if s.mode == "quantile" else score) > threshold).sum())
        room = max(0, s.max_gaussians - len(score))
        if wanted > room:
            self._warn_once(
                "cap",
                f"the cap of {s.max_gaussians} Gaussians binds: {wanted} want to densify, {room} may. Raise "
                "density.max_gaussians, or density.threshold.",
            )
        allowed = min(wanted, room)
        return threshold if allowed == int((score > threshold).sum()) else topk_threshold(score, allowed)

    def _begin_anew(self) -> None:
        """Set our sums to 0 when the strategy has set its own to 0."""
        count = self.state.get("count")
        if isinstance(count, Tensor):
            begun = ~count.any()
            for total in (self.score, self.ordinary, self.count):
                total.masked_fill_(begun, 0)

    def _report(self, parents: Int[Tensor, " M"], n: int, t: int) -> None:
        children = torch.bincount(parents, minlength=n)
        grown, gone = int((children > 1).sum()), int((children == 0).sum())
        _log.debug("t=%d: %s: %d grown, %d removed: %d -> %d Gaussians.", t, self.kind, grown, gone, n, len(parents))
        if len(parents) < self.settings.min_gaussians:
            raise DensityError(
                f"t={t}: {self.kind} left {len(parents)} of {n:,} Gaussians, fewer than "
                f"min_gaussians={self.settings.min_gaussians}. Prune less, or start from a denser cloud."
            )

    def reset_due(self, t: int) -> bool:
        return t < self.settings.stop and t % getattr(self.strategy, "reset_every", sys.maxsize) == 0

    def _remark(self, t: int, seen: ViewScores, info: Info, optimizer: Adam) -> None:
        """Warn once of settings that have no effect."""
        if seen.score is not seen.ordinary and "means2d" not in info.read:
            self._warn_once(
                "score", f"{self.kind} reads no screen gradient: the strategies' score has no effect on the structure."
            )
        if self.reset_due(t) and bool(optimizer.second["opacities"].any()):  # a reset leaves no momentum
            self._warn_once(
                "reset",
                f"t={t}: density.reset_every falls here, and {self.name} reset no opacity. gsplat 1.5's DefaultStrategy "
                "never does.",
            )

    def _warn_once(self, about: str, message: str) -> None:
        if about not in self._warned:
            self._warned.add(about)
            _log.warning("%s", message)


@contextmanager
def _seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed torch's global generators, which gsplat uses, and restore them afterwards."""
    on_cuda = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if on_cuda else []):
        torch.default_generator.manual_seed(seed)  # torch.manual_seed would look for other devices, every time
        if on_cuda:
            torch.cuda.manual_seed(seed)
        yield
