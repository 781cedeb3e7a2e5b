"""NeRF-synthetic ("Blender") scenes: transforms_train.json and transforms_test.json, RGBA images over white."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from clear_strategies.core.checks import as_color
from clear_strategies.data.cameras import Lens, pose_from_opengl
from clear_strategies.data.capture import Capture, Frame, lens_notes, sorted_by_name
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.data.photo_folders import Fault, inside, usable
from clear_strategies.data.strict_json import read_object
from clear_strategies.data.transforms import require_paths, transforms_of
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_WHITE: Final = (1.0, 1.0, 1.0)


def read(
    root: str | Path,
    *,
    background: Color = _WHITE,
    allow_outside: bool = False,
    missing: Fault = "refuse",
    broken: Fault = "refuse",
) -> Capture:
    """Read a scene folder. Frames are named by their file (r_2), test frames with the prefix "test/".

    Frames keep the order of the JSON files, which is the protocols' numbering. By name, r_10 would come before r_2.

    Args:
        background: RGB in [0, 1], behind transparent pixels.
        allow_outside: follow file names and links that lead out of the folder.
        missing: frames whose photo is not there: "refuse" or "skip".
        broken: photos that cannot be decoded: "refuse" or "skip".

    Raises:
        SettingError: the background is no colour.
        DataError: something is missing or not what it should be.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    faults = partial(usable, path_of=lambda entry: entry[0], missing=missing, broken=broken)
    found = _frames(root, root / "transforms_train.json", "train", background, allow_outside, faults)
    files = ["transforms_train.json"]
    if (root / "transforms_test.json").exists():
        found += _frames(root, root / "transforms_test.json", "test", background, allow_outside, faults)
        files.append("transforms_test.json")
    else:
        _log.warning("%s has no transforms_test.json: there are no test views.", root)
    lenses, frames = [lens for lens, _ in found], [frame for _, frame in found]
    sorted_by_name(frames, root)  # only to refuse two frames of one name
    color = "white" if background == _WHITE else f"RGB {background}"
    notes = {"poses": ", ".join(files), "order": "of the files", "background": f"{color} behind transparent pixels"}
    notes |= lens_notes(lenses, frames)
    return Capture(root.resolve().name, tuple(frames), None, background, notes)


def _frames(
    root: Path,
    file: Path,
    split: str,
    background: Color,
    allow_outside: bool,
    faults: Callable[[Path, list[tuple[Path, int]]], list[tuple[Path, int]]],
) -> list[tuple[Lens, Frame]]:
    transforms, photos = transforms_of(file, read_object(file)), []
    require_paths(file, transforms)
    for i, transform in enumerate(transforms):
        ending = "" if transform.file_path.lower().endswith(SUFFIXES) else ".png"
        photos.append((inside(root, transform.file_path + ending, file=file, allow_outside=allow_outside), i))
    found = []
    for path, i in faults(file, photos):
        pose = pose_from_opengl(file, f"frames[{i}].transform_matrix", transforms[i].transform_matrix)
        lens, mask = transforms[i].lens(file, f"frames[{i}]", path), transforms[i].mask(file, allow_outside)
        label = path.stem if split == "train" else f"{split}/{path.stem}"
        found.append((lens, Frame.of_photo(label, path, lens, pose, background=background, split=split, mask=mask)))
    return found
