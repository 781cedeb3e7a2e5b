"""The settings of a job: the whole of conf/config.yaml, as objects."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from clear_strategies.compose import ConductorSettings
from clear_strategies.core.checks import require_whole
from clear_strategies.data.priors import Bicubic, Prior
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device, scene
from clear_strategies.jobs.device import Device, RasterizerSettings
from clear_strategies.settings import build
from clear_strategies.training.densifier import DensifierSettings
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class RunSettings(FitSettings):
    """Settings of a run: those of its training, what it shows and writes, and where it computes.

    Args:
        map_views: number of training views with maps of reliability and correction in maps/; 0: none.
        video: number of frames of path.mp4, a loop through the training cameras, 24 a second; 0: none.
        verbose: also show on the console the details that run.log holds; `-v` on the command line.
        page: write splat.html, which shows the field in any browser, if it has at most this many Gaussians; 0: never.
        viewer: look at the field in the browser while it trains; the address is logged. Extra [view].
        resume: a run's folder or one of its checkpoints: continue from there, bit for bit. auto: look into the run's own
            folder. If the run is finished, train nothing; if it has checkpoints, continue from the newest one; else start
            from the beginning.
        device: cpu or cuda: where field, views and optimizer are. None: cuda if torch finds it and the rasterizer draws
            there, else cpu. A run may be resumed on another device; its bits then differ.
        threads: number of threads of torch and the kernels. None: all cores, divided by the jobs that run at once (joblib).
    """

    map_views: int = 3
    video: int = 72
    page: int = 500_000
    verbose: bool = False
    viewer: bool = False
    resume: str | None = None
    device: Device | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        FitSettings.__post_init__(self)
        for name in ("map_views", "video", "page"):
            require_whole(name, getattr(self, name), least=0)
        if self.threads is not None:
            require_whole("threads", self.threads, least=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobSettings(ConductorSettings):
    """The whole of conf/config.yaml, as objects.

    Args:
        method: which baseline of the papers' tables this is, for the plan and the tables; set by +method=NAME.
    """

    rasterizer: RasterizerSettings | functools.partial[Any]
    prior: scene.PriorSettings
    data: scene.DataSettings
    density: DensifierSettings
    optim: LearningRates
    fit: RunSettings = field(default_factory=RunSettings)
    mip: MipFilter = field(default_factory=MipFilter)
    method: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.prior, functools.partial):
            self.prior(truth={})  # it waits for the photos; its own settings are refused now
        elif not isinstance(self.prior, scene.AutoPrior | Prior):
            raise SettingError(
                f"prior: {type(self.prior).__name__} is no Prior: it needs the property label, and __call__."
            )
        for decorate in self.decorators.values():
            decorate(Bicubic())  # likewise
        scene.require_factor(self.prior, self.data.views.sr_scale)


def settings_of(values: Mapping[str, Any]) -> JobSettings:
    """The settings of a resolved configuration, see `compose.tree`.

    Raises:
        SettingError: one cannot be used; the message begins with its key.
    """
    settings: JobSettings = build({**values, "rasterizer": device.rasterizer_node(values["rasterizer"])})
    return settings
