"""The cameras of a run as a file, and camera paths as other programs write them.

A run writes `cameras.json` in the layout of Inria's 3DGS, which SuperSplat and SIBR open: a list of {"id", "img_name",
"width", "height", "position", "rotation" (camera to world, OpenCV axes), "fx", "fy"}. Ours adds "cx", "cy", "scale" (HR pixels
per LR pixel), "split" ("train", "test"), "background" (RGB) and "photo", a small picture beside the file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.data import strict_json
from clear_strategies.data.lenses import pose_from_opengl, rigid_inverse
from clear_strategies.data.photo_files import jpeg
from clear_strategies.data.scene import Scene
from clear_strategies.data.strict_json import Number, typed
from clear_strategies.data.transforms import Transform, transforms_of
from clear_strategies.data.view_names import file_stem
from clear_strategies.data.view_settings import resized
from clear_strategies.errors import DataError
from rasterizers.interface import Camera, Color

FILE: Final = "cameras.json"
PHOTOS: Final = "cameras"
"""The folder of the small pictures, beside the file."""
_PHOTO_WIDTH: Final = 320  # px, at most; photos are reduced by a whole number

Split = Literal["train", "test"]


@dataclass(frozen=True, slots=True, eq=False)
class SavedCamera:
    """A camera of a run.

    Args:
        camera: at HR. scale: HR pixels per LR pixel.
        photo: a small picture of its LR photo, if there is one.
        background: behind the Gaussians, RGB in [0, 1].
    """

    name: str
    camera: Camera
    split: Split = "train"
    scale: int = 1
    photo: Path | None = None
    background: Color = (0.0, 0.0, 0.0)


def write_cameras(folder: Path, scene: Scene) -> None:
    """Write `cameras.json`, and the small pictures of the training views."""
    entries: list[dict[str, Any]] = []
    for number, view in enumerate((*scene.train, *scene.test)):
        camera = view.hr.camera
        entry: dict[str, Any] = {
            "id": number, "img_name": view.name, "width": camera.width, "height": camera.height,
            "position": camera.center.tolist(), "rotation": camera.world_to_camera.double()[:3, :3].T.tolist(),
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, "scale": view.factor,
            "split": "train" if number < len(scene.train) else "test", "background": list(scene.background),
        }  # fmt: skip
        if entry["split"] == "train":
            entry["photo"] = f"{PHOTOS}/{file_stem(view.name)}.jpg"
            photo = view.lr.image.cpu()
            small = images.area_mean(photo, math.ceil(photo.shape[1] / _PHOTO_WIDTH))
            files.write_bytes(folder / entry["photo"], jpeg(small, quality=80))
        entries.append(entry)
    files.write_json(folder / FILE, entries)


def read_cameras(path: Path) -> list[SavedCamera]:
    """The cameras of a run of ours or of Inria's 3DGS; a DataError if it is no such file."""
    remedy = "give the cameras.json of a run"
    entries = typed(path, strict_json.read(path), list[_Entry], remedy=remedy)
    if not entries:
        raise DataError(path, "json", "is an empty list", remedy)
    return [_saved_camera(path, i, entry) for i, entry in enumerate(entries)]


def read_path(path: Path, size: tuple[int, int]) -> tuple[list[Camera], float | None]:
    """A camera path: cameras.json, a transforms.json, or the camera_path.json that the viewers of nerfstudio and nerfview save.

    Args:
        size: (width, height) of cameras that have none in the file.

    Returns:
        The cameras, and the file's frames per second if it has them.

    Raises:
        DataError: it is no such file.
    """
    content = strict_json.read(path)
    if isinstance(content, list):
        return [saved.camera for saved in read_cameras(path)], None
    if not isinstance(content, dict) or not ("camera_path" in content or "frames" in content):
        raise DataError(
            path, "json", "is no camera path",
            'give a cameras.json, a transforms.json ("frames"), or a path of a viewer ("camera_path")',
        )  # fmt: skip
    if "frames" in content:
        return [_of_transforms(path, i, frame, size) for i, frame in enumerate(transforms_of(path, content))], None
    saved = typed(path, content, _ViewerPath, remedy="save the path again")
    size = round(saved.render_width or size[0]), round(saved.render_height or size[1])
    return [_of_viewer(path, i, key, size) for i, key in enumerate(saved.camera_path)], saved.fps


def at_most(camera: Camera, longest: int | None) -> Camera:
    """The camera with even numbers of pixels, as videos need them, and the longer edge of at most `longest` pixels."""
    edge = max(camera.width, camera.height)
    times = 1.0 if longest is None else min(1.0, longest / edge)
    return resized(camera, *(max(2, 2 * round(times * size / 2)) for size in (camera.width, camera.height)))


def framed(camera: Camera, width: int, height: int) -> Camera:
    """The camera with all of its picture, unstretched, in the middle of a frame of this size, which may show more beside it."""
    times = min(width / camera.width, height / camera.height)
    cx, cy = (
        frame / 2 + times * (principal - size / 2)
        for frame, principal, size in ((width, camera.cx, camera.width), (height, camera.cy, camera.height))
    )
    return replace(camera, fx=times * camera.fx, fy=times * camera.fy, cx=cx, cy=cy, width=width, height=height)


class _Entry(msgspec.Struct):
    width: Number
    height: Number
    fx: Number
    fy: Number
    rotation: list[Any]
    position: tuple[Number, Number, Number]
    cx: Number | None = None
    cy: Number | None = None
    img_name: str | None = None
    split: str = "train"
    scale: Number = 1
    photo: str | None = None
    background: Color = (0.0, 0.0, 0.0)


class _Key(msgspec.Struct):
    """Of a viewer's path."""

    camera_to_world: list[Any]  # 4 x 4; nerfstudio writes 16 numbers, row by row
    fov: Annotated[float, Meta(gt=0, lt=180)]  # vertical, degrees


class _ViewerPath(msgspec.Struct):
    camera_path: Annotated[list[_Key], Meta(min_length=1)]
    render_width: Number | None = None
    render_height: Number | None = None
    fps: Number | None = None


def _saved_camera(path: Path, i: int, entry: _Entry) -> SavedCamera:
    try:
        rotation = np.array(entry.rotation, float).reshape(3, 3)
    except (TypeError, ValueError) as error:
        raise DataError(path, f"[{i}].rotation", f"must be a 3x3 matrix ({error})", "write the file again") from error
    width, height = round(entry.width), round(entry.height)
    pose = rigid_inverse(path, f"[{i}].rotation", rotation, np.array(entry.position))
    cx = width / 2 if entry.cx is None else entry.cx
    cy = height / 2 if entry.cy is None else entry.cy
    photo = None if entry.photo is None else path.parent / entry.photo
    return SavedCamera(
        name=str(i) if entry.img_name is None else entry.img_name,
        camera=_camera(path, f"[{i}]", pose, entry.fx, entry.fy, cx, cy, width, height),
        split="test" if entry.split == "test" else "train",
        scale=max(1, round(entry.scale)),
        photo=photo if photo is not None and photo.is_file() else None,
        background=entry.background,
    )


def _of_transforms(path: Path, i: int, frame: Transform, size: tuple[int, int]) -> Camera:
    """A frame of transforms.json; without distortion, because it is drawn and not read."""
    where = f"frames[{i}]"
    pose = pose_from_opengl(path, f"{where}.transform_matrix", frame.transform_matrix)
    width, height = size[0] if frame.w is None else frame.w, size[1] if frame.h is None else frame.h
    return _camera(path, where, pose, *frame.pinhole(path, where, width, height), round(width), round(height))


def _of_viewer(path: Path, i: int, key: _Key, size: tuple[int, int]) -> Camera:
    where, matrix = f"camera_path[{i}]", key.camera_to_world
    if len(matrix) == 16:
        matrix = [matrix[row : row + 4] for row in range(0, 16, 4)]
    pose = pose_from_opengl(path, f"{where}.camera_to_world", matrix)
    width, height = size
    focal = height / 2 / math.tan(math.radians(key.fov) / 2)
    return _camera(path, where, pose, focal, focal, width / 2, height / 2, width, height)


def _camera(
    path: Path, where: str, pose: Float[Tensor, "4 4"],
    fx: float, fy: float, cx: float, cy: float, width: int, height: int,
) -> Camera:  # fmt: skip
    try:
        return Camera(pose.to(torch.float64), fx, fy, cx, cy, width, height)
    except ValueError as error:
        raise DataError(path, where, str(error), "correct the camera") from error
