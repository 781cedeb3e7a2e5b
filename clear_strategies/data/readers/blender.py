"""NeRF-synthetic ("Blender") scenes: transforms_train.json and transforms_test.json, RGBA images over white."""

from __future__ import annotations

import itertools
import logging
from pathlib import Path
from typing import Final

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import Capture, Frame, lens_notes, require_names
from clear_strategies.data.masks import masks_of
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.data.strict_json import read_object
from clear_strategies.data.transforms import frames_of, photo_transforms
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_WHITE: Final = (1.0, 1.0, 1.0)


def recognises(path: Path) -> int:
    """The rank of `clear_strategies.commands.train.detect`."""
    return 4 * (path / "transforms_train.json").is_file()


def read(
    root: str | Path,
    *,
    background: Color = _WHITE,
    skip_faulty: bool = False,
) -> Capture:
    """Read a scene folder. Frames are named by their file (r_2), test frames with the prefix "test/".

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
    files, frames = [root / "transforms_train.json"], list[Frame]()
    if (root / "transforms_test.json").exists():
        files.append(root / "transforms_test.json")
    else:
        _log.warning("%s has no transforms_test.json: there are no test views.", root)
    transforms = {file: photo_transforms(file, read_object(file)) for file in files}
    paths = {file: [_photo(root, transform.file_path) for transform in transforms[file]] for file in files}
    masks = masks_of(root, itertools.chain(*paths.values()))
    for file, split in zip(files, ("train", "test"), strict=False):
        photos = [(path.stem if split == "train" else f"test/{path.stem}", path, split) for path in paths[file]]
        frames += frames_of(file, transforms[file], photos, masks=masks, background=background, skip_faulty=skip_faulty)
    require_names(frames, root)
    color = "white" if background == _WHITE else f"RGB {background}"
    notes = {
        "poses": ", ".join(file.name for file in files),
        "order": "of the files",
        "background": f"{color} behind transparent pixels",
        **lens_notes(frames),
    }
    return Capture(root.resolve().name, tuple(frames), None, background, notes)


def _photo(root: Path, name: str) -> Path:
    return root / (name if name.lower().endswith(SUFFIXES) else f"{name}.png")
