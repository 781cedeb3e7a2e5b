"""Train from Python: `run = clear_strategies.train("photos")`.

The command line composes the same configuration and calls the same job (`clear-strategies train`, `clear_strategies.jobs.job`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import console
from clear_strategies.commands import path_of
from clear_strategies.commands import train as train_command
from clear_strategies.compose import composed, require_text
from clear_strategies.core.checks import refuse
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.data.ply import read_gaussians
from clear_strategies.data.strict_json import read_object
from clear_strategies.errors import DataError
from clear_strategies.files import FINISHED
from clear_strategies.hydra_app import readable
from clear_strategies.jobs import exit_codes, job
from clear_strategies.jobs.device import BY_NAME
from clear_strategies.jobs.saved import SavedSplat, open_splat
from clear_strategies.settings import TARGET
from rasterizers.interface import Camera


@dataclass(frozen=True)
class Run:
    """A finished run; a DataError where the folder holds none.

    Args:
        folder: of its files, which `docs/reference/files.md` lists; made absolute.
        rasterizer: that draws it, as `clear-strategies render --rasterizer` takes it; None: the one that the run trained with. A
            class that `rasterizer._target_` named has to be named again, unless `train` returned the run: no file does it.
    """

    folder: Path
    rasterizer: str | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", path_of(str(self.folder)).absolute())  # a notebook may change its folder
        if not (self.folder / FINISHED).is_file():
            raise DataError(self.folder, FINISHED, "is not there, so no run has finished here", "train first")

    @cached_property
    def metrics(self) -> Mapping[str, Any]:
        """The content of metrics.json: scores of every view and their means, seconds, configuration, provenance."""
        return read_object(self.folder / FINISHED)

    @cached_property
    def splats(self) -> Mapping[str, Tensor]:
        """The Gaussians by gsplat's names, on the CPU; f_det and the 3D filter are part of them, as in point_cloud.ply."""
        gaussians = read_gaussians(self.folder / "point_cloud.ply")
        return {name: getattr(gaussians, name) for name in PARAMETERS}

    @property
    def cameras(self) -> Sequence[Camera]:
        """The training cameras, at the size of HR."""
        return self._splat.poses()

    def render(self, camera: Camera | None = None) -> Float[Tensor, "H W 3"]:
        """The picture from a camera, RGB in [0, 1], on the CPU, by `rasterizer`.

        Args:
            camera: None: the first training camera. `dataclasses.replace` makes others of it.
        """
        return self._splat.painter.color(camera if camera is not None else self.cameras[0])

    @cached_property
    def _splat(self) -> SavedSplat:
        return open_splat(self.folder, self.rasterizer)


def train(photos: str | Path | None = None, *settings: str, folder: str | Path | None = None) -> Run:
    """Train on photos or a capture, as `clear-strategies train` does, and return the finished run.

    Args:
        photos: a folder of photos or of a capture; None: the demo scene.
        settings: as on the command line: "fit.iterations=3000", "+strategy=clear".
        folder: for the run's files; None: outputs/<name>/<time>.

    Raises:
        SettingError, StrategyConflict: a setting cannot be used; those of Hydra itself (hydra.run.dir) cannot.
        DataError: a photo or a file cannot be used.
    """
    exit_codes.require("train")
    console.harden_output()
    console.show()
    require_text(settings)
    words = [readable(word) for word in settings]
    overrides = words if photos is None else train_command.overrides([str(photos), *words])
    if photos is None and not any(word.startswith(train_command.CHOOSE_STRATEGIES) for word in settings):
        overrides.append("+strategy=best")
    for word in overrides:
        key, _, value = word.lstrip("+~").partition("=")
        if key.startswith(("hydra.", "hydra/")):
            rule = "must be left out, since Hydra takes no part in a run from Python"
            refuse(key, rule, value, "folder=… is for its files")
    config = composed(overrides, "config")
    if (lr := config.data.get("save_lr")) is not None:
        rule = "must be null, since a run that writes LR images does not train"
        refuse("data.save_lr", rule, lr, f"clear-strategies train PHOTOS data.save_lr={lr} on the command line")
    name = "demo" if photos is None else path_of(str(photos)).resolve().stem
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S-%f")
    into = path_of(str(folder)) if folder is not None else Path("outputs") / name / now
    threads = torch.get_num_threads()
    try:
        with console.logged(into / "run.log") as claim:
            job.run(config, into, overrides, claim)
    finally:
        torch.set_num_threads(threads)
    theirs = config.rasterizer[TARGET]
    return Run(into, None if theirs == BY_NAME else theirs)
