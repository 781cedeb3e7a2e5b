"""COLMAP's sparse models, binary and text, read strictly: every number must be finite and every id known."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.cameras import Lens
from clear_strategies.data.readers import colmap_binary, colmap_text
from clear_strategies.data.readers.colmap_records import Image, Points, checked_points, damaged
from clear_strategies.errors import DataError
from rasterizers.geometry import rotation_matrix

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """The content of a sparse model's files, whose `ending` is .bin or .txt."""

    folder: Path
    ending: str
    lenses: dict[int, Lens]
    images: list[Image]
    points: Points


def find_model(root: Path) -> Path:
    """The folder of the sparse model; of the several that COLMAP's mapper may leave in `sparse`, the one with most photos.

    Raises:
        DataError: there is none, or one of several cannot be read.
    """
    if not root.is_dir():
        raise DataError(root, "folder", "is not there", "set data.path to the scene's folder")
    for candidate in (root / "sparse" / "0", root / "sparse", root / "colmap" / "sparse" / "0", root):
        if _is_model(candidate):
            numbered = sorted(candidate.parent.glob("[1-9]*")) if candidate.name == "0" else []
            return _largest(root, [candidate, *filter(_is_model, numbered)])
    raise DataError(
        root, "sparse model", "no cameras.bin or cameras.txt in sparse/0, sparse, colmap/sparse/0 or here",
        "run COLMAP first, or use data=photos for photos without poses",
    )  # fmt: skip


def _largest(root: Path, models: Sequence[Path]) -> Path:
    if len(models) == 1:
        return models[0]
    photos = {}
    for model in models:
        ending, files = _format(model)
        photos[model] = len(files.images(model / f"images{ending}"))
    largest = max(models, key=lambda model: photos[model])
    others = ", ".join(f"{model.name} with {photos[model]}" for model in models if model != largest)
    _log.warning(
        "%s: COLMAP left %d models. The largest, %s with %d photos, is used; the others are not: %s.",
        root, len(models), largest.name, photos[largest], others,
    )  # fmt: skip
    return largest


def _format(folder: Path) -> tuple[str, ModuleType]:
    """The ending of a model's files, and what reads them. If there is any binary file, text files are ignored."""
    binary = any((folder / f"{name}.bin").exists() for name in ("cameras", "images", "points3D"))
    return (".bin", colmap_binary) if binary else (".txt", colmap_text)


def read_model(folder: Path) -> Model:
    """Cameras, images and points of a model folder.

    Raises:
        DataError: a file is missing or not what it should be.
    """
    ending, files = _format(folder)
    lenses = files.cameras(folder / f"cameras{ending}")
    registered = files.images(folder / f"images{ending}")
    if not registered:
        raise DataError(folder / f"images{ending}", "images", "there is none", "run COLMAP's mapper to its end")
    for image in registered:
        if image.camera not in lenses:
            raise damaged(folder / f"images{ending}", image.name, f"has the unknown camera {image.camera}")
    file = folder / f"points3D{ending}"
    if not file.exists():
        _log.debug("%s has no %s: the capture has no points.", folder, file.name)
        points = checked_points(file, set(), [], [], [])
    else:
        points = files.points(file)
        unknown = np.setdiff1d(points.track[:, 1], [image.id for image in registered])
        if len(unknown):
            raise damaged(file, "track", f"names the unknown image {unknown[0]}")
    return Model(folder, ending, lenses, registered, points)


def pose_of(image: Image) -> Float[Tensor, "4 4"]:
    """World-to-camera."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = rotation_matrix(torch.tensor([image.quat], dtype=torch.float64))[0]
    pose[:3, 3] = torch.tensor(image.translation, dtype=torch.float64)
    return pose


def _is_model(folder: Path) -> bool:
    return any((folder / f"{name}{ending}").is_file() for name in ("cameras", "images") for ending in (".bin", ".txt"))
