"""The input of training: views at two scales, the initial points, and notes on where each came from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import View
from clear_strategies.core.work_log import WorkLog
from rasterizers.interface import Color


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The input of a run."""

    name: str
    train: tuple[View, ...]
    test: tuple[View, ...]
    cloud: PointCloud
    background: Color = (0.0, 0.0, 0.0)  # behind the Gaussians
    synthetic_prior: bool = (
        False  # the SR images contain seeded errors, or the truth (the demo); reports mark such runs
    )
    notes: dict[str, str] = field(
        default_factory=dict
    )  # label -> fact, as the plan prints and the provenance keeps them
    unplaced: Mapping[str, str] = field(default_factory=dict)  # see `Capture.unplaced`; such photos are not used
    work_log: WorkLog = field(default_factory=WorkLog)  # how long the views and the initial points took

    @property
    def device(self) -> torch.device:
        """The device of the training views' images, and of what is trained on them."""
        return self.train[0].lr.image.device

    def to(self, device: torch.device | str) -> Scene:
        """The same scene with all views on `device`; the cloud, which is read once, stays on the CPU."""
        return replace(self, train=tuple(v.to(device) for v in self.train), test=tuple(v.to(device) for v in self.test))
