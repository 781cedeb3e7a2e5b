"""The cameras of a run as a file, and camera paths as other programs write them.

A run writes `cameras.json` in the layout of Inria's 3DGS, which SuperSplat and SIBR open: a list of {"id", "img_name",
"width", "height", "position", "rotation" (camera to world, OpenCV axes), "fx", "fy"}. Ours adds "cx", "cy", "scale" (HR pixels
per LR pixel), "split" ("train", "test"), "background" (RGB) and "photo", a small picture beside the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.view import View
from clear_strategies.data import strict_json
from clear_strategies.data.cameras import pose_from_opengl, rigid_inverse
from clear_strategies.data.photo_files import jpeg
from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError
from rasterizers.interface import Camera

FILE: Final = "cameras.json"
PHOTOS: Final = "cameras"
"""The folder of the small pictures, beside the file."""
_PHOTO_WIDTH: Final = 320  # px

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
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


def write_cameras(folder: Path, scene: Scene) -> None:
    """Write `cameras.json`, and the small pictures of the training views."""
    entries: list[dict[str, Any]] = []
    for split, views in (("train", scene.train), ("test", scene.test)):
        for view in views:
            entry = {**_entry(len(entries), view), "split": split, "background": list(scene.background)}
            if split == "train":
                entry["photo"] = f"{PHOTOS}/{Path(view.name).stem}.jpg"
                files.write_bytes(folder / entry["photo"], jpeg(_small(view.lr.image), quality=80))
            entries.append(entry)
    files.write_json(folder / FILE, entries)


def read_cameras(path: Path) -> list[SavedCamera]:
    """The cameras of a run of ours or of Inria's 3DGS.

    Raises:
        DataError: it is no such file.
    """
    content = _read_json(path)
    if not isinstance(content, list) or not content or not all(isinstance(entry, dict) for entry in content):
        raise DataError(path, "json", "is no list of cameras", "give the cameras.json of a run")
    return [_saved_camera(path, i, entry) for i, entry in enumerate(content)]


def read_path(path: Path, size: tuple[int, int]) -> tuple[list[Camera], float | None]:
    """A camera path: cameras.json, a transforms.json, or the camera_path.json that the viewers of nerfstudio and nerfview save.

    Args:
        size: (width, height) of cameras that name none.

    Returns:
        The cameras, and frames per second where the file names them.

    Raises:
        DataError: it is no such file.
    """
    content = _read_json(path)
    if isinstance(content, list):
        return [saved.camera for saved in read_cameras(path)], None
    if not isinstance(content, dict) or not ("camera_path" in content or "frames" in content):
        raise DataError(
            path, "json", "is no camera path",
            'give a cameras.json, a transforms.json ("frames"), or a path of a viewer ("camera_path")',
        )  # fmt: skip
    if "frames" in content:
        frames = strict_json.frames_of(path, content)
        return [_of_transforms(path, i, {**content, **frame}, size) for i, frame in enumerate(frames)], None
    entries = content["camera_path"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise DataError(path, "camera_path", "is empty or no list of objects", "save the path again")
    width = round(strict_json.number(path, "render_width", content.get("render_width", size[0])))
    height = round(strict_json.number(path, "render_height", content.get("render_height", size[1])))
    fps = None if content.get("fps") is None else strict_json.number(path, "fps", content["fps"])
    return [_of_viewer(path, i, entry, (width, height)) for i, entry in enumerate(entries)], fps


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another number of pixels, as near to the same picture as these allow."""
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def at_most(camera: Camera, longest: int | None) -> Camera:
    """The camera with even numbers of pixels, as videos need them, and the longer edge of at most `longest` pixels."""
    edge = max(camera.width, camera.height)
    times = 1.0 if longest is None else min(1.0, longest / edge)
    return resized(camera, *(max(2, 2 * round(times * size / 2)) for size in (camera.width, camera.height)))


def _entry(number: int, view: View) -> dict[str, Any]:
    camera = view.hr.camera
    pose = camera.world_to_camera.double()
    return {
        "id": number,
        "img_name": view.name,
        "width": camera.width,
        "height": camera.height,
        "position": camera.center.tolist(),
        "rotation": pose[:3, :3].T.tolist(),
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "scale": view.factor,
    }


def _small(image: Float[Tensor, "H W 3"]) -> Float[Tensor, "h w 3"]:
    """The image, reduced by a whole number to at most `_PHOTO_WIDTH` where it is wider."""
    factor = math.ceil(image.shape[1] / _PHOTO_WIDTH)
    return images.area_mean(image.cpu(), factor) if factor > 1 else image.cpu()


def _saved_camera(path: Path, i: int, entry: Mapping[str, Any]) -> SavedCamera:
    where = f"[{i}]"
    numbers = {
        key: strict_json.number(path, f"{where}.{key}", entry.get(key)) for key in ("width", "height", "fx", "fy")
    }
    try:
        rotation = np.array(entry["rotation"], float).reshape(3, 3)
        center = np.array(entry["position"], float).reshape(3)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, f"{where}.rotation, position", f"is no pose ({error})", "write the file again") from error
    width, height = round(numbers["width"]), round(numbers["height"])
    pose = rigid_inverse(path, f"{where}.rotation", rotation, center)
    cx = strict_json.number(path, f"{where}.cx", entry.get("cx", width / 2))
    cy = strict_json.number(path, f"{where}.cy", entry.get("cy", height / 2))
    photo, background = entry.get("photo"), entry.get("background", [0.0, 0.0, 0.0])
    if not (isinstance(background, list) and len(background) == 3):
        raise DataError(path, f"{where}.background", "is no list of three numbers", "write the file again")
    r, g, b = (strict_json.number(path, f"{where}.background", c) for c in background)
    return SavedCamera(
        name=str(entry.get("img_name", i)),
        camera=_camera(path, where, pose, numbers["fx"], numbers["fy"], cx, cy, width, height),
        split="test" if entry.get("split") == "test" else "train",
        scale=max(1, round(strict_json.number(path, f"{where}.scale", entry.get("scale", 1)))),
        photo=path.parent / photo if isinstance(photo, str) and (path.parent / photo).is_file() else None,
        background=(r, g, b),
    )


def _of_transforms(path: Path, i: int, values: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    """A frame of transforms.json; without distortion, because it is drawn and not read."""
    where = f"frames[{i}]"

    def number(key: str, default: float | None = None) -> float:
        return strict_json.number(path, f"{where}.{key}", values.get(key, default))

    pose = pose_from_opengl(path, f"{where}.transform_matrix", values.get("transform_matrix"))
    width, height = number("w", size[0]), number("h", size[1])
    angle = values.get("camera_angle_x")
    of_angle = None if angle is None else width / 2 / math.tan(number("camera_angle_x") / 2)
    fx = number("fl_x", of_angle)
    fy, cx, cy = number("fl_y", fx), number("cx", width / 2), number("cy", height / 2)
    return _camera(path, where, pose, fx, fy, cx, cy, round(width), round(height))


def _of_viewer(path: Path, i: int, entry: Mapping[str, Any], size: tuple[int, int]) -> Camera:
    where, matrix = f"camera_path[{i}]", entry.get("camera_to_world")
    if isinstance(matrix, list) and len(matrix) == 16:  # nerfstudio writes 16 numbers, row by row
        matrix = [matrix[row : row + 4] for row in range(0, 16, 4)]
    pose = pose_from_opengl(path, f"{where}.camera_to_world", matrix)
    degrees = strict_json.number(path, f"{where}.fov", entry.get("fov"))
    if not 0 < degrees < 180:
        raise DataError(path, f"{where}.fov", f"is {degrees:g}, must lie in (0, 180) degrees", "correct the field")
    width, height = size
    focal = height / 2 / math.tan(math.radians(degrees) / 2)
    return _camera(path, where, pose, focal, focal, width / 2, height / 2, width, height)


def _camera(
    path: Path, where: str, pose: Float[Tensor, "4 4"],
    fx: float, fy: float, cx: float, cy: float, width: int, height: int,
) -> Camera:  # fmt: skip
    try:
        return Camera(pose.to(torch.float64), fx, fy, cx, cy, width, height)
    except ValueError as error:
        raise DataError(path, where, str(error), "correct the camera") from error


def _read_json(path: Path) -> Any:
    """A list or an object; the strict reader knows objects only."""
    try:
        with path.open() as file:
            first = file.read(64).lstrip()[:1]
        return json.loads(path.read_text()) if first == "[" else strict_json.read_object(path)
    except OSError as error:
        raise DataError(path, "file", f"cannot be read ({error.strerror})", "check the path") from error
    except (ValueError, RecursionError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(path, "json", f"is not valid ({error})", "write it again") from error
