"""A saved splat, opened to be looked at: a run by its newest checkpoint, or a PLY file."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.data.ply import read_gaussians
from clear_strategies.errors import DataError, SettingError
from clear_strategies.jobs import device
from clear_strategies.jobs.device import Drawing
from clear_strategies.jobs.resume import folder_of
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
_DEPTH: Final = 3  # cameras.json lies at most so many folders above a PLY file


@dataclass(frozen=True, slots=True, eq=False)
class SavedSplat:
    """A splat that is ready to be drawn.

    Args:
        folder: of the run, or of the PLY file.
        name: of the folder, or of a PLY file that has one of its own; one word, for files and the title of a window.
        source: what was opened, for messages.
        cameras: of the run; empty where none are known.
        antialiased: it was trained with opacity compensation.
    """

    folder: Path
    name: str
    source: str
    painter: Painter
    cameras: Sequence[SavedCamera]
    antialiased: bool

    def poses(self) -> list[Camera]:
        """The training cameras, or, where none are known, one that sees the whole splat."""
        train = [saved.camera for saved in self.cameras if saved.split == "train"]
        return train or [saved.camera for saved in self.cameras] or [overview(self.painter.field)]


def open_splat(path: Path, rasterizer: str | None = None) -> SavedSplat:
    """Open a run's folder, one of its checkpoints, or a PLY file.

    Args:
        rasterizer: by name; None: the one that the run trained with, or else the fastest here.

    Raises:
        DataError: nothing that can be drawn is there, or it is damaged.
        SettingError: there is no such rasterizer here.
    """
    if path.is_file() and path.suffix != checkpoint.SUFFIX:
        return _of_ply(path, rasterizer)
    folder = folder_of(path)
    if checkpoint.saved(folder / CHECKPOINTS):
        return _of_checkpoint(path, folder, rasterizer)
    files = [folder / PLY, *sorted(folder.glob(f"point_cloud/iteration_*/{PLY}"), key=lambda p: len(p.parent.name))]
    if (ply := next((p for p in reversed(files) if p.is_file()), None)) is not None:
        return _of_ply(ply, rasterizer)
    raise DataError(path, "run", "has neither a checkpoint nor a point_cloud.ply", "give a run's folder or a PLY file")


def overview(field: GaussianField) -> Camera:
    """A camera, upright by OpenCV's axes, that sees most of the opacity."""
    means, weights = field.means.data.cpu().double(), field.opacities.data.sigmoid().cpu().double()
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


def _of_checkpoint(path: Path, folder: Path, rasterizer: str | None) -> SavedSplat:
    saved = checkpoint.load(path)
    parameters = {name.removeprefix("field/"): v for name, v in saved.tensors.items() if name.startswith("field/")}
    try:
        field = GaussianField(parameters, degree=int(saved.facts["degree"]))
        field.filter_3d = parameters["filter_3d"].clone()
    except (KeyError, ValueError, TypeError) as error:
        raise DataError(path, "tensors", f"hold no field ({error})", "give a run of this program") from error
    cameras = _cameras_near(folder, 0)
    settings = {
        key.removeprefix("rasterizer."): value
        for key, value in saved.config.items()
        if key.startswith("rasterizer.") and value is not None  # the default, also of a field of an earlier version
    }
    source = f"{folder}, {saved.t - 1} iterations, {len(field):,} Gaussians"
    painter = _painter(field, _drawing(settings, rasterizer), cameras)
    antialiased = bool(settings.get("antialiased", True))
    return SavedSplat(folder, _name(folder), source, painter, cameras, antialiased)


def _of_ply(path: Path, rasterizer: str | None) -> SavedSplat:
    g = read_gaussians(path)
    if not len(g):
        raise DataError(path, "element vertex", "has no Gaussians", "export it again")
    field = GaussianField({name: getattr(g, name) for name in PARAMETERS} | {"detail": torch.zeros_like(g.means)})
    field.degree = field.max_degree
    cameras = _cameras_near(path.parent, _DEPTH)
    drawing = _drawing({} if g.antialiased else {"kernel": 0.3, "antialiased": False}, rasterizer)
    source = f"{path}, {len(field):,} Gaussians"
    name = _name(path.parent) if path.name == PLY else path.stem
    return SavedSplat(path.parent, name, source, _painter(field, drawing, cameras), cameras, g.antialiased)


def _name(folder: Path) -> str:
    return folder.name or "splat"


def _painter(field: GaussianField, drawing: Drawing, cameras: Sequence[SavedCamera]) -> Painter:
    """Draws the field over the background of the cameras; black where there are none."""
    drawing = drawing.over(cameras[0].background if cameras else (0.0, 0.0, 0.0)).among(field.means.data)
    return Painter(field.to(drawing.device), drawing.make)


def _drawing(settings: Mapping[str, Any], name: str | None) -> Drawing:
    """The rasterizer with the settings of a run, or of the name that was asked for."""
    defaults = with_defaults({TARGET: device.BY_NAME})
    if name is not None:
        shared = {key: settings[key] for key in ("kernel", "antialiased", "background") if key in settings}
        return device.drawing(build({**defaults, **shared, "name": name}, "rasterizer"), None)
    try:
        return device.drawing(build(device.rasterizer_node({**defaults, **settings}), "rasterizer"), None)
    except SettingError as error:
        _log.warning("%s The fastest rasterizer of this machine draws instead.", error)
        return device.drawing(build(defaults, "rasterizer"), None)


def _cameras_near(folder: Path, above: int) -> list[SavedCamera]:
    """The cameras.json of a folder, or of one of the folders above it."""
    for candidate in (folder, *list(folder.resolve().parents)[:above]):
        if (candidate / CAMERAS).is_file():
            return read_cameras(candidate / CAMERAS)
    return []
