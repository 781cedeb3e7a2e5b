"""The cameras of a run as a file.

A run writes `cameras.json` in the layout of Inria's 3DGS, which SuperSplat and SIBR open: a list of {"id", "img_name",
"width", "height", "position", "rotation" (camera to world, OpenCV axes), "fx", "fy"}. Ours adds "cx", "cy", "split" ("train",
"test") and "background" (RGB).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import msgspec
import numpy as np
import torch

from clear_strategies import files
from clear_strategies.data import strict_json
from clear_strategies.data.lenses import rigid_inverse
from clear_strategies.data.scene import Scene
from clear_strategies.data.strict_json import Number, typed
from clear_strategies.data.view_settings import resized
from clear_strategies.errors import DataError
from rasterizers.interface import Camera, Color

FILE: Final = "cameras.json"

Split = Literal["train", "test"]


@dataclass(frozen=True, slots=True, eq=False)
class SavedCamera:
    """A camera of a run.

    Args:
        camera: at HR.
        background: behind the Gaussians, RGB in [0, 1].
    """

    name: str
    camera: Camera
    split: Split = "train"
    background: Color = (0.0, 0.0, 0.0)


def write_cameras(folder: Path, scene: Scene) -> None:
    """Write `cameras.json`."""
    entries = []
    for number, view in enumerate((*scene.train, *scene.test)):
        camera = view.hr.camera
        entry = {
            "id": number, "img_name": view.name, "width": camera.width, "height": camera.height,
            "position": camera.center.tolist(), "rotation": camera.world_to_camera.double()[:3, :3].T.tolist(),
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "split": "train" if number < len(scene.train) else "test", "background": list(scene.background),
        }  # fmt: skip
        entries.append(entry)
    files.write_json(folder / FILE, entries)


def read_cameras(path: Path) -> list[SavedCamera]:
    """The cameras of a run of ours or of Inria's 3DGS; a DataError if it is no such file."""
    remedy = "give the cameras.json of a run"
    entries = typed(path, strict_json.read(path), list[_Entry], remedy=remedy)
    if not entries:
        raise DataError(path, "json", "is an empty list", remedy)
    return [_saved_camera(path, i, entry) for i, entry in enumerate(entries)]


def at_most(camera: Camera, longest: int | None) -> Camera:
    """The camera with even numbers of pixels, as videos need them, and the longer edge of at most `longest` pixels."""
    edge = max(camera.width, camera.height)
    times = 1.0 if longest is None else min(1.0, longest / edge)
    return resized(camera, *(max(2, 2 * round(times * size / 2)) for size in (camera.width, camera.height)))


_Vector = tuple[Number, Number, Number]


class _Entry(msgspec.Struct):
    width: Number
    height: Number
    fx: Number
    fy: Number
    rotation: tuple[_Vector, _Vector, _Vector]
    position: _Vector
    cx: Number | None = None
    cy: Number | None = None
    img_name: str | None = None
    split: str = "train"
    background: Color = (0.0, 0.0, 0.0)


def _saved_camera(path: Path, i: int, entry: _Entry) -> SavedCamera:
    width, height = round(entry.width), round(entry.height)
    pose = rigid_inverse(path, f"[{i}].rotation", np.array(entry.rotation), np.array(entry.position))
    cx = width / 2 if entry.cx is None else entry.cx
    cy = height / 2 if entry.cy is None else entry.cy
    try:
        camera = Camera(pose.to(torch.float64), entry.fx, entry.fy, cx, cy, width, height)
    except ValueError as error:
        raise DataError(path, f"[{i}]", str(error), "correct the camera") from error
    return SavedCamera(
        name=str(i) if entry.img_name is None else entry.img_name,
        camera=camera,
        split="test" if entry.split == "test" else "train",
        background=entry.background,
    )
