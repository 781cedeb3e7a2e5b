"""The input of training: views at two scales, the initial points, and notes on their origin. `require_shown` checks that masks
and alpha leave pixels to train on, for other trainers, too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.data.file_names import some
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_NOTHING: Final = 1e-3  # share of a photo's pixels; a photo that shows fewer is not used
_NEARLY_ALL: Final = 0.9  # of the photos
_FAINT: Final = 0.02  # alpha up to which a pixel counts as transparent; includes 1 of 255, as in an alpha of 0 and 1
_LITTLE: Final = 0.1  # share of all pixels; masks that show less are probably inverted


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The input of a run.

    Args:
        background: the colour behind the Gaussians.
        synthetic_prior: the SR images contain seeded errors, or the truth (the demo); reports mark such runs.
        notes: label -> fact, for the printed plan and the provenance.
        work_log: how long the views and the initial points took.
    """

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    cloud: PointCloud
    background: Color = (0.0, 0.0, 0.0)
    synthetic_prior: bool = False
    notes: dict[str, str] = field(default_factory=dict)
    work_log: WorkLog = field(default_factory=WorkLog)

    @property
    def device(self) -> torch.device:
        """The device of the training views' images, and of what is trained on them."""
        return self.train[0].lr.image.device

    def to(self, device: torch.device | str) -> Scene:
        """The same scene with all views on `device`; the cloud, which is read once, stays on the CPU."""
        return replace(self, train=tuple(v.to(device) for v in self.train), test=tuple(v.to(device) for v in self.test))


def require_shown(views: Sequence[View]) -> None:
    """Warn of photos that masks or alpha hide completely, and of masks that hide most pixels of all photos.

    Raises:
        DataError: nearly all photos are hidden completely.
    """
    empty = [view.name for view in views if _shown_share(view.lr) < _NOTHING]
    why = "their masks hide every pixel, or their alpha is 0"
    if len(empty) > _NEARLY_ALL * len(views):
        problem = f"show nothing of {len(empty)} of {len(views)} photos: {some(empty)}"
        remedy = "a mask is 0 where it hides, and alpha where it is transparent: invert them, or train without them"
        raise DataError(empty[0], "masks or alpha", problem, remedy)
    if empty:
        _log.warning(
            "%d of %d photos are not used in training, since %s: %s.", len(empty), len(views), why, some(empty)
        )
    masked = [float(view.lr.shown.float().mean()) for view in views if view.lr.shown is not None]
    if masked and sum(masked) < _LITTLE * len(masked):
        message = "masks hide %.0f%% of their %d photos. A mask is 0 where it hides: are they upside down?"
        _log.warning(message, 100 * (1 - sum(masked) / len(masked)), len(masked))


def _shown_share(photo: Photo) -> float:
    """The share of its pixels that a photo shows."""
    shown = photo.visible
    if photo.transparency is not None:
        shown = shown & (photo.transparency < 1 - _FAINT)
    return float(shown.float().mean())
