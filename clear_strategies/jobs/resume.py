"""Resuming stopped runs, and recognizing finished ones."""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec
import torch
from torch import Tensor

from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError, counted
from clear_strategies.files import FINISHED, read_bytes
from clear_strategies.outputs import metrics
from clear_strategies.outputs.metrics import Metrics
from clear_strategies.settings import CHANGES_NO_RESULT, TARGET, flat
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import CHECKPOINTS, Checkpoint
from clear_strategies.training.state import PHOTOS, TrainState, fingerprints
from clear_strategies.viewing.cameras import FILE as CAMERAS
from clear_strategies.viewing.cameras import read_cameras
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_TRAIN_AGAIN: Final = "remove the file: the run is then trained again"
AUTO: Final = "auto"  # the value of fit.resume that is not a path

# Settings that may differ between a run and the one that it resumes. Another device changes bits, which is logged.
_NOT_COMPARED: Final = CHANGES_NO_RESULT | {"fit.device"}
# Paths of photos and SR images, which may be moved: cameras and fingerprints of the images are compared instead.
_PLACE: Final = re.compile(r"data\.(path|root|reader\.(root|cache)|views\.lr_folder)|prior\.(.*\.)?path")
# A file, such as initial points or a network, has its digest beside the key of its path.
_FILE: Final = ".path"
_DIGEST: Final = " digest"
_ROUNDED: Final = 1e-6  # relative error of a position in float32
_SAME: Final = 1e-3  # relative to a camera's focal length, and to the distances between the cameras
_SAME_COLOUR: Final = 5e-4  # more than rounding and decoding differ between machines


def comparable(values: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration, flat and JSON-ready, without the settings that a resumed run may change."""
    compared = {key: value for key, value in flat(values).items() if key not in _NOT_COMPARED}
    files = {key: Path(str(value)) for key, value in compared.items() if key.endswith(_FILE) and value}
    compared |= {
        key + _DIGEST: hashlib.sha256(read_bytes(path)).hexdigest()
        for key, path in files.items()
        if key != "data.path" and path.is_file()
    }
    return dict(msgspec.json.decode(msgspec.json.encode(compared)))  # as it comes back from a file


def begun(folder: Path) -> str | None:
    """Return "results" or "checkpoints" if an earlier run left some in this folder, else None."""
    if (folder / FINISHED).exists():
        return "results"
    return "checkpoints" if newest(folder) is not None else None


def finished(folder: Path, config: Mapping[str, Any], scene: Callable[[], Scene]) -> Metrics | None:
    """The results of the finished run in this folder; None if there is none.

    Args:
        scene: loads the scene of `config`; called if its path has changed, or a file there is newer than the results.
    """
    path = folder / FINISHED
    if not path.exists():
        return None
    content = metrics.read(path, _TRAIN_AGAIN)
    require_same(folder, content.config, config)
    places = {key: config[key] for key in filter(_PLACE.fullmatch, config) if config[key]}
    moved = any(content.config.get(key) != place for key, place in places.items())
    read = [Path(place) for key, place in places.items() if key.endswith(_FILE)]
    if moved or any(file.lstat().st_mtime > path.stat().st_mtime for place in read for file in place.rglob("*")):
        _require_same_cameras(folder, there := scene())
        if (last := newest(folder)) is not None:
            _require_same_photos(folder, checkpoint.load(last), fingerprints(there))
    psnr, date = content.psnr, content.provenance.get("date", "an unknown date")
    score = "no PSNR" if psnr is None or math.isnan(psnr) else f"PSNR {psnr:.2f} dB"
    _log.info("%s: this run finished on %s (%s); nothing is trained or written.", folder, date, score)
    return content


def found(source: str | None, folder: Path, config: Mapping[str, Any]) -> tuple[Checkpoint, Path] | None:
    """The checkpoint that `fit.resume` names and its path; None if the run starts from the beginning.

    Args:
        source: a run's folder or one of its checkpoints; "auto": the newest undamaged checkpoint in `folder`, if there is one.
        config: of this run, see `comparable`. A DataError if the checkpoint has another.
    """
    if source is None:
        return None
    checkpoints = [Path(source)] if source != AUTO else checkpoint.saved(folder / CHECKPOINTS)
    for path in reversed(checkpoints):
        try:
            saved = checkpoint.load(path)
        except DataError as error:
            if source != AUTO:
                raise
            _log.warning("%s; trying an earlier one.", error)
            continue
        require_same(path, saved.config, config)
        return saved, path
    if checkpoints:
        _log.warning("%s: no checkpoint is whole; the run starts from the beginning.", folder / CHECKPOINTS)
    return None


def folder_of(source: Path) -> Path:
    """The run's folder, from that folder itself, its folder of checkpoints, or a checkpoint."""
    return next((path.parent for path in (source, source.parent) if path.name == CHECKPOINTS), source)


def newest(folder: Path) -> Path | None:
    """The newest checkpoint of the run in this folder."""
    return next(reversed(checkpoint.saved(folder / CHECKPOINTS)), None)


def restore(state: TrainState, scene: Scene, saved: Checkpoint, source: Path) -> None:
    """Continue from a checkpoint of the same configuration, see `found`, on the same photos and poses."""
    _require_same_cameras(source, scene)
    _require_same_photos(source, saved, state.photos)
    state.restore(saved, source)
    _log.info("resumed from %s, after %s.", source, counted(saved.t - 1, "iteration"))
    if saved.device != state.device.type:
        _log.warning(
            "this run trained on %s until now and continues on %s: its bits differ from those of an uninterrupted run.",
            saved.device, state.device.type,
        )  # fmt: skip


def require_same(source: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise a DataError if two configurations, see `comparable`, differ in more than the places of their data."""
    keys = then.keys() | now.keys()
    moved = {key for key in keys if key + _DIGEST in then and key + _DIGEST in now}  # their content is compared
    moved |= {*filter(_PLACE.fullmatch, keys)} if (folder_of(source) / CAMERAS).is_file() else set()
    moved |= {key for key in then.keys() ^ now.keys() if key.endswith(_DIGEST)}
    differ = [key for key in sorted(keys - moved) if then.get(key) != now.get(key)]
    # Of another class, all fields differ.
    others = tuple(key.removesuffix(TARGET) for key in differ if key.endswith(f".{TARGET}"))
    differ = [key for key in differ if key.endswith(TARGET) or not key.startswith(others)]
    if differ:
        listed = "; ".join(f"{key}: {then.get(key)!r} then, {now.get(key)!r} now" for key in differ[:5])
        problem = f"this is not the configuration that wrote it: {listed}"
        raise DataError(source, "config", problem, "resume with the same overrides, or start a new run")


def _require_same_cameras(source: Path, scene: Scene) -> None:
    """Raise a DataError if the scene's photos, sizes or poses differ from those that the run of `source` has saved, if it has."""
    file = folder_of(source) / CAMERAS
    if not file.is_file():
        return
    then = {saved.name: saved.camera for saved in read_cameras(file)}
    now = {view.name: view.hr.camera for view in (*scene.train, *scene.test)}
    centers = torch.stack([camera.center.double() for camera in then.values()])
    near = _SAME * float((centers - centers.mean(0)).norm(dim=1).max()) + _ROUNDED * float(centers.norm(dim=1).max())

    def same(a: Camera, b: Camera) -> bool:
        turned = float((a.world_to_camera.double()[:3, :3] - b.world_to_camera.double()[:3, :3]).abs().max())
        moved = float((a.center.double() - b.center.double()).norm())
        sizes = (a.width, a.height) == (b.width, b.height)
        return sizes and abs(a.fx / b.fx - 1) <= _SAME and turned <= _SAME and moved <= near

    both = then.keys() & now.keys()
    if changed := sorted((then.keys() ^ now.keys()) | {name for name in both if not same(then[name], now[name])}):
        problem = f"{len(changed)} of {len(now)} photos have another name, size or pose than in this run, such as {changed[0]}"
        raise DataError(source, "data", problem, "give the same data, at whatever path, or start a new run")


def _require_same_photos(source: Path, saved: Checkpoint, photos: Mapping[str, Tensor]) -> None:
    """Raise a DataError if photos, masks or SR images have changed."""

    def same(name: str, now: Tensor) -> bool:
        then = saved.tensors.get(f"{PHOTOS}/{name}")
        return then is not None and then.shape == now.shape and torch.allclose(then, now, rtol=0, atol=_SAME_COLOUR)

    if changed := [name for name, now in photos.items() if not same(name, now)]:
        problem = f"{len(changed)} of {len(photos)} have another content, mask or SR image than in this run, such as {changed[0]}"
        raise DataError(source, "photos", problem, "give the photos and SR images of this run, or start a new run")
