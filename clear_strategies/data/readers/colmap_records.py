"""The records of COLMAP's sparse models, and the rules that hold for them in binary and in text."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies.data.cameras import FARTHEST, Lens
from clear_strategies.errors import DataError

# name -> COLMAP's number for the model, and how many parameters it has.
MODELS: Final = {
    "SIMPLE_PINHOLE": (0, 3), "PINHOLE": (1, 4), "SIMPLE_RADIAL": (2, 4), "RADIAL": (3, 5), "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8), "FULL_OPENCV": (6, 12), "SIMPLE_RADIAL_FISHEYE": (8, 4), "RADIAL_FISHEYE": (9, 5),
}  # fmt: skip
MODEL_OF_ID: Final = {number: name for name, (number, _) in MODELS.items()}


def damaged(path: Path, where: str, problem: str) -> DataError:
    """What to raise where a file is not as COLMAP writes it."""
    return DataError(path, where, problem, "export the model again")


@dataclass(frozen=True, slots=True)
class Image:
    """A registered image: COLMAP's id, world-to-camera as (w, x, y, z) and translation, its camera and file name."""

    id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Positions, 8-bit colours, and the tracks: point `track[j, 0]` is observed in image `track[j, 1]`."""

    means: np.ndarray
    colors: np.ndarray
    track: np.ndarray


def checked_points(
    path: Path,
    ids: Set[int],
    means: Sequence[Sequence[float]],
    colors: Sequence[Sequence[int]],
    track: Sequence[np.ndarray],
) -> Points:
    """`track`: of each point, the ids of the images that observe it."""
    if len(ids) != len(means):
        raise damaged(path, "point id", "occurs twice")
    if not means:
        return Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 2), np.int64))
    where = np.array(means)
    near = np.abs(where) < FARTHEST
    if not near.all():
        bad = int(np.argwhere(~near)[0, 0])
        raise DataError(path, f"point {bad}", "is not finite", "remove the point")
    point = np.repeat(np.arange(len(means)), [len(images) for images in track])
    observed = np.stack((point, np.concatenate(track).astype(np.int64)), axis=1)
    return Points(where, np.array(colors, np.uint8), observed)


def parameters_of(path: Path, model: str) -> int:
    if model not in MODELS:
        raise DataError(
            path, "camera model", f"{model[:40]} is not supported", "undistort with `colmap image_undistorter` first"
        )
    return MODELS[model][1]


def lens_of(path: Path, where: str, model: str, width: int, height: int, p: tuple[float, ...]) -> Lens:
    fisheye = model.endswith("_FISHEYE")
    if model not in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"):
        f, cx, cy, *radial = p  # one focal length, and k1, k2 if the model has them; the other terms are 0
        distortion = (*radial, *[0.0] * (4 - len(radial))) if radial else ()
        return Lens(width, height, f, f, cx, cy, distortion, fisheye).check(path, where)
    fx, fy, cx, cy, *rest = p
    return Lens(width, height, fx, fy, cx, cy, tuple(rest), fisheye).check(path, where)


def image_of(path: Path, number: int, pose: tuple[float, ...], camera: int, name: str) -> Image:
    if not all(abs(x) < FARTHEST for x in pose):
        raise damaged(path, name or f"image {number}", "has a pose that is not finite")
    norm = math.hypot(*pose[:4])
    if not 0.5 < norm < 2:
        raise damaged(path, name or f"image {number}", f"has a rotation quaternion of length {norm:.3g}")
    return Image(number, pose[:4], pose[4:], camera, name)


def put(path: Path, table: dict[int, Any], number: int, value: Any) -> None:
    if number in table:
        raise damaged(path, f"id {number}", "occurs twice")
    table[number] = value
