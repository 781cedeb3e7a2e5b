"""What a host's own densifier gets to read: ∇_u where the host keeps it, in its shape and unit, at a scale that its fixed
threshold understands.  Eq. 14
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.gradients import to_ndc
from clear_strategies.merging.conductor import Conductor

_log = logging.getLogger(__name__)

_LOOK_EVERY: Final = (
    10  # views between two looks at the scale; sorting N scores for each view would cost more than it tells
)


@dataclass(frozen=True, slots=True, eq=False)
class Screen:
    """The tensor in which a host keeps ∇_u, the gradient of the projected centres.

    Args:
        tensor: [N, 2 or more], with a leading 1 where the host thinks in batches, or a row for each Gaussian of `rows`
            where it packs what it sees.
        size: (width, height) of the image, pixels.
        unit: from a gradient of the tensor to 1/pixel: 1 in gsplat, whose tensor is in pixels; (2 / width, 2 / height) in
            Inria's, whose tensor is in NDC.
        rows: None, or the Gaussian of each row.
    """

    tensor: Tensor
    size: tuple[int, int]
    unit: tuple[float, float] = (1.0, 1.0)
    rows: Int[Tensor, " M"] | None = None

    def gradient(self, of_tensor: Tensor, n: int) -> Float[Tensor, "N 2"]:
        """∇_u of every Gaussian in 1/pixel, from the gradient of the tensor."""
        g = of_tensor.reshape(-1, of_tensor.shape[-1])[:, :2] * of_tensor.new_tensor(self.unit)
        return g if self.rows is None else g.new_zeros(n, 2).index_add_(0, self.rows, g)

    def absolute(self, n: int) -> Float[Tensor, "N 2"] | None:
        """Σ|∂L/∂u| over pixels of every Gaussian in 1/pixel, where the host densifies by that (gsplat's `absgrad`)."""
        kept = getattr(self.tensor, "absgrad", None)
        return None if kept is None else self.gradient(kept, n)

    def hand_over(self, magnitude: Float[Tensor, " N"]) -> None:
        """Make the tensor's `.grad` (and gsplat's `.absgrad`) one whose norm in NDC units is `magnitude`.

        Columns beyond the second are the host's: some keep absolute gradients there.
        """
        given = torch.zeros_like(self.tensor)
        if self.tensor.grad is not None:
            given[..., 2:] = self.tensor.grad[..., 2:]
        rows = magnitude if self.rows is None else magnitude[self.rows]
        given.view(-1, given.shape[-1])[:, 0] = rows.to(given) * (2 / self.size[0] / self.unit[0])
        self.tensor.grad = given
        if hasattr(self.tensor, "absgrad"):
            self.tensor.absgrad = given


class Scale:
    """Makes a score fit a threshold that was set for another: as many Gaussians pass as would by the ordinary statistic.

    S_i is 3 to 30 times smaller than what hosts usually hold against their threshold. The factor follows the means over
    the views of about one densification interval; it is the same for all Gaussians, so that their order stays.

    Args:
        threshold: the host's, on the mean over views of ‖∇_u‖ in NDC units.
        memory: views after which what was seen counts half.
    """

    def __init__(self, threshold: float, memory: int = 100) -> None:
        if not threshold > 0:
            raise ValueError(f"the host's densification threshold must be > 0, got {threshold}.")
        if memory < 1:
            raise ValueError(f"memory must be at least 1 view, got {memory}.")
        self.threshold, self._keep = threshold, 0.5 ** (1 / memory)
        self._sums: Float[Tensor, "3 N"] | None = None
        self._views, self.factor = 0, 1.0

    def __call__(
        self, score: Float[Tensor, " N"], ordinary: Float[Tensor, " N"], seen: Bool[Tensor, " N"]
    ) -> Float[Tensor, " N"]:
        """S as the host should read it."""
        if self._sums is None or self._sums.shape[1] != len(score):
            self._sums, self._views = score.new_zeros(3, len(score)), 0  # another structure: statistics start anew
        self._sums *= self._keep
        self._sums += torch.stack((score, ordinary, torch.ones_like(score))) * seen
        if self._views % _LOOK_EVERY == 0:
            self.factor = self._look()
        self._views += 1
        return score * self.factor

    def _look(self) -> float:
        mean_score, mean_ordinary = self._sums[:2] / self._sums[2].clamp_min(1e-12)  # type: ignore[index]
        passing = int((mean_ordinary >= self.threshold).sum())
        best = mean_score.topk(min(passing + 1, len(mean_score))).values
        # Between the last that shall pass and the first that shall not.
        last, next_one = best[max(passing - 1, 0)], best[-1]
        middle = float((last * next_one).sqrt()) if passing else 2 * float(best[0])
        return self.threshold / middle if middle > 0 else 1.0


def to_read(
    screen: Screen,
    score: Float[Tensor, " N"],
    ordinary: Float[Tensor, " N"],
    seen: Bool[Tensor, " N"],
    scale: Scale | None,
    times: float = 1.0,
) -> Float[Tensor, " N"] | None:
    """What a host's densifier should read, in NDC units; None: what it has already.

    Args:
        score, ordinary: what the conductor said; the same tensor where no strategy answered.
        times: by what the screen's own gradients are scaled (the host's loss scale).
    """
    absolute = screen.absolute(len(score))
    if absolute is not None:
        # The host's threshold is one for Σ|∂L/∂u|: a score shall let as many pass as that does.
        if score is ordinary:
            return None
        ordinary = torch.linalg.vector_norm(to_ndc(absolute / times, screen.size), dim=-1)
    return score if score is ordinary or scale is None else scale(score, ordinary, seen)


def warn_of_early_end(conductor: Conductor, until: int | None, setting: str) -> None:
    """Say beforehand where a strategy wants densification to end and the host's `setting` lets it go on."""
    if until is not None and conductor.may_densify(0) and not conductor.may_densify(until - 1):
        _log.warning(
            "the host densifies until %s=%d, but a strategy ends densification before (SVS: anchor_start). Set %s to that.",
            setting, until, setting,
        )  # fmt: skip


def warn_of_unread_score(conductor: Conductor, densifier: Any, threshold: float | None) -> None:
    """Say where a strategy scores and the host's densifier, which has no threshold, reads no screen gradient."""
    scoring = conductor.owner("score")
    if scoring is not None and densifier is not None and threshold is None:
        _log.warning(
            "%s reads no screen gradient: the densification score of %s has no effect.",
            type(densifier).__name__, type(scoring).__name__,
        )  # fmt: skip
