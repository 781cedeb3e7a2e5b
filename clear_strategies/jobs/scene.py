"""The scene of a job, from its settings of data, views and prior."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Final, cast

from clear_strategies.core.work_log import WorkLog
from clear_strategies.data.capture import MORE_PHOTOS, Capture
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.file_names import require_text
from clear_strategies.data.prepare import prepare, truth_of
from clear_strategies.data.priors import Bicubic, Ncnn, Prior, cached, network_of
from clear_strategies.data.priors.ncnn import factors, missing_packages
from clear_strategies.data.refined_poses import refined
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_settings import ViewSettings, within_limit
from clear_strategies.errors import SettingError
from clear_strategies.settings import LISTED

_log = logging.getLogger(__name__)

FEW_PLACED: Final = "few photos"
"""The note of a scene in which so few photos have a pose that a warning is logged before and after training."""
_ENOUGH: Final = 0.6  # of the photos
_NETWORK: Final = "waifu2x"  # of `auto`: close to the truth and fast


def _variable() -> Any:
    """A key that only some data sets have: it is in their files of conf/, not among the defaults."""
    return field(default=None, metadata={LISTED: False})


@dataclass(frozen=True, slots=True, kw_only=True)
class DataSettings:
    """A data set, its views and its initial points.

    Args:
        reader: reads the capture; called after every setting has been checked.
        refine_poses: refine poses and focal lengths by bundle adjustment (extra `colmap`), where a network, such as VGGT, or a
            phone has estimated them.
        save_lr: write the LR images to this folder, for an external SR model, and stop.
        path, root, scene: what the files of conf/ refer to: the scene's folder, the folder of the scenes' folders, and the
            name of one of them.
    """

    reader: Callable[[], Any]
    views: ViewSettings = field(default_factory=ViewSettings)
    cloud: CloudSettings = field(default_factory=CloudSettings)
    save_lr: str | None = None
    refine_poses: bool = False
    path: str | None = _variable()
    root: str | None = _variable()
    scene: str | None = _variable()

    def __post_init__(self) -> None:
        if self.path is not None and "root" not in getattr(self.reader, "keywords", {}):
            raise SettingError("path is of no use: this data set is read from no folder. Choose another, data=….")

    @property
    def source(self) -> str:
        """The folder that is read; without one, the name of the reader, as "demo"."""
        read = getattr(self.reader, "func", self.reader)
        return self.path or str(getattr(read, "__module__", type(read).__module__)).rpartition(".")[2]


@dataclass(frozen=True, slots=True)
class AutoPrior:
    """The capture's own prior, as the demo has one; else waifu2x, if it is installed and reaches the factor; else bicubic."""

    def of(self, capture: Capture, views: ViewSettings) -> Prior:
        if capture.own_prior is not None:
            return capture.own_prior(truth_of(capture, views))
        usable = views.sr_scale in factors(_NETWORK) and not missing_packages(_NETWORK)
        return Ncnn(_NETWORK) if usable else Bicubic()


PriorSettings = AutoPrior | Callable[..., Any]
"""`auto`, a `Prior`, or a function that makes one from the HR photos: `_partial_` in conf/prior."""


def load(
    data: DataSettings, prior: PriorSettings, seed: int, decorate: Callable[[Prior], Prior] = lambda prior: prior
) -> Scene:
    """Read the data set and prepare its views and its initial points.

    Args:
        decorate: applied to the chosen prior, see `Conductor.prior`.
    """
    work_log = WorkLog()
    with work_log.stage("capture and poses"):
        capture, views = read(data, prior)
    if isinstance(prior, AutoPrior):
        chosen = prior.of(capture, views)
    elif isinstance(prior, functools.partial):
        chosen = prior(truth=truth_of(capture, views))
    else:
        chosen = cast("Prior", prior)
    scene = prepare(capture, views, decorate(cached(chosen)), data.cloud, seed=seed, work_log=work_log)
    # Logged once the photos are known to be usable.
    if isinstance(prior, AutoPrior) and views.photos_are != "both":
        if isinstance(chosen, Bicubic):
            _log.warning("prior: auto chose %s. %s.", chosen.label, _remedy(views.sr_scale))
        else:
            _log.debug("prior: auto chose %s.", chosen.label)
    return scene


def read(data: DataSettings, prior: PriorSettings | None) -> tuple[Capture, ViewSettings]:
    """Read the capture, and fit it and the settings of its views into the limit of the HR images' size.

    Args:
        prior: None: images of another program, which super-resolves what `save_lr` writes.
    """
    capture = refined(data.reader()) if data.refine_poses else data.reader()
    require_text((capture.name, *(frame.name for frame in capture.frames), *capture.unplaced))
    placed, photos = len(capture.frames), len(capture.frames) + len(capture.unplaced)
    if placed < _ENOUGH * photos:
        few = f"{placed} of {photos} photos ({placed / photos:.0%}) have a pose, and the others are not used: {MORE_PHOTOS}"
        capture = replace(capture, notes={**capture.notes, FEW_PLACED: few})
    auto = isinstance(prior, AutoPrior)
    network = network_of(prior)

    def reaches(factor: int) -> bool:
        if isinstance(network, Ncnn):
            return factor in factors(network.model)
        return auto or isinstance(prior, Bicubic)  # other priors are expected to reach `sr_scale` only

    return within_limit(capture, data.views, reaches=reaches, super_resolve=not auto)


def _remedy(factor: int) -> str:
    """The remedy if `auto` found no prior with detail for this factor."""
    if factor in factors(_NETWORK):
        return "For a super-resolution network: pip install 'clear-strategies[sr]'"
    reached = " or ".join(map(str, factors(_NETWORK)))
    return f"{_NETWORK} enlarges by {reached}, not by {factor}; for SR images: prior=images prior.path=FOLDER"
