"""NeRF-synthetic ("Blender") scenes: transforms_train.json and transforms_test.json, RGBA images over white."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import Capture, lens_notes, require_names
from clear_strategies.data.file_names import finder, named, names_below
from clear_strategies.data.readers.nerfstudio import Listed, frames_of, points_of, transforms_of
from clear_strategies.data.strict_json import read_object
from clear_strategies.data.view_names import bare
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_TRAIN: Final = "transforms_train.json"
_WHITE: Final = (1.0, 1.0, 1.0)


def recognises(path: Path) -> int:
    """The reader's rank for a path, see `clear_strategies.commands.train.detect`."""
    return 4 * named(path, _TRAIN).is_file()


def read(root: str | Path, *, background: Color = _WHITE, skip_faulty: bool = False) -> Capture:
    """Read a scene folder. Frames are named by their file (r_2), with its folder where a split has several, test frames with
    the prefix "test/".

    Frames keep the order of the JSON files, which is the protocols' numbering. By name, r_10 would come before r_2.

    Args:
        background: RGB in [0, 1], behind transparent pixels.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: the background is no colour.
        DataError: something is missing or not what it should be.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    find, splits = finder(root), {named(root, _TRAIN): "train"}
    if (test := named(root, "transforms_test.json")).exists():
        splits[test] = "test"
    else:
        _log.warning("%s has no transforms_test.json: there are no test views.", root)
    contents = {file: read_object(file) for file in splits}
    listed = {}
    for file, split in splits.items():
        transforms = transforms_of(file, contents[file])
        paths = [find(transform.file_path) for transform in transforms]
        prefix = "test/" if split == "test" else ""
        listed[file] = [
            Listed(transform, f"{prefix}{bare(name)}", path, split)
            for transform, name, path in zip(transforms, names_below(paths), paths, strict=True)
        ]
    frames = frames_of(listed, background=background, skip_faulty=skip_faulty)
    require_names(frames, root)
    color = "white" if background == _WHITE else f"RGB {background}"
    notes = {
        "poses": ", ".join(file.name for file in splits),
        "order": "of the files",
        "background": f"{color} behind transparent pixels",
        **lens_notes(frames),
    }
    points = points_of(*next(iter(contents.items())))
    return Capture(root.resolve().name, tuple(frames), points, background, notes)
