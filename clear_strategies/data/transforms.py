"""transforms.json, as NeRF's Blender scenes, instant-ngp and nerfstudio write it: frames, and intrinsics shared or of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from clear_strategies.data.strict_json import Number, typed
from clear_strategies.errors import DataError


class Transform(msgspec.Struct):
    """A frame with what it shares with the others. Sizes, focal lengths and the principal point are pixels."""

    file_path: str = ""
    mask_path: str | None = None
    transform_matrix: Any = None
    w: Number | None = None
    h: Number | None = None
    fl_x: Number | None = None
    fl_y: Number | None = None
    cx: Number | None = None
    cy: Number | None = None
    camera_angle_x: Number | None = None
    camera_angle_y: Number | None = None
    camera_model: str = "OPENCV"
    is_fisheye: bool = False
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0

    def pinhole(self, path: Path, where: str, width: float, height: float) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) of an image of this size.

        Args:
            path, where: of this frame, for the message.
        """
        fx, fy = self.fl_x, self.fl_y
        if fx is None:
            if self.camera_angle_x is None:
                remedy = "give it or camera_angle_x"
                raise DataError(path, f"{where}.fl_x", "is missing, for the frame and for all", remedy)
            fx = focal_of(path, f"{where}.camera_angle_x", self.camera_angle_x, width)
        if fy is None:
            angle = self.camera_angle_y
            fy = fx if angle is None else focal_of(path, f"{where}.camera_angle_y", angle, height)
        return fx, fy, width / 2 if self.cx is None else self.cx, height / 2 if self.cy is None else self.cy


def transforms_of(path: Path, content: Mapping[str, Any]) -> list[Transform]:
    """The frames of a file's content; what a frame has itself wins."""
    frames = typed(
        path, content.get("frames") or None, list[dict[str, Any]], where="frames", remedy="give a transforms file"
    )
    shared = {name: content[name] for name in Transform.__struct_fields__ if name in content}
    return [typed(path, {**shared, **frame}, Transform, where=f"frames[{i}]") for i, frame in enumerate(frames)]


def require_paths(path: Path, frames: list[Transform]) -> None:
    """Refuse frames that name no image."""
    for i, frame in enumerate(frames):
        if not frame.file_path:
            raise DataError(path, f"frames[{i}].file_path", "is missing", "name the frame's image")


def focal_of(path: Path, where: str, angle: float | None, size: float) -> float:
    """The focal length of an image that is so many pixels wide or high, from the angle in radians that it spans."""
    if angle is None:
        raise DataError(path, where, "is missing", "give radians")
    if not 0 < angle < math.pi:
        raise DataError(path, where, f"is {angle:g}; it must lie in (0, pi) radians", "correct the field")
    return size / (2 * math.tan(angle / 2))
