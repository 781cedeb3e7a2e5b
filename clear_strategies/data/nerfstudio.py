"""transforms.json of nerfstudio and instant-ngp: OpenGL poses, shared or per-frame intrinsics, lens distortion."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from clear_strategies.data import strict_json
from clear_strategies.data.cameras import Lens, by_name, make_frame, pose_from_opengl
from clear_strategies.data.capture import Capture, Frame, SfmPoints
from clear_strategies.data.photo_files import image_size, inside
from clear_strategies.data.ply import read_points
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_SUPPORTED = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")


def read(root: str | Path) -> Capture:
    """A folder with transforms.json, or that file.

    Raises:
        DataError: something is missing or not what it should be.
    """
    given = Path(root)
    file = given if given.suffix == ".json" else given / "transforms.json"
    folder = file.parent
    content = strict_json.read_object(file)
    splits = _splits(file, content)
    frames = []
    for i, frame in enumerate(strict_json.frames_of(file, content)):
        frames.append(_frame(folder, file, i, {**_shared(content), **frame}, splits))
    if any("mask_path" in frame for frame in strict_json.frames_of(file, content)):
        _log.warning("%s: masks are not used.", file)
    notes = {"poses": file.name}
    if any(key in content for key in ("k1", "k2", "k3", "k4", "p1", "p2")):
        notes["lens"] = "distortion removed by OpenCV"
    return Capture(folder.resolve().name, by_name(frames, file), _points(folder, file, content), notes=notes)


def _frame(folder: Path, file: Path, i: int, frame: Mapping[str, Any], splits: Mapping[str, str]) -> Frame:
    where = f"frames[{i}]"
    name = strict_json.file_path(file, i, dict(frame))
    path = inside(folder, name, file=file)
    pose = pose_from_opengl(file, f"{where}.transform_matrix", frame.get("transform_matrix"))
    return make_frame(path.name, path, _lens(file, where, frame, path), pose, split=splits.get(name))


def _lens(file: Path, where: str, frame: Mapping[str, Any], image: Path) -> Lens:
    def number(key: str, default: float | None = None) -> float:
        value = frame.get(key, default)
        if value is None:
            raise DataError(
                file, f"{where}.{key}", "is missing, for the frame and for all", "give fl_x or camera_angle_x"
            )
        return strict_json.number(file, f"{where}.{key}", value)

    model = frame.get("camera_model", "OPENCV")
    if model not in _SUPPORTED:
        raise DataError(file, "camera_model", f"is {str(model)[:40]!r}", f"use one of {', '.join(_SUPPORTED)}")
    real_width, real_height = image_size(image)
    width, height = number("w", real_width), number("h", real_height)
    if "fl_x" in frame:
        fx = number("fl_x")
    else:
        angle = number("camera_angle_x")
        if not 0 < angle < math.pi:
            raise DataError(
                file, "camera_angle_x", f"is {angle:g}; it must lie in (0, pi) radians", "correct the field"
            )
        fx = width / (2 * math.tan(angle / 2))
    fisheye = model == "OPENCV_FISHEYE"
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    distortion = tuple(number(key, 0.0) for key in keys)
    cx, cy = number("cx", width / 2), number("cy", height / 2)
    return Lens(round(width), round(height), fx, number("fl_y", fx), cx, cy, distortion, fisheye).check(file, where)


def _shared(content: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "p1", "p2", "camera_angle_x", "camera_model")
    return {key: content[key] for key in keys if key in content}


def _splits(file: Path, content: Mapping[str, Any]) -> dict[str, str]:
    splits: dict[str, str] = {}
    for key, split in (("train_filenames", "train"), ("val_filenames", "test"), ("test_filenames", "test")):
        names = content.get(key, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise DataError(file, key, "is no list of file names", "correct the field")
        splits |= dict.fromkeys(names, split)
    return splits


def _points(folder: Path, file: Path, content: Mapping[str, Any]) -> SfmPoints | None:
    name = content.get("ply_file_path")
    if name is None:
        return None
    if not isinstance(name, str):
        raise DataError(file, "ply_file_path", "is no text", "name the point cloud's file")
    cloud = read_points(inside(folder, name, file=file))
    none = torch.zeros(0, dtype=torch.long)
    return SfmPoints(cloud.means, cloud.colors, none, none, f"{len(cloud):,} points of {name}, made from all images")
