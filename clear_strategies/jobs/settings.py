"""The settings of a job: the whole of conf/config.yaml, as objects."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from clear_strategies.compose import ConductorSettings
from clear_strategies.data.priors import Bicubic, Ncnn, Prior, network_of
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device, scene
from clear_strategies.jobs.device import RasterizerSettings
from clear_strategies.options import CONF
from clear_strategies.settings import build
from clear_strategies.training.densifier import DensifierSettings
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class JobSettings(ConductorSettings):
    """The whole of conf/config.yaml, as objects.

    Args:
        metrics: further metrics of the renders by name, each called with an image and the truth, [H, W, 3] in [0, 1].
        method: the name of a baseline of the papers' tables, for the plan and the tables; set by +method=NAME.
    """

    rasterizer: RasterizerSettings | functools.partial[Any]
    prior: scene.PriorSettings
    data: scene.DataSettings
    density: DensifierSettings
    optim: LearningRates
    fit: FitSettings = field(default_factory=FitSettings)
    mip: MipFilter = field(default_factory=MipFilter)
    metrics: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    method: str | None = None

    def __post_init__(self) -> None:
        if isinstance(self.prior, functools.partial):
            self.prior(truth={})  # checks its settings; it is made again with the photos
        elif not isinstance(self.prior, scene.AutoPrior | Prior):
            raise SettingError(
                f"prior: {type(self.prior).__name__} is no Prior: it needs the property label, and __call__."
            )
        for decorate in self.decorators.values():
            decorate(Bicubic())  # checks its settings, too
        if isinstance(network := network_of(self.prior), Ncnn):
            network.require_factor(self.data.views.sr_scale)


def settings_of(values: Mapping[str, Any]) -> JobSettings:
    """The settings of a resolved configuration, see `compose.tree`.

    Raises:
        SettingError: as `build`; for a group with a name close to one of conf/, it suggests that one.
    """
    groups, known = [folder.name for folder in CONF.iterdir()], {f.name for f in fields(JobSettings)}
    for key, value in values.items():
        if key not in known and (near := difflib.get_close_matches(key, groups, 1)):
            word = f"{'' if near[0] in values else '+'}{near[0]}={value if isinstance(value, str) else '…'}"
            raise SettingError(f"{key}: there is no such setting. Did you mean {word}?")
    nodes = {"rasterizer": device.rasterizer_node(values["rasterizer"])} if "rasterizer" in values else {}
    settings = build({**values, **nodes})
    if not isinstance(settings, JobSettings):
        raise SettingError("--config-name: must be a configuration of a run, as config of conf/ is. Leave it out.")
    return settings
