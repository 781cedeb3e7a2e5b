"""LLFF scenes: a folder with images, images_4 or images_8, poses_bounds.npy, and often COLMAP's sparse/0."""

from __future__ import annotations

import io
import logging
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Float

from clear_strategies.core.checks import as_color, require_choice
from clear_strategies.data.capture import BLACK, Capture, Frame, lens_notes, sorted_by_name
from clear_strategies.data.lenses import Lens, rigid_inverse
from clear_strategies.data.photo_folders import folder_note, image_folder, list_images, usable
from clear_strategies.data.readers import colmap
from clear_strategies.data.readers.colmap_model import Model, find_model, read_model
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_COLUMNS: Final = 17
_REMEDY: Final = "write it with LLFF's img2poses again"


def recognises(path: Path) -> int:
    """The rank of `clear_strategies.commands.train.detect`."""
    return 3 * (path / "poses_bounds.npy").is_file()


def read(
    root: str | Path,
    images: str | None = None,
    poses: str = "auto",
    *,
    background: Color = BLACK,
    skip_faulty: bool = False,
) -> Capture:
    """Read an LLFF scene folder.

    Args:
        images: folder of the photos below root; None: the first that exists of images, images_2, images_4, images_8.
        poses: "colmap" (sparse/0), "poses_bounds", or "auto": COLMAP's if it has a model.
        background: RGB in [0, 1] behind transparent pixels.
        skip_faulty: leave out photos that are missing or damaged, with a warning for each; else they are an error.

    Raises:
        SettingError: `poses` or the background is none of these.
        DataError: something is missing or not what it should be.
    """
    root, background = Path(root), as_color("data.reader.background", background)
    require_choice("data.reader.poses", poses, ("auto", "colmap", "poses_bounds"))
    folder = image_folder(root, images)
    has_model = any((root / layout).is_dir() for layout in ("sparse", "colmap/sparse"))
    if poses == "colmap" or (poses == "auto" and has_model):
        return _from_colmap(root, folder, background, skip_faulty)
    return _from_bounds(root, folder, has_model, background, skip_faulty)


def _from_colmap(root: Path, folder: Path, background: Color, skip_faulty: bool) -> Capture:
    model = read_model(find_model(root))
    registered = sorted(image.name for image in model.images)
    files = {path.name: path for path in list_images(folder)}
    if any(name in files for name in registered):
        paths = {name: files.get(name, folder / name) for name in registered}
        return colmap.capture(root, model, folder, paths, background=background, skip_faulty=skip_faulty)
    # LLFF's scripts rename the photos of images_4 and the like, in the order of the originals.
    if len(files) != len(registered):
        raise DataError(
            folder, "images", f"holds {len(files)} images, the model {len(registered)} under other names",
            "set data.reader.images to the folder that the model was made from",
        )  # fmt: skip
    ordered = dict(zip(registered, (files[name] for name in sorted(files)), strict=True))
    capture = colmap.capture(root, model, folder, ordered, background=background, skip_faulty=skip_faulty)
    first = f"{registered[0]} is {ordered[registered[0]].name}"
    return replace(capture, notes={**capture.notes, "names": f"photos matched to the model's by order ({first})"})


def _from_bounds(root: Path, folder: Path, has_model: bool, background: Color, skip_faulty: bool) -> Capture:
    file = root / "poses_bounds.npy"
    table = read_bounds(file)
    paths = list_images(folder)
    if len(paths) != len(table):
        problem = f"there are {len(table)}, but {folder.name} holds {len(paths)} images"
        raise DataError(file, "rows", problem, "give one row an image")
    model = read_model(find_model(root)) if has_model else None
    ids = _ids_by_order(model, len(paths))
    frames = []
    for i in usable(folder, range(len(paths)), lambda i: paths[i], skip_faulty=skip_faulty):
        row, path = table[i], paths[i]
        pose = row[:15].reshape(3, 5)
        height, width, focal = pose[:, 4]
        down, right, back = pose[:, 0], pose[:, 1], pose[:, 2]  # LLFF's axes
        rotation = np.stack((right, down, -back), axis=1)
        lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2).check(file, f"row {i}")
        world_to_camera = rigid_inverse(file, f"row {i}", rotation, pose[:, 3])
        frames.append(Frame.of_photo(path.name, path, lens, world_to_camera, background=background, sfm_id=ids[i]))
    near, far = table[:, 15].min(), table[:, 16].max()
    if not 0 < near < far:
        raise DataError(file, "bounds", f"are {near:g} and {far:g}; 0 < near < far must hold", _REMEDY)
    notes = {
        "poses": f"poses_bounds.npy, {len(frames)} images",
        "photos": folder_note(folder),
        "depths": f"{near:.4g} to {far:.4g} world units, from poses_bounds.npy",
        **lens_notes(frames),
    }
    points = None
    if model is not None and ids[0] is not None:  # LLFF's poses are in the coordinates of this model
        points = colmap.sfm_points(model, model.folder.relative_to(root).as_posix())
    return Capture(root.resolve().name, sorted_by_name(frames, folder), points, background, notes)


def _ids_by_order(model: Model | None, n: int) -> list[int | None]:
    """The model's ids of the n photos, matched in order of names."""
    if model is None:
        return [None] * n
    registered = sorted(model.images, key=lambda image: image.name)
    if len(registered) != n:
        _log.debug("%s has %d of %d photos: its points are not used.", model.folder, len(registered), n)
        return [None] * n
    return [image.id for image in registered]


def read_bounds(file: Path) -> Float[np.ndarray, "N 17"]:
    """poses_bounds.npy: per image a 3 x 5 matrix [R | t | height width focal], then the near and far bounds.

    Raises:
        DataError: the file is no such table of finite numbers.
    """
    stream = io.BytesIO(read_bytes(file))
    try:
        table = np.load(stream)  # no pickle, by numpy's default
    except Exception as error:  # numpy's parser raises many types of error on damaged files
        raise DataError(file, "table", f"is no .npy of numbers ({str(error)[:80]})", _REMEDY) from error
    if stream.read(1):
        raise DataError(file, "size", "bytes follow the table", _REMEDY)
    if not isinstance(table, np.ndarray) or table.dtype.kind != "f":
        raise DataError(file, "table", "is not one of floating-point numbers", _REMEDY)
    if table.ndim != 2 or table.shape[1] != _COLUMNS or len(table) == 0:
        raise DataError(file, "table", f"has the shape {table.shape}, not (images, {_COLUMNS})", _REMEDY)
    table = table.astype(np.float64)
    if not np.isfinite(table).all() or np.abs(table).max() > 1e12:
        raise DataError(file, "values", "are not all finite", _REMEDY)
    return table
