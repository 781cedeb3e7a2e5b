"""transforms.json of nerfstudio and instant-ngp: OpenGL poses, shared or per-frame intrinsics, lens distortion."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final

import msgspec
import torch

from clear_strategies.core.checks import as_color
from clear_strategies.data.capture import BLACK, Capture, Frame, SfmPoints, lens_notes, sorted_by_name
from clear_strategies.data.masks import masks_of
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.data.photo_folders import is_file
from clear_strategies.data.ply import read_points
from clear_strategies.data.strict_json import read_object, typed
from clear_strategies.data.transforms import frames_of, photo_transforms
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_SIDES: Final = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}


class _Lists(msgspec.Struct):
    """The files that transforms.json names besides its frames."""

    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []
    ply_file_path: str | None = None


def recognises(path: Path) -> int:
    """The rank of `clear_strategies.commands.train.detect`."""
    return 4 * (path.name == "transforms.json" or (path / "transforms.json").is_file())


def read(
    root: str | Path,
    *,
    background: Color = BLACK,
    skip_faulty: bool = False,
) -> Capture:
    """Read a folder with transforms.json, or that file. Poses are taken as they are, `applied_transform` included.

    Args:
        background: RGB in [0, 1] behind transparent pixels.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: the background is no colour.
        DataError: something is missing or not what it should be.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    file = root if root.suffix == ".json" else root / "transforms.json"
    folder, content = file.parent, read_object(file)
    transforms = photo_transforms(file, content)
    lists = typed(file, content, _Lists)
    names = [transform.file_path for transform in transforms]
    splits = _splits(file, lists)
    parts = [PurePosixPath(name).parts for name in names]
    shared = os.path.commonprefix([part[:-1] for part in parts])  # noqa: RUF071 - compares tuples of folders
    photos = [
        ("/".join(part[len(shared) :]), _photo(folder, name), splits.get(name))
        for name, part in zip(names, parts, strict=True)
    ]
    masks = masks_of(folder, [path for _, path, _ in photos])
    frames = frames_of(file, transforms, photos, masks=masks, background=background, skip_faulty=skip_faulty)
    notes = {"poses": f"{file.name}, {len(frames)} images", **lens_notes(frames)}
    if splits:
        if strangers := sorted(splits.keys() - set(names)):
            problem = f"lists {strangers[0]!r}, which is no frame's file_path"
            raise DataError(file, "split", problem, "correct the lists")
        notes["split"] = _split_note(file, frames)
    points = None
    if (name := lists.ply_file_path) is not None:
        cloud = read_points(folder / name)
        none = torch.zeros(0, dtype=torch.long)
        points = SfmPoints(cloud.means, cloud.colors, none, none, f"{name}, {len(cloud):,} points without tracks")
    return Capture(folder.resolve().name, sorted_by_name(frames, file), points, background, notes)


def _photo(folder: Path, name: str) -> Path:
    """The photo of this name; instant-ngp omits the ending .png."""
    has_ending = name.lower().endswith(SUFFIXES) or is_file(folder / name)
    return folder / (name if has_ending else f"{name}.png")


def _splits(file: Path, lists: _Lists) -> dict[str, str]:
    """The side of each photo in the file's lists, "train" or "test"."""
    splits: dict[str, str] = {}
    for key, side in _SIDES.items():
        names = getattr(lists, key)
        both = sorted(name for name in names if splits.get(name, side) != side)
        if both:
            raise DataError(file, key, f"{both[0]!r} is for training, too", "list each photo once")
        splits |= dict.fromkeys(names, side)
    return splits


def _split_note(file: Path, frames: Sequence[Frame]) -> str:
    """How many frames the file's own lists assign to each side. Frames in none of them are logged."""
    counts = Counter(frame.split for frame in frames)
    if counts[None]:
        message = "%s: %d frames are in none of its split lists and are not used; data.views.own_split=false uses them."
        _log.warning(message, file, counts[None])
    return f"the file's own: {counts['train']} train, {counts['test']} test, {counts[None]} in neither"
