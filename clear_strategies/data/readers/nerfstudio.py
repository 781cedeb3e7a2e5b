"""transforms.json of nerfstudio and instant-ngp: OpenGL poses, shared or per-frame intrinsics, lens distortion."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path, PureWindowsPath
from typing import Final

import msgspec

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import BLACK, Capture, lens_notes, sorted_by_name
from clear_strategies.data.photo_files import image_size
from clear_strategies.data.photo_folders import finder, image_folder, named
from clear_strategies.data.strict_json import read_object, typed
from clear_strategies.data.transforms import Transform, frames_of, points_of, transforms_of
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_FILE: Final = "transforms.json"
_SIDES: Final = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}


class _Lists(msgspec.Struct):
    """How transforms.json splits its frames."""

    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []


def recognises(path: Path) -> int:
    """The rank of `clear_strategies.commands.train.detect`."""
    return 4 * ((path.suffix == ".json" and path.is_file()) or named(path, _FILE).is_file())


def read(
    root: str | Path, images: str | None = None, *, background: Color = BLACK, skip_faulty: bool = False
) -> Capture:
    """Read a folder with transforms.json, or that file. Poses are taken as they are, `applied_transform` included.

    Args:
        images: the folder that takes the place of the first in the frames' paths, such as images_4, where nerfstudio keeps
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
    lists = typed(file, content, _Lists)
    splits: dict[Path, str] = {}
    for key, side in _SIDES.items():
        for name in getattr(lists, key):
            if splits.setdefault(find(name), side) != side:
                raise DataError(file, key, f"{name!r} is for training, too", "list each photo once")
            if find(name) not in paths:
                raise DataError(file, "split", f"lists {name!r}, which is no frame's file_path", "correct the lists")
    shared = os.path.commonprefix([path.parent.parts for path in paths])  # noqa: RUF071 - compares tuples of folders
    photos = [("/".join(path.parts[len(shared) :]), path, splits.get(path)) for path in paths]
    frames = frames_of({file: transforms}, {file: photos}, background=background, skip_faulty=skip_faulty)
    notes = {"poses": f"{file.name}, {len(frames)} images", **lens_notes(frames)}
    if splits:
        counts = Counter(frame.split for frame in frames)
        notes["split"] = f"the file's own: {counts['train']} train, {counts['test']} test, {counts[None]} in neither"
        if counts[None]:
            message = (
                "%s: %d frames are in none of its split lists and are not used; data.views.own_split=false uses them."
            )
            _log.warning(message, file, counts[None])
    return Capture(folder.resolve().name, sorted_by_name(frames, file), points_of(file, content), background, notes)


def _in_place_of_first(folder: Path) -> Callable[[str], Path]:
    """`finder` of the names without their first folder, or where they are absolute, without their first folders."""
    find = finder(folder)
    return lambda name: find(f"/{'/'.join(PureWindowsPath(name).parts[1:])}")


def _sized(transform: Transform, find: Callable[[str], Path]) -> Transform:
    """The frame with the size that its lens is for, which is that of its own photo where it gives none."""
    if transform.w is not None and transform.h is not None:
        return transform
    width, height = image_size(find(transform.file_path))
    return msgspec.structs.replace(transform, w=float(width), h=float(height))
