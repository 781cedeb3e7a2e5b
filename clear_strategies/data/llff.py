"""LLFF scenes: a folder with images, images_4 or images_8, poses_bounds.npy, and often COLMAP's sparse/0."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal

import numpy as np
from numpy.lib import format as npy_format

from clear_strategies.data import colmap
from clear_strategies.data.cameras import Lens, by_name, make_frame, rigid_inverse
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.photo_files import list_images
from clear_strategies.errors import DataError

_COLUMNS: Final = 17  # a 3 x 5 matrix [R | t | height width focal], then the near and far bounds
_REMEDY: Final = "write it with LLFF's img2poses again"


def read(
    root: str | Path, images: str | None = None, poses: Literal["auto", "colmap", "poses_bounds"] = "auto"
) -> Capture:
    """An LLFF scene.

    Args:
        images: folder of the photos below root; None: images, images_2, images_4, images_8, the first that is there.
        poses: "colmap" (sparse/0), "poses_bounds", or "auto": COLMAP's where they are.

    Raises:
        DataError: something is missing or not what it should be.
    """
    root = Path(root)
    if poses not in ("auto", "colmap", "poses_bounds"):
        raise DataError("config", "data.reader.poses", f"is {poses!r}", "use auto, colmap or poses_bounds")
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    folder = _image_folder(root, images)
    has_model = (root / "sparse").is_dir()
    if poses == "colmap" or (poses == "auto" and has_model):
        return _from_colmap(root, folder)
    frames = _from_bounds(root / "poses_bounds.npy", folder)
    points = None
    if has_model:
        points = colmap.sfm_points(colmap.read_model(colmap.find_model(root)))
        frames = [replace(f, sfm_id=i) for f, i in zip(frames, _model_ids(root, len(frames)), strict=True)]
    notes = {"poses": "poses_bounds.npy", "photos": folder.name}
    return Capture(root.resolve().name, by_name(frames, folder), points, notes=notes)


def _from_colmap(root: Path, folder: Path) -> Capture:
    model = colmap.read_model(colmap.find_model(root))
    registered = sorted(model.images, key=lambda image: image.name)
    paths = {p.name: p for p in list_images(folder)}
    notes = {"poses": f"COLMAP {model.folder.name}, {len(registered)} images", "photos": folder.name}
    if not all(image.name in paths for image in registered):
        # images_4 and the like were renamed by LLFF's scripts, in the order of the originals.
        if len(paths) != len(registered):
            raise DataError(
                folder, "images", f"holds {len(paths)} images, the model {len(registered)} under other names",
                "set data.reader.images to the folder that the model was made from",
            )  # fmt: skip
        notes["names"] = f"photos of {folder.name} matched to the model's by order"
        chosen = [paths[name] for name in sorted(paths)]
    else:
        chosen = [paths[image.name] for image in registered]
    frames = [
        make_frame(path.name, path, model.lenses[image.camera], colmap.pose_of(image), sfm_id=image.id)
        for image, path in zip(registered, chosen, strict=True)
    ]
    return Capture(root.resolve().name, by_name(frames, folder), colmap.sfm_points(model), notes=notes)


def _from_bounds(file: Path, folder: Path) -> list[Frame]:
    table = _read_table(file)
    paths = list_images(folder)
    if len(paths) != len(table):
        raise DataError(
            file,
            "rows",
            f"there are {len(table)}, but {folder.name} holds {len(paths)} images",
            "give one row an image",
        )
    frames = []
    for i, (row, path) in enumerate(zip(table, paths, strict=True)):
        pose = row[:15].reshape(3, 5)
        height, width, focal = pose[:, 4]
        down, right, back = pose[:, 0], pose[:, 1], pose[:, 2]  # LLFF's axes
        rotation = np.stack((right, down, -back), axis=1)
        lens = Lens(round(width), round(height), focal, focal, width / 2, height / 2).check(file, f"row {i}")
        frames.append(make_frame(path.name, path, lens, rigid_inverse(file, f"row {i}", rotation, pose[:, 3])))
    return frames


def _read_table(file: Path) -> np.ndarray:
    """[n, 17] float64; the header is held against the file's size before anything is allocated."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise DataError(file, "file", f"cannot be read ({error.strerror})", "check the path") from error
    stream = io.BytesIO(data)
    try:
        version = npy_format.read_magic(stream)
        reader = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}[version]
        shape, fortran, dtype = reader(stream)
    except (ValueError, KeyError, SyntaxError, TypeError, EOFError) as error:
        raise DataError(file, "header", f"is no .npy header ({str(error)[:80]})", _REMEDY) from error
    if dtype.kind != "f":
        raise DataError(file, "header", f"has the type {dtype}, not floating point", _REMEDY)
    if len(shape) != 2 or shape[1] != _COLUMNS or not 0 < shape[0] < 1 << 20:
        raise DataError(file, "header", f"has the shape {shape}, not (images, {_COLUMNS})", _REMEDY)
    needed, left = shape[0] * _COLUMNS * dtype.itemsize, len(data) - stream.tell()
    if needed != left:
        raise DataError(file, "size", f"the header asks for {needed} bytes, {left} follow it", _REMEDY)
    table = np.frombuffer(data, dtype, shape[0] * _COLUMNS, stream.tell())
    table = table.reshape(shape, order="F" if fortran else "C").astype(np.float64)
    if not np.isfinite(table).all() or np.abs(table).max() > 1e12:
        raise DataError(file, "values", "are not all finite", _REMEDY)
    return table


def _image_folder(root: Path, images: str | None) -> Path:
    if images is not None:
        return root / images
    for name in ("images", "images_2", "images_4", "images_8"):
        if (root / name).is_dir():
            return root / name
    raise DataError(root, "images", "there is no images, images_2, images_4 or images_8", "set data.reader.images")


def _model_ids(root: Path, n: int) -> list[int | None]:
    registered = sorted(colmap.read_model(colmap.find_model(root)).images, key=lambda image: image.name)
    return [image.id for image in registered] if len(registered) == n else [None] * n
