"""Photos without poses: COLMAP's structure-from-motion on the CPU, through pycolmap (extra: colmap)."""

from __future__ import annotations

import hashlib
import logging
import shutil
from pathlib import Path
from typing import Any, Final

from clear_strategies.data import colmap
from clear_strategies.data.cameras import by_name, make_frame
from clear_strategies.data.capture import Capture
from clear_strategies.data.photo_files import image_size, inside, list_images
from clear_strategies.data.upscale import cache_folder
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_FEWEST: Final = 3
_MORE: Final = "take more photos that overlap by two thirds, with the same camera and zoom, of a scene with texture"


def read(root: str | Path, cache: str | Path | None = None) -> Capture:
    """A folder of photos of one scene; poses are estimated once and kept.

    Args:
        cache: where poses are kept; None: ~/.cache/clear-strategies/sfm, or $CLEAR_CACHE/sfm. Never the photos' folder.

    Raises:
        DataError: too few photos, none can be related to each other, or pycolmap is not installed.
    """
    root = Path(root)
    paths = list_images(root)
    if len(paths) < _FEWEST:
        raise DataError(root, "images", f"there are {len(paths)}, poses need at least {_FEWEST}", _MORE)
    for path in paths:
        image_size(path)  # refuse what cannot be read before the long work
    folder = (Path(cache) if cache is not None else cache_folder() / "sfm") / _key(paths)
    if not (folder / "cameras.bin").is_file():
        _reconstruct(root, paths, folder)
    else:
        _log.info("poses of %s from the cache.", root)
    model = colmap.read_model(folder)
    frames = [
        make_frame(i.name, inside(root, i.name, file=folder), model.lenses[i.camera], colmap.pose_of(i), sfm_id=i.id)
        for i in model.images
    ]
    notes = {
        "poses": f"estimated by pycolmap from all {len(paths)} photos; {len(frames)} could be placed",
        "lens": "distortion removed by OpenCV",
    }
    return Capture(root.resolve().name, by_name(frames, folder), colmap.sfm_points(model), notes=notes)


def _reconstruct(root: Path, paths: list[Path], folder: Path) -> None:
    """Run SfM in a scratch folder beside the result, then move the largest model to its place."""
    pycolmap = _pycolmap()
    scratch = folder.with_name(f"{folder.name}.work")
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    database = scratch / "database.db"
    _log.info("estimating the poses of %d photos; this takes seconds to minutes a photo pair.", len(paths))
    try:
        names = [path.name for path in paths]
        pycolmap.extract_features(database, root, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE)
        pycolmap.match_exhaustive(database)
        models = pycolmap.incremental_mapping(database, root, scratch)
        best = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        placed = best.num_reg_images() if best is not None else 0
        if best is None or placed < _FEWEST:
            raise DataError(
                root, "poses", f"only {placed} of {len(paths)} photos could be related to each other", _MORE
            )
        result = scratch / "model"
        result.mkdir()
        best.write_binary(str(result))
        shutil.rmtree(folder, ignore_errors=True)
        result.rename(folder)
    except (RuntimeError, ValueError, OSError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(root, "poses", f"structure-from-motion failed ({error})", _MORE) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    _log.info("%d of %d photos could be placed.", placed, len(paths))


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise DataError(
            "data=photos", "pycolmap", f"cannot be imported ({error})", "pip install 'clear-strategies[colmap]'"
        ) from error
    return pycolmap


def _key(paths: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:24]
