"""transforms.json of nerfstudio and instant-ngp: OpenGL poses, shared or per-frame intrinsics, lens distortion."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Final

import msgspec
import torch

from clear_strategies.core.checks import as_color
from clear_strategies.data.cameras import pose_from_opengl
from clear_strategies.data.capture import Capture, Frame, SfmPoints, lens_notes, sorted_by_name
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.data.photo_folders import Fault, inside, usable
from clear_strategies.data.ply import read_points
from clear_strategies.data.strict_json import read_object, typed
from clear_strategies.data.transforms import require_paths, transforms_of
from clear_strategies.errors import DataError
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_SPLITS: Final = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}


class _Listed(msgspec.Struct):
    """The files that transforms.json names besides its frames."""

    train_filenames: list[str] = []
    val_filenames: list[str] = []
    test_filenames: list[str] = []
    ply_file_path: str | None = None


def read(
    root: str | Path,
    *,
    background: Color | None = None,
    allow_outside: bool = False,
    missing: Fault = "refuse",
    broken: Fault = "refuse",
) -> Capture:
    """Read a folder with transforms.json, or that file. Poses are taken as they are, `applied_transform` included.

    Args:
        background: RGB in [0, 1] behind transparent pixels; None: black.
        allow_outside: follow file names and links that lead out of the folder.
        missing: frames whose photo is not there: "refuse" or "skip".
        broken: photos that cannot be decoded: "refuse" or "skip".

    Raises:
        SettingError: the background is no colour.
        DataError: something is missing or not what it should be.
    """
    if background is not None:
        background = as_color("data.reader.background", background)
    given = Path(root)
    file = given if given.suffix == ".json" else given / "transforms.json"
    folder = file.parent
    content = read_object(file)
    transforms = transforms_of(file, content)
    require_paths(file, transforms)
    listed, names = typed(file, content, _Listed), [transform.file_path for transform in transforms]
    splits = _splits(file, listed)
    parts = [PurePosixPath(name).parts for name in names]
    shared = _shared_folders(parts)
    photos = folder.joinpath(*parts[0][:shared]) if shared else None
    lenses, frames = [], []
    paths = [_photo(folder, name, file, allow_outside) for name in names]
    kept = usable(file, range(len(transforms)), lambda i: paths[i], missing=missing, broken=broken)
    for i in kept:
        where, transform, path = f"frames[{i}]", transforms[i], paths[i]
        pose = pose_from_opengl(file, f"{where}.transform_matrix", transform.transform_matrix)
        lens, mask = transform.lens(file, where, path), transform.mask(file, allow_outside)
        lenses.append(lens)
        short, split = "/".join(parts[i][shared:]), splits.get(names[i])
        frames.append(
            Frame.of_photo(short, path, lens, pose, background=background, split=split, mask=mask, photos=photos)
        )
    notes = {"poses": f"{file.name}, {len(frames)} images", **lens_notes(lenses, frames)}
    if splits:
        notes["split"] = _split_note(file, names, [names[i] for i in kept], splits)
    points = None
    if (name := listed.ply_file_path) is not None:
        cloud = read_points(inside(folder, name, file=file, allow_outside=allow_outside))
        none = torch.zeros(0, dtype=torch.long)
        points = SfmPoints(cloud.means, cloud.colors, none, none, f"{name}, {len(cloud):,} points without tracks")
    return Capture(folder.resolve().name, sorted_by_name(frames, file), points, background or (0.0, 0.0, 0.0), notes)


def _shared_folders(parts: Sequence[tuple[str, ...]]) -> int:
    """How many folders all of these paths share; names of frames are without them."""
    first, last = min(part[:-1] for part in parts), max(part[:-1] for part in parts)  # all share what these two share
    return len(list(takewhile(lambda pair: pair[0] == pair[1], zip(first, last, strict=False))))


def _photo(folder: Path, name: str, file: Path, allow_outside: bool) -> Path:
    """The photo of this name; instant-ngp omits the ending .png."""
    path = inside(folder, name, file=file, allow_outside=allow_outside)
    if name.lower().endswith(SUFFIXES) or path.is_file():
        return path
    return inside(folder, f"{name}.png", file=file, allow_outside=allow_outside)


def _splits(file: Path, listed: _Listed) -> dict[str, str]:
    splits: dict[str, str] = {}
    for key, split in _SPLITS.items():
        names = getattr(listed, key)
        both = sorted(name for name in names if splits.get(name, split) != split)
        if both:
            raise DataError(file, key, f"{both[0]!r} is for training, too", "list each photo once")
        splits |= dict.fromkeys(names, split)
    return splits


def _split_note(file: Path, names: Sequence[str], kept: Sequence[str], splits: Mapping[str, str]) -> str:
    """How many of the frames `kept` the file's own lists assign to each side. Frames in none of them are logged."""
    missing = sorted(set(splits) - set(names))
    if missing:
        raise DataError(file, "split", f"lists {missing[0]!r}, which is no frame's file_path", "correct the lists")
    counts = {side: sum(splits.get(name) == side for name in kept) for side in ("train", "test")}
    neither = len(kept) - sum(counts.values())
    if neither:
        message = "%s: %d frames are in none of its split lists and are not used; data.views.own_split=false uses them."
        _log.warning(message, file, neither)
    return f"the file's own: {counts['train']} train, {counts['test']} test, {neither} in neither"
