"""transforms.json, as NeRF's Blender scenes, instant-ngp and nerfstudio write it: frames, and intrinsics shared or of each."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import torch

from clear_strategies.data.capture import Frame, SfmPoints
from clear_strategies.data.lenses import Lens, lens_of, pose_from_opengl
from clear_strategies.data.masks import masks_of
from clear_strategies.data.photo_files import image_size
from clear_strategies.data.photo_folders import finder, usable
from clear_strategies.data.ply import read_points
from clear_strategies.data.strict_json import Number, typed
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_COEFFICIENTS: Final = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


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
    k5: Number = 0.0
    k6: Number = 0.0
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
            fx = _focal(path, f"{where}.camera_angle_x", self.camera_angle_x, width)
        if fy is None:
            angle = self.camera_angle_y
            fy = fx if angle is None else _focal(path, f"{where}.camera_angle_y", angle, height)
        return fx, fy, width / 2 if self.cx is None else self.cx, height / 2 if self.cy is None else self.cy

    def lens(self, path: Path, where: str, image: Path) -> Lens:
        """The lens, for the sizes that the frame gives, else for the size of its image.

        Args:
            path, where: of this frame, for the message.
        """
        # If the photo is turned, only given sizes show whether the lens is that of the stored pixels.
        real = (0, 0) if self.w is not None and self.h is not None else image_size(image)
        width, height = (
            float(size) if given is None else given for given, size in zip((self.w, self.h), real, strict=True)
        )
        fx, fy, cx, cy = self.pinhole(path, where, width, height)
        model = "OPENCV_FISHEYE" if self.is_fisheye else self.camera_model
        terms = {key: value for key in _COEFFICIENTS if (value := getattr(self, key)) != 0}
        return lens_of(path, where, model, (round(width), round(height)), (fx, fy, cx, cy), terms)


class _Points(msgspec.Struct):
    ply_file_path: str | None = None


def transforms_of(path: Path, content: Mapping[str, Any]) -> list[Transform]:
    """The frames of a file's content; a frame's own values replace those shared by all."""
    frames = typed(
        path, content.get("frames") or None, list[dict[str, Any]], where="frames", remedy="give a transforms file"
    )
    shared = {name: content[name] for name in Transform.__struct_fields__ if name in content}
    return [typed(path, {**shared, **frame}, Transform, where=f"frames[{i}]") for i, frame in enumerate(frames)]


def photo_transforms(path: Path, content: Mapping[str, Any]) -> list[Transform]:
    """As `transforms_of`, for a file whose frames must name their images."""
    transforms = transforms_of(path, content)
    for i, transform in enumerate(transforms):
        if not transform.file_path:
            raise DataError(path, f"frames[{i}].file_path", "is missing", "name the frame's image")
    return transforms


def frames_of(
    file: Path,
    transforms: Sequence[Transform],
    photos: Sequence[tuple[str, Path, str | None]],
    *,
    masks: Mapping[Path, Path],
    background: Color,
    skip_faulty: bool,
) -> list[Frame]:
    """The frames of a file whose photos can be used.

    Args:
        photos: name, file and split of each of `transforms`.
        masks: see `masks_of_frames`.
    """
    frames = []
    for i in usable(file, range(len(photos)), lambda i: photos[i][1], skip_faulty=skip_faulty):
        where, transform, (name, path, split) = f"frames[{i}]", transforms[i], photos[i]
        pose = pose_from_opengl(file, f"{where}.transform_matrix", transform.transform_matrix)
        lens = transform.lens(file, where, path)
        frames.append(Frame.of_photo(name, path, lens, pose, background=background, split=split, mask=masks.get(path)))
    return frames


def masks_of_frames(folder: Path, transforms: Iterable[Transform], paths: Sequence[Path]) -> dict[Path, Path]:
    """`masks_of` these photos, by the frames' own `mask_path` where they have one."""
    find = finder(folder)
    named = {path: find(frame.mask_path) for frame, path in zip(transforms, paths, strict=True) if frame.mask_path}
    return masks_of(folder, paths, named)


def points_of(file: Path, content: Mapping[str, Any]) -> SfmPoints | None:
    """The points of the PLY file that a file names, if it does."""
    if not (name := typed(file, content, _Points).ply_file_path):
        return None
    cloud, none = read_points(finder(file.parent)(name)), torch.zeros(0, dtype=torch.long)
    return SfmPoints(cloud.means, cloud.colors, none, none, f"{name}, {len(cloud):,} points without tracks")


def _focal(path: Path, where: str, angle: float, size: float) -> float:
    """The focal length, pixels, of an image that spans `angle` radians along its `size` pixels."""
    if not 0 < angle < math.pi:
        raise DataError(path, where, f"is {angle:g}; it must lie in (0, pi) radians", "correct the field")
    return size / (2 * math.tan(angle / 2))
