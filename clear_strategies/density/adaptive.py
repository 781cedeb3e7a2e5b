"""Adaptive density control of 3DGS by the strategies' score. Clone, split and prune are one gather map, `parents`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from clear_strategies.core.checks import require_choice, require_number, require_whole
from clear_strategies.core.finite import require_finite
from clear_strategies.core.gradients import Shot
from clear_strategies.core.seeds import generator_at
from clear_strategies.core.view import View
from clear_strategies.density.threshold import count_passing, topk_mask
from clear_strategies.errors import DensityError
from clear_strategies.kernels import per_gaussian
from clear_strategies.merging.iteration import Update
from clear_strategies.schedules import milestone
from clear_strategies.training.densifier import Densifier, cameras_extent
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)

_CHILDREN: Final = 2  # a split Gaussian becomes two …
_SHRINK: Final = 0.8 * _CHILDREN  # … each smaller by this factor
_RESET_OPACITY: Final = 0.01
_RETURN: Final = 92  # steps of Adam at 3DGS's rate, 0.05, from the logit of 0.01 to that of 1/2
_FEWEST_ROUNDS: Final = 10


@dataclass(frozen=True, slots=True)
class DensitySettings:
    """Settings of cloning, splitting, pruning and opacity resets, in iterations start < t < stop.

    Args:
        threshold: on the mean over views of ‖∇_u‖ in NDC units; 3DGS 2e-4, sparse-view forks 5e-4 (F10).
        mode: "quantile" selects as many Gaussians by the score as the ordinary statistic selects by the threshold; "fixed"
            compares the score itself with the threshold. Both are the same if the score is the ordinary one (F9).
        reduce: a Gaussian's statistic is the "mean" or the "max" over the views since the last round (F12).
        start, stop: iterations between which the structure changes.
        statistics_from: iteration after which statistics are accumulated (F11).
        every: iterations between rounds; lowered where fewer than 10 rounds would fit.
        clone_below: share of the scene's extent; smaller Gaussians are cloned, larger ones are split.
        prune_opacity: Gaussians of lower opacity are removed.
        prune_world: Gaussians that are larger than this share of the extent, after cloning and splitting, are removed in every
            round; None: never. 3DGS and gsplat begin with it after the first opacity reset.
        reset_every: iterations between opacity resets to 0.01, stretched to no less than 92, in which an opacity can return to
            1/2; 0: never. White backgrounds get one more reset at `start` (F14).
        max_gaussians: largest number of Gaussians; a warning is logged when it limits densification.
        min_gaussians: pruning to fewer is an error, unless nothing is pruned.
    """

    threshold: float = 5e-4
    mode: Literal["quantile", "fixed"] = "quantile"
    reduce: Literal["mean", "max"] = "mean"
    start: int = milestone(500)
    stop: int = milestone(5_000)
    statistics_from: int = milestone(500)
    reset_every: int = milestone(3_000, least=_RETURN)
    every: int = 100
    clone_below: float = 0.01
    prune_opacity: float = 0.005
    prune_world: float | None = None
    max_gaussians: int = 1_000_000
    min_gaussians: int = 10

    def __post_init__(self) -> None:
        require_number("threshold", self.threshold, above=0)
        require_choice("mode", self.mode, ("quantile", "fixed"))
        for name, least in (("every", 1), ("max_gaussians", 1), ("min_gaussians", 1), ("reset_every", 0)):
            require_whole(name, getattr(self, name), least=least)
        require_choice("reduce", self.reduce, ("mean", "max"))
        require_number("prune_opacity", self.prune_opacity, below=1)
        require_number("clone_below", self.clone_below)
        if self.prune_world is not None:
            require_number("prune_world", self.prune_world, above=0)

    @property
    def interval(self) -> int:
        """`every`, or less where the window would not hold 10 rounds."""
        return max(1, min(self.every, (self.stop - self.start) // _FEWEST_ROUNDS))

    def densifier(self, field: GaussianField, views: Sequence[View], seed: int) -> Density:
        return Density(self, field, views, seed)


class Density(Densifier):
    """Accumulates statistics per Gaussian of a field that trains on the views, and clones, splits and prunes Gaussians by them.

    Attributes:
        extent: 3DGS's cameras_extent, world units. white_background: adds the early opacity reset.
    """

    name = "density control"

    def __init__(self, settings: DensitySettings, field: GaussianField, views: Sequence[View], seed: int) -> None:
        self.settings: DensitySettings = settings
        self.extent, self.white_background = cameras_extent(views), all(c == 1.0 for c in views[0].background)
        self.score, self.ordinary, self.count = (torch.zeros(len(field), device=field.means.device) for _ in range(3))
        self.seed, self.cap, self._warned_of_cap = seed, settings.max_gaussians, False

    def collects(self, t: int) -> bool:
        return self.settings.statistics_from < t < self.settings.stop

    def accumulate(self, update: Update, shot: Shot, t: int) -> None:
        """Add the scores of this view's visible Gaussians; dropped ones are not visible."""
        if update.score is None or update.ordinary is None:
            return
        totals = (self.score, self.ordinary, self.count)
        per_gaussian.accumulate(shot.visible, update.score, update.ordinary, totals, self.settings.reduce == "max")

    def due(self, t: int) -> bool:
        """Return True if Gaussians are densified and pruned at t."""
        s = self.settings
        return s.start < t < s.stop and t % s.interval == 0

    def reset_due(self, t: int) -> bool:
        """Return True if opacities are reset at t."""
        s = self.settings
        if not s.start <= t < s.stop:
            return False
        return self.white_background if t == s.start else s.reset_every > 0 and t % s.reset_every == 0

    def settled(self, t: int) -> bool:
        return t >= self.settings.stop

    def gather(self, parents: Int[Tensor, " M"]) -> None:
        self.score, self.ordinary, self.count = (x[parents] for x in (self.score, self.ordinary, self.count))

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        if due := self.due(t):
            resized(self.restructure(field, optimizer, t))
        if self.reset_due(t):
            self.reset_opacity(field, optimizer)
        return due

    def restructure(self, field: GaussianField, optimizer: Adam, t: int) -> Int[Tensor, " M"]:
        """Clone, split and prune; returns parents [M]: row i of every per-Gaussian tensor comes from row parents[i].

        Raises:
            DensityError: pruning would leave fewer than min_gaussians.
            DivergedError: a parameter or a statistic is not finite.
        """
        s, n = self.settings, len(field)
        # NaN fails every comparison: the Gaussian would be pruned like one of low opacity.
        require_finite(f"t={t}: before densification, the parameter", field.raw(), waits=True)
        statistics = {"score": self.score, "‖∇_u L‖": self.ordinary}
        require_finite(f"t={t}: before densification, the sum", statistics, waits=True)
        chosen = self._chosen()
        largest = field.scales.data.exp().amax(-1)
        split = chosen & (largest > s.clone_below * self.extent)
        keep = field.filtered_opacities() >= s.prune_opacity
        if s.prune_world is not None:
            after = torch.where(split, largest / _SHRINK, largest)  # 3DGS prunes last, among the children
            keep &= after <= s.prune_world * self.extent
        if int(keep.sum()) < min(s.min_gaussians, n):
            larger = "" if s.prune_world is None else f", or raise density.prune_world={s.prune_world}"
            raise DensityError(
                f"t={t}: pruning would leave {int(keep.sum())} of {n:,} Gaussians, fewer than min_gaussians={s.min_gaussians}. "
                f"Lower density.prune_opacity={s.prune_opacity}{larger}, or start from a denser cloud."
            )
        rows = torch.arange(n, device=chosen.device)
        stay, clones, splits = rows[keep & ~split], rows[keep & chosen & ~split], rows[keep & split]
        parents = self._succeed(field, optimizer, stay, torch.cat((clones, splits.repeat(_CHILDREN))))
        self._place_children(field, slice(len(stay) + len(clones), len(parents)), t)
        _log.debug(
            "t=%d: %d cloned, %d split, %d pruned: %d -> %d Gaussians.",
            t, len(clones), len(splits), n - int(keep.sum()), n, len(parents),
        )  # fmt: skip
        return parents

    def reset_opacity(self, field: GaussianField, optimizer: Adam) -> None:
        """Lower every rendered opacity to at most 0.01, and reset its moments in Adam."""
        field.lower_opacities(_RESET_OPACITY)
        optimizer.forget("opacities")

    def state_dict(self) -> dict[str, Tensor]:
        return {"score": self.score, "ordinary": self.ordinary, "count": self.count}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        device = self.score.device
        self.score, self.ordinary, self.count = (
            tensors[name].to(device, copy=True) for name in ("score", "ordinary", "count")
        )

    def _chosen(self) -> Bool[Tensor, " N"]:
        """The mask of Gaussians to clone or split: those of highest score, as many as the threshold and the cap allow."""
        s = self.settings
        views = self.count.clamp_min(1) if s.reduce == "mean" else torch.ones_like(self.count)
        score, ordinary = self.score / views, self.ordinary / views
        wanted = count_passing(ordinary if s.mode == "quantile" else score, s.threshold)
        room = max(0, s.max_gaussians - len(score))
        if wanted > room and not self._warned_of_cap:
            _log.warning(
                "the limit of %d Gaussians is reached: %d are to be cloned or split, and there is room for %d. "
                "Raise density.max_gaussians, or density.threshold.", s.max_gaussians, wanted, room,
            )  # fmt: skip
            self._warned_of_cap = True
        return topk_mask(score, min(wanted, room))

    def _succeed(
        self, field: GaussianField, optimizer: Adam, stay: Int[Tensor, " K"], copied: Int[Tensor, " C"]
    ) -> Int[Tensor, " M"]:
        """Gather the rows that stay, and after them copies without momentum; returns parents [M]. Statistics begin anew."""
        parents = torch.cat((stay, copied))
        field.take(parents)
        optimizer.take(parents, torch.arange(len(parents), device=parents.device) >= len(stay))
        self.score, self.ordinary, self.count = (self.score.new_zeros(len(parents)) for _ in range(3))
        return parents

    def _place_children(self, field: GaussianField, children: slice, t: int) -> None:
        """Place split children at random inside their parent, and make them smaller."""
        scales = field.scales.data[children]
        generator = generator_at(self.seed, t, scales.device)
        offset = torch.randn(scales.shape, generator=generator, device=scales.device) * scales.exp()
        rotation = rotation_matrix(field.quats.data[children])
        field.means.data[children] += (rotation @ offset[..., None])[..., 0]
        field.scales.data[children] = scales - math.log(_SHRINK)
