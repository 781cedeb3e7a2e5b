"""COLMAP's sparse models, read strictly: every number must be finite and every id known."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from clear_strategies.data.cameras import FARTHEST, Lens
from clear_strategies.data.readers import colmap_files
from clear_strategies.data.readers.colmap_files import Camera, Image, damaged
from clear_strategies.errors import DataError
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Positions, 8-bit colours, and the tracks: point `track[j, 0]` is observed in image `track[j, 1]`."""

    means: Float[np.ndarray, "N 3"]
    colors: UInt8[np.ndarray, "N 3"]
    track: Int[np.ndarray, "M 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The content of a sparse model's files, whose `ending` is .bin or .txt."""

    folder: Path
    ending: str
    lenses: dict[int, Lens]
    images: list[Image]
    points: Points


def find_model(root: Path) -> Path:
    """The folder of the sparse model; of the several that COLMAP's mapper may leave in `sparse`, the one with most photos.

    Raises:
        DataError: there is none, or one of several cannot be read.
    """
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    for candidate in model_folders(root):
        if is_model(candidate):
            numbered = sorted(candidate.parent.glob("[1-9]*")) if candidate.name == "0" else []
            return _largest(root, [candidate, *filter(is_model, numbered)])
    raise DataError(
        root, "sparse model", "no cameras.bin or cameras.txt in sparse/0, sparse, colmap/sparse/0 or here",
        "run COLMAP first, or use data=photos for photos without poses",
    )  # fmt: skip


def model_folders(root: Path) -> tuple[Path, ...]:
    """Where a scene's model may lie."""
    return (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0", root)


def is_model(folder: Path) -> bool:
    return any((folder / f"{name}{ending}").is_file() for name in ("cameras", "images") for ending in (".bin", ".txt"))


def _largest(root: Path, models: Sequence[Path]) -> Path:
    if len(models) == 1:
        return models[0]
    photos = {model: len(read_images(model / f"images{_ending(model)}")) for model in models}
    largest = max(models, key=lambda model: photos[model])
    others = ", ".join(f"{model.name} with {photos[model]}" for model in models if model != largest)
    _log.warning(
        "%s: COLMAP left %d models. The largest, %s with %d photos, is used; the others are not: %s.",
        root, len(models), largest.name, photos[largest], others,
    )  # fmt: skip
    return largest


def _ending(folder: Path) -> str:
    """The ending of a model's files. If there is any binary file, text files are ignored."""
    return ".bin" if any((folder / f"{name}.bin").exists() for name in ("cameras", "images", "points3D")) else ".txt"


def read_model(folder: Path) -> Model:
    """Cameras, images and points of a model folder.

    Raises:
        DataError: a file is missing or not what it should be.
    """
    ending = _ending(folder)
    cameras, listing, points3d = (folder / f"{name}{ending}" for name in ("cameras", "images", "points3D"))
    lenses, images = read_cameras(cameras), read_images(listing)
    if not images:
        raise DataError(listing, "images", "there is none", "run COLMAP's mapper to its end")
    for image in images:
        if image.camera not in lenses:
            raise damaged(listing, image.name, f"has the unknown camera {image.camera}")
    points = read_points(points3d)
    unknown = np.setdiff1d(points.track[:, 1], [image.id for image in images])
    if len(unknown):
        raise damaged(points3d, "track", f"names the unknown image {unknown[0]}")
    return Model(folder, ending, lenses, images, points)


def read_cameras(path: Path) -> dict[int, Lens]:
    """The lens of each camera, by its id."""
    lenses: dict[int, Lens] = {}
    for camera in colmap_files.cameras(path):
        lens = _lens(camera).check(path, camera.where)
        _require_new(path, camera.id, lenses)
        lenses[camera.id] = lens
    return lenses


def read_images(path: Path) -> list[Image]:
    images: dict[int, Image] = {}
    for image in colmap_files.images(path):
        where = image.name or f"image {image.id}"
        if not all(abs(x) < FARTHEST for x in (*image.quat, *image.translation)):
            raise damaged(path, where, "has a pose that is not finite")
        norm = math.hypot(*image.quat)
        if not 0.5 < norm < 2:
            raise damaged(path, where, f"has a rotation quaternion of length {norm:.3g}")
        _require_new(path, image.id, images)
        images[image.id] = image
    return list(images.values())


def read_points(path: Path) -> Points:
    """The points with their tracks; none where there is no file."""
    if not path.exists():
        _log.debug("%s has no %s: the capture has no points.", path.parent, path.name)
        records = []
    else:
        records = list(colmap_files.points(path))
    if not records:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 2), np.int64))
    ids, positions, colors, tracks = zip(*records, strict=True)
    if len(set(ids)) != len(ids):
        raise damaged(path, "point id", "occurs twice")
    means = np.array(positions)
    near = np.abs(means) < FARTHEST
    if not near.all():
        raise DataError(path, f"point {np.argwhere(~near)[0, 0]}", "is not finite", "remove the point")
    point = np.repeat(np.arange(len(means)), [len(images) for images in tracks])
    track = np.stack((point, np.concatenate(tracks).astype(np.int64)), axis=1)
    return Points(means, np.array(colors, np.uint8), track)


def pose_of(image: Image) -> Float[Tensor, "4 4"]:
    """World-to-camera."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrix(torch.tensor([image.quat], dtype=torch.float64))[0]
    pose[:3, 3] = torch.tensor(image.translation, dtype=torch.float64)
    return pose


def _lens(camera: Camera) -> Lens:
    fisheye = camera.model.endswith("_FISHEYE")
    if camera.model in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        fx, fy, cx, cy, *distortion = camera.parameters
    else:
        fx, cx, cy, *distortion = camera.parameters  # one focal length, and k1, k2 if the model has them
        fy = fx
    return Lens(camera.width, camera.height, fx, fy, cx, cy, tuple(distortion), fisheye)


def _require_new(path: Path, number: int, known: dict[int, Lens] | dict[int, Image]) -> None:
    if number in known:
        raise damaged(path, f"id {number}", "occurs twice")
