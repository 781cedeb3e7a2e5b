"""Opening a saved splat to render it: a run by its newest checkpoint, or a PLY file."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.ply import read_gaussians
from clear_strategies.data.view_names import file_stems
from clear_strategies.errors import DataError, SettingError, counted
from clear_strategies.files import FINISHED
from clear_strategies.jobs import device
from clear_strategies.jobs.device import ReadyRasterizer
from clear_strategies.jobs.resume import folder_of
from clear_strategies.options import options
from clear_strategies.outputs import metrics
from clear_strategies.settings import TARGET, build, with_defaults
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import CHECKPOINTS
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.cameras import FILE as CAMERAS
from clear_strategies.viewing.cameras import SavedCamera, read_cameras
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

PLY: Final = "point_cloud.ply"
_FAR: Final = 2.5  # radii of the scene, distance of the camera for a PLY file without cameras
_SIZE: Final = (1280, 720)  # px, of that camera
_OF_RASTERIZER: Final = "rasterizer."
_SHARED: Final = ("kernel", "antialiased", "background")  # settings that mean the same for every rasterizer
_ABOVE: Final = 3  # folders above that of a PLY file in which cameras.json may lie


@dataclass(frozen=True, slots=True, eq=False)
class SavedSplat:
    """A splat that is ready to be drawn.

    Args:
        folder: of the run, or of the PLY file.
        name: of the folder, or of a PLY file that is not named point_cloud; for files and the title of a window.
        source: a description of what was opened, for messages.
        cameras: of the run; empty if none are known.
        antialiased: the splat was trained with opacity compensation.
    """

    folder: Path
    name: str
    source: str
    painter: Painter
    cameras: Sequence[SavedCamera]
    antialiased: bool

    def photo(self, name: str) -> UInt8[np.ndarray, "h w 3"] | None:
        """The LR photo of a camera, if the run has saved it, else None."""
        stem = file_stems(saved.name for saved in self.cameras)[name]
        path = self.folder / "views" / f"{stem}_lr.png"
        try:
            return to_bytes(read_image(path)) if path.is_file() else None
        except DataError as error:
            _log.warning("%s", error)
            return None

    def poses(self) -> list[Camera]:
        """The training cameras, else all cameras, else one that sees the whole splat."""
        if self.cameras:
            train = [saved.camera for saved in self.cameras if saved.split == "train"]
            return train or [saved.camera for saved in self.cameras]
        field = self.painter.field
        return [overview(field.means.data, field.opacities.data.sigmoid())]


def open_splat(path: Path, rasterizer: str | None = None) -> SavedSplat:
    """Open a run's folder, one of its checkpoints, or a PLY file.

    Args:
        rasterizer: by name, or by the dotted name of another package's class; None: that of the run, if it is known here (see
            `_load_rasterizer`), else the fastest.
    """
    folder, above = folder_of(path), 0
    is_ply = path.is_file() and path.suffix != checkpoint.SUFFIX
    if not is_ply and checkpoint.saved(folder / CHECKPOINTS):
        saved = checkpoint.load(path)
        field, source, name = _field_of(saved, path), f"{folder}, {counted(saved.t - 1, 'iteration')}", folder.name
        settings = _of_rasterizer(saved.config)
    else:
        ply = path if is_ply else _ply_in(folder, path)
        gaussians = read_gaussians(ply, allow_empty=False)
        raw = {name: getattr(gaussians, name) for name in PARAMETERS}
        field = GaussianField(raw | {"detail": torch.zeros_like(gaussians.means)})
        field.degree = field.max_degree
        field.constrain()  # else scales of e⁵⁰ overflow
        settings = _of_finished_run(ply.parent)
        if settings.get("antialiased", True) != gaussians.antialiased:  # of another program
            settings = {} if gaussians.antialiased else {"kernel": 0.3, "antialiased": False}
        folder, above, source = ply.parent, _ABOVE, str(ply)
        name = folder.name if ply.name == PLY else ply.stem
    cameras = _cameras_near(folder, above)
    background = cameras[0].background if cameras else (0.0, 0.0, 0.0)
    ready = _load_rasterizer(settings, rasterizer).of_scene(background, field.means.data)
    painter = Painter(field.to(ready.device), ready.make)
    source += f", {counted(len(field), 'Gaussian')}"
    return SavedSplat(folder, name or "splat", source, painter, cameras, bool(settings.get("antialiased", True)))


def overview(means: Float[Tensor, "N 3"], opacities: Float[Tensor, " N"]) -> Camera:
    """A camera, upright by OpenCV's axes, that sees most of the opacity."""
    means, weights = means.cpu().double(), opacities.cpu().double()
    order = means.argsort(dim=0)
    total = weights[order].cumsum(0) / weights.sum()
    low, middle, high = (
        torch.stack([means[order[int(torch.searchsorted(total[:, k].contiguous(), q)), k], k] for k in range(3)])
        for q in (0.1, 0.5, 0.9)
    )
    radius = float((high - low).norm()) / 2 or 1e-3
    pose = np.eye(4)
    pose[:3, 3] = -(middle.numpy() - [0, 0, _FAR * radius])
    width, height = _SIZE
    return Camera(torch.from_numpy(pose), float(height), float(height), width / 2, height / 2, width, height)


def _field_of(saved: checkpoint.Checkpoint, path: Path) -> GaussianField:
    parameters = {name.removeprefix("field/"): v for name, v in saved.tensors.items() if name.startswith("field/")}
    try:
        field = GaussianField(parameters, degree=int(saved.facts["degree"]))
        field.filter_3d = parameters["filter_3d"].clone()
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(path, "tensors", f"hold no field ({error})", "give a run of this program") from error
    return field


def _of_rasterizer(config: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the rasterizer, without those that are None: the default, also of a field of an earlier version."""
    of = {key.removeprefix(_OF_RASTERIZER): v for key, v in config.items() if key.startswith(_OF_RASTERIZER)}
    return {key: value for key, value in of.items() if value is not None}


def _of_finished_run(folder: Path) -> dict[str, Any]:
    """The settings of the rasterizer of the run that finished in this folder; empty if there is none."""
    if not (folder / FINISHED).is_file():
        return {}
    try:
        return _of_rasterizer(metrics.read(folder / FINISHED, "train the run again").config)
    except DataError as error:
        _log.warning("%s. Its PLY file is drawn with default settings.", error)
        return {}


def _ply_in(folder: Path, path: Path) -> Path:
    """Find the PLY file in a run's folder, or in a model's folder of Inria's 3DGS."""
    last = sorted(folder.glob(f"point_cloud/iteration_*/{PLY}"), key=lambda p: len(p.parent.name))
    if (ply := next((p for p in reversed([folder / PLY, *last]) if p.is_file()), None)) is None:
        problem = "has neither a checkpoint nor a point_cloud.ply" if path.exists() else "is not there"
        raise DataError(path, "run", problem, "give a run's folder or a PLY file")
    return ply


def _load_rasterizer(settings: Mapping[str, Any], name: str | None) -> ReadyRasterizer:
    """Make the rasterizer with the settings of a run, or the one that was asked for.

    The class is one of this repository, one that the configuration of an installed package names, or the one that was asked for:
    a file gives arguments, never the class that is called with them.

    Args:
        settings: from a checkpoint, so plain values.
    """
    target, shared = settings.get(TARGET, device.BY_NAME), {key: settings[key] for key in _SHARED if key in settings}
    own = {key: value for key, value in settings.items() if not key.startswith("_")}
    if name is not None:
        named = {TARGET: name} if "." in name else {TARGET: device.BY_NAME, "name": name}
        return _rasterizer_of({**(own if named[TARGET] == target != device.BY_NAME else shared), **named})
    try:
        if target != device.BY_NAME and target not in [node.get(TARGET) for node in options("rasterizer").values()]:
            rule = f"{target} is a class that only the file names, and a file never says what is imported"
            raise SettingError(
                f"{_OF_RASTERIZER}{TARGET}: {rule}. If you trust it, --rasterizer {target} draws with it."
            )
        return _rasterizer_of({**own, TARGET: target})
    except SettingError as error:
        _log.warning("%s The fastest rasterizer of this machine draws instead.", error)
        return _rasterizer_of({**shared, TARGET: device.BY_NAME})


def _rasterizer_of(node: Mapping[str, Any]) -> ReadyRasterizer:
    return device.load_rasterizer(build(device.rasterizer_node(with_defaults(node)), "rasterizer"), None)


def _cameras_near(folder: Path, above: int) -> list[SavedCamera]:
    """Read the cameras.json of a folder, else of the nearest of `above` folders above it."""
    for candidate in (folder, *list(folder.resolve().parents)[:above]):
        if (candidate / CAMERAS).is_file():
            return read_cameras(candidate / CAMERAS)
    return []
