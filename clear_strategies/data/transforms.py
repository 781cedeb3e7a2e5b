"""transforms.json, as NeRF's Blender scenes, instant-ngp and nerfstudio write it: frames, and intrinsics shared or of each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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

    def lens(self, path: Path, where: str, image: Path) -> Lens:
        """The lens, for the sizes that the frame gives, else for the size of its image; `path`, `where`: of this frame."""
        # If the photo is turned, only given sizes show whether the lens is that of the stored pixels.
        real = (0, 0) if self.w is not None and self.h is not None else image_size(image)
        width, height = real[0] if self.w is None else self.w, real[1] if self.h is None else self.h

        def focal(length: float | None, angle: float | None, axis: str, size: float) -> float | None:
            if length is None and angle is not None:
                if not 0 < angle < math.pi:
                    problem = f"is {angle:g}; it must lie in (0, pi) radians"
                    raise DataError(path, f"{where}.camera_angle_{axis}", problem, "correct the field")
                return size / (2 * math.tan(angle / 2))
            return length

        fx = focal(self.fl_x, self.camera_angle_x, "x", width)
        fy = focal(self.fl_y, self.camera_angle_y, "y", height)
        if fx is None:
            remedy = "give it or camera_angle_x"
            raise DataError(path, f"{where}.fl_x", "is missing, for the frame and for all", remedy)
        cx, cy = width / 2 if self.cx is None else self.cx, height / 2 if self.cy is None else self.cy
        model = "OPENCV_FISHEYE" if self.is_fisheye else self.camera_model
        terms = {key: value for key in _COEFFICIENTS if (value := getattr(self, key)) != 0}
        size, pinhole = (round(width), round(height)), (fx, fx if fy is None else fy, cx, cy)
        return lens_of(path, where, model, size, pinhole, terms)


class _Points(msgspec.Struct):
    ply_file_path: str | None = None


def transforms_of(path: Path, content: Mapping[str, Any]) -> list[Transform]:
    """The frames of a file's content, which name their images; a frame's own values replace those shared by all."""
    remedy = "give a transforms file"
    frames = typed(path, content.get("frames") or None, list[dict[str, Any]], where="frames", remedy=remedy)
    shared = {name: content[name] for name in Transform.__struct_fields__ if name in content}
    transforms = [typed(path, {**shared, **frame}, Transform, where=f"frames[{i}]") for i, frame in enumerate(frames)]
    if unnamed := [i for i, transform in enumerate(transforms) if not transform.file_path]:
        raise DataError(path, f"frames[{unnamed[0]}].file_path", "is missing", "name the frame's image")
    return transforms


def frames_of(
    transforms: Mapping[Path, Sequence[Transform]],
    photos: Mapping[Path, Sequence[tuple[str, Path, str | None]]],
    *,
    background: Color,
    skip_faulty: bool,
) -> list[Frame]:
    """The frames of a folder's files whose photos can be used, with their masks: the frames' own, or those of `masks_of`.

    Args:
        photos: name, file and split of each of `transforms`.
    """
    folder = next(iter(transforms)).parent
    find, frames = finder(folder), list[Frame]()
    listed = [
        (frame, path) for file in transforms for frame, (_, path, _) in zip(transforms[file], photos[file], strict=True)
    ]
    own = {path: find(frame.mask_path) for frame, path in listed if frame.mask_path}
    masks = masks_of(folder, [path for _, path in listed], own)
    for file, of_file in photos.items():
        paths = [path for _, path, _ in of_file]
        for i in usable(file, range(len(paths)), paths.__getitem__, skip_faulty=skip_faulty):
            where, transform, (name, path, split) = f"frames[{i}]", transforms[file][i], of_file[i]
            pose = pose_from_opengl(file, f"{where}.transform_matrix", transform.transform_matrix)
            lens, mask = transform.lens(file, where, path), masks.get(path)
            frames.append(Frame.of_photo(name, path, lens, pose, background=background, split=split, mask=mask))
    return frames


def points_of(file: Path, content: Mapping[str, Any]) -> SfmPoints | None:
    """The points of the PLY file that a file names, if it does."""
    if not (name := typed(file, content, _Points).ply_file_path):
        return None
    cloud, none = read_points(finder(file.parent)(name)), torch.zeros(0, dtype=torch.long)
    return SfmPoints(cloud.means, cloud.colors, none, none, f"{name}, {len(cloud):,} points without tracks")
