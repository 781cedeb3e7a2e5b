"""transforms.json of nerfstudio, instant-ngp and NeRF's Blender scenes: OpenGL poses, shared or per-frame intrinsics."""

from __future__ import annotations

import itertools
import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import BLACK, Capture, Frame, SfmPoints, lens_notes, rigid_inverse, sorted_by_name
from clear_strategies.data.file_names import finder, named, names_below, some
from clear_strategies.data.lenses import FARTHEST, Lens, lens_of
from clear_strategies.data.masks import masks_of
from clear_strategies.data.photo_files import read_header
from clear_strategies.data.photo_folders import image_folder, usable
from clear_strategies.data.ply import read_points
from clear_strategies.data.strict_json import Number, read_object, typed
from clear_strategies.errors import DataError, counted
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_FILE: Final = "transforms.json"
_SPLIT_LISTS: Final = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}
_COEFFICIENTS: Final = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_Coordinate = Annotated[float, Meta(gt=-FARTHEST, lt=FARTHEST)]
_Rows = Annotated[
    list[Annotated[list[_Coordinate], Meta(min_length=4, max_length=4)]], Meta(min_length=3, max_length=4)
]


class _Shared(msgspec.Struct):
    """The fields of a file that concern all frames: the split lists and the points."""

    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []
    ply_file_path: str | None = None


def recognises(path: Path) -> int:
    """The reader's rank for a path, see `clear_strategies.commands.train.detect`."""
    return 4 * ((path.suffix == ".json" and path.is_file()) or named(path, _FILE).is_file())


def read(
    root: str | Path, images: str | None = None, *, background: Color = BLACK, skip_faulty: bool = False
) -> Capture:
    """Read a folder with transforms.json, or that file. Poses are used unchanged, `applied_transform` included.

    Args:
        images: the folder that replaces the first folder of the frames' paths, such as images_4, where nerfstudio stores
            reduced photos. None: the photos that the frames name.
        background: RGB in [0, 1] behind transparent pixels.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: the background is no colour.
        DataError: something is missing or not what it should be.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    file = root if root.suffix == ".json" else named(root, _FILE)
    folder, content = file.parent, read_object(file)
    transforms = transforms_of(file, content)
    find = finder(folder)
    if images is not None:
        transforms = [_sized(transform, find) for transform in transforms]
        find = _in_place_of_first(image_folder(folder, images))
    paths = [find(transform.file_path) for transform in transforms]
    splits = _splits_of(file, typed(file, content, _Shared), paths, find)
    listed = [
        Listed(transform, name, path, splits.get(path))
        for transform, name, path in zip(transforms, names_below(paths), paths, strict=True)
    ]
    frames = frames_of({file: listed}, background=background, skip_faulty=skip_faulty, scene=folder)
    notes = {"poses": f"{file.name}, {len(frames)} images", **lens_notes(frames)}
    if splits:
        counts = Counter(frame.split for frame in frames)
        notes["split"] = f"the file's own: {counts['train']} train, {counts['test']} test, {counts[None]} in neither"
        if counts[None]:
            message = "%s: %s in none of its split lists, so not used; data.views.own_split=false uses all."
            _log.warning(message, file, counted(counts[None], "frame"))
    if depth := next((transform.depth_file_path for transform in transforms if transform.depth_file_path), None):
        message = "%s names depth files, which complete stereo with data.cloud.depth=%s."
        _log.info(message, file, finder(folder)(depth).parent)
    return Capture(folder.resolve().name, sorted_by_name(frames, file), points_of(file, content), background, notes)


def _splits_of(file: Path, lists: _Shared, paths: Sequence[Path], find: Callable[[str], Path]) -> dict[Path, str]:
    """The split of each photo that the file's lists name; warns of names that are no frame's."""
    splits: dict[Path, str] = {}
    removed, listed = list[str](), set(paths)
    for key, split in _SPLIT_LISTS.items():
        for name in getattr(lists, key):
            if (path := find(name)) not in listed:
                removed.append(name)
            elif splits.setdefault(path, split) != split:
                raise DataError(file, key, f"{name!r} is for training, too", "list each photo once")
    if removed:
        message = "%s: %s in its split lists, and no frame's file_path: %s."
        _log.warning(message, file, counted(len(removed), "photo"), some(removed))
    return splits


def _in_place_of_first(folder: Path) -> Callable[[str], Path]:
    """A `finder` that ignores the first folder of a name, and as many leading folders of an absolute path as necessary."""
    find = finder(folder)

    def find_below_first(name: str) -> Path:
        parts = PureWindowsPath(name).parts
        return find(f"/{'/'.join(parts[1:] or parts)}")

    return find_below_first


def _sized(transform: Transform, find: Callable[[str], Path]) -> Transform:
    """Set a missing image size to that of the photo that the frame names."""
    if transform.w is not None and transform.h is not None:
        return transform
    width, height = read_header(find(transform.file_path)).size(None)
    return msgspec.structs.replace(transform, w=float(width), h=float(height))


class Transform(msgspec.Struct):
    """A frame, completed by the values that all frames share. Sizes, focal lengths and the principal point are in pixels."""

    file_path: str = ""
    mask_path: str | None = None
    depth_file_path: str | None = None
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
        """The lens, for the size that the frame gives, else for that of its image; `path`, `where`: of the frame, for errors."""
        # With an EXIF rotation, only a given size tells that the lens is of the stored pixels.
        actual = (0, 0) if self.w is not None and self.h is not None else read_header(image).size(None)
        width = actual[0] if self.w is None else self.w
        height = actual[1] if self.h is None else self.h

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
        cx = width / 2 if self.cx is None else self.cx
        cy = height / 2 if self.cy is None else self.cy
        model = "OPENCV_FISHEYE" if self.is_fisheye else self.camera_model
        terms = {key: value for key in _COEFFICIENTS if (value := getattr(self, key)) != 0}
        size, pinhole = (round(width), round(height)), (fx, fx if fy is None else fy, cx, cy)
        return lens_of(path, where, model, size, pinhole, terms)


class Listed(NamedTuple):
    """A frame of a file, the path of its photo, and the name and the split of its view."""

    transform: Transform
    name: str
    path: Path
    split: str | None


def transforms_of(path: Path, content: Mapping[str, Any]) -> list[Transform]:
    """Parse the frames of a file, each of which must name its image; a frame's own values override the shared ones."""
    remedy = "give a transforms file"
    frames = typed(path, content.get("frames", []), list[dict[str, Any]], where="frames", remedy=remedy)
    if not frames:
        raise DataError(path, "frames", "there is none", remedy)
    shared = {name: content[name] for name in Transform.__struct_fields__ if name in content}
    transforms = [typed(path, {**shared, **frame}, Transform, where=f"frames[{i}]") for i, frame in enumerate(frames)]
    if unnamed := [i for i, transform in enumerate(transforms) if not transform.file_path]:
        raise DataError(path, f"frames[{unnamed[0]}].file_path", "is missing", "name the frame's image")
    return transforms


def frames_of(
    listed: Mapping[Path, Sequence[Listed]], *, background: Color, skip_faulty: bool, scene: Path | None = None
) -> list[Frame]:
    """Make the frames whose photos are `usable`, with their masks: those that the frames name, or those of `masks_of`.

    Args:
        listed: the frames of each file; all files lie in one folder.
        skip_faulty, scene: see `usable`.
    """
    folder = next(iter(listed)).parent
    find, every = finder(folder), list(itertools.chain(*listed.values()))
    frames: list[Frame] = []
    own = {entry.path: find(entry.transform.mask_path) for entry in every if entry.transform.mask_path}
    masks = masks_of(folder, [entry.path for entry in every], own)
    for file, entries in listed.items():
        photos = (((f"frames[{i}]", entry), entry.path) for i, entry in enumerate(entries))
        for (where, entry), path in usable(file, photos, skip_faulty=skip_faulty, scene=scene):
            pose = _pose_of(file, f"{where}.transform_matrix", entry.transform.transform_matrix)
            lens, mask = entry.transform.lens(file, where, path), masks.get(path)
            frames.append(
                Frame.of_photo(entry.name, path, lens, pose, background=background, split=entry.split, mask=mask)
            )
    return frames


def _pose_of(file: Path, where: str, matrix: object) -> Float[Tensor, "4 4"]:
    """Convert a camera-to-world matrix with OpenGL axes (x right, y up, z back) to world-to-camera with OpenCV axes."""
    remedy = "write camera-to-world matrices: a rotation, a translation, last row 0 0 0 1"
    try:
        rows = np.array(msgspec.convert(matrix, _Rows))
    except msgspec.ValidationError as error:
        raise DataError(file, where, "is no 3x4 or 4x4 matrix of finite numbers", remedy) from error
    if len(rows) == 4 and np.abs(rows[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(file, where, f"has the last row {rows[3].tolist()}", remedy)
    rotation = rows[:3, :3] * np.array([1.0, -1.0, -1.0])  # OpenGL's y and z axes are opposite
    return rigid_inverse(file, where, rotation, rows[:3, 3])


def points_of(file: Path, content: Mapping[str, Any]) -> SfmPoints | None:
    """Read the points of the PLY file that a file names; None if it names none."""
    if not (name := typed(file, content, _Shared).ply_file_path):
        return None
    cloud = read_points(finder(file.parent)(name))
    return SfmPoints.without_tracks(cloud.means, cloud.colors, f"{name}, {len(cloud):,} points without tracks")
