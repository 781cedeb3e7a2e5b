"""The scene of a job: which data, which views of it, which prior."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast

from clear_strategies.data.capture import Capture
from clear_strategies.data.points import CloudSettings
from clear_strategies.data.prepare import ViewSettings, prepare
from clear_strategies.data.priors import Bicubic, DemoPrior, Prior, cached
from clear_strategies.data.scene import Scene
from clear_strategies.errors import SettingError
from clear_strategies.settings import LISTED

_log = logging.getLogger(__name__)


def _variable() -> Any:
    """A key that only some data sets have; conf/ puts it there, the defaults do not."""
    return field(default=None, metadata={LISTED: False})


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSettings:
    """A data set, and what is made of it.

    Args:
        reader: reads the capture; called once every setting has been checked.
        save_lr: write the LR images to this folder, for an external SR model, and stop.
        path, root, scene: for the interpolations of conf/: the scene's folder, the folder of the scenes' folders, and the
            name of one of them.
    """

    reader: Callable[[], Any]
    views: ViewSettings = field(default_factory=ViewSettings)
    cloud: CloudSettings = field(default_factory=CloudSettings)
    save_lr: str | None = None
    path: str | None = _variable()
    root: str | None = _variable()
    scene: str | None = _variable()

    def __post_init__(self) -> None:
        if self.path is not None and "root" not in getattr(self.reader, "keywords", {}):
            raise SettingError("path is of no use: this data set is read from no folder. Choose another, data=….")


@dataclass(frozen=True, slots=True)
class AutoPrior:
    """The demo's own prior for the demo, bicubic for everything else."""

    def of(self, capture: Capture) -> Prior:
        """The prior for this capture."""
        return DemoPrior(_photos(capture)) if capture.name == "demo" else Bicubic()


PriorSettings = AutoPrior | Callable[..., Any]
"""`auto`, a `Prior`, or one that waits for the HR photos: `_partial_` in conf/prior."""


def _photos(capture: Capture) -> dict[str, Callable[[], Any]]:
    return {frame.name: frame.load for frame in capture.frames}


def load(data: DataSettings, prior: PriorSettings, seed: int) -> Scene:
    """Read the data set and prepare its views and its initial points."""
    capture = data.reader()
    if data.save_lr is not None:
        chosen: Prior = Bicubic()  # the images that the prior itself reads may not exist yet
    elif isinstance(prior, AutoPrior):
        chosen = prior.of(capture)
    elif isinstance(prior, functools.partial):
        chosen = prior(truth=_photos(capture))
    else:
        chosen = cast("Prior", prior)
    scene = prepare(capture, data.views, cached(chosen), data.cloud, seed=seed)
    if isinstance(prior, AutoPrior) and data.save_lr is None:  # logged once the photos are known to be usable
        _log.info("prior: auto chose %s.", chosen.label)
        if isinstance(chosen, Bicubic):
            _log.warning(
                "A bicubic prior has no detail that LR has not. For SR images: prior=images prior.path=FOLDER."
            )
    return scene
