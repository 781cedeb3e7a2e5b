"""Photos without poses: COLMAP's structure-from-motion on the CPU, through pycolmap (extra: colmap)."""

from __future__ import annotations

import hashlib
import logging
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from clear_strategies.data.capture import Capture
from clear_strategies.data.checks import require_whole
from clear_strategies.data.photo_files import image_size, inside, list_images
from clear_strategies.data.priors import cache_folder
from clear_strategies.data.readers import colmap
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

_FEWEST: Final = 3
_MORE: Final = "take more photos that overlap by two thirds, with the same camera and zoom, of a scene with texture"


def read(
    root: str | Path, cache: str | Path | None = None, *, max_side: int = 3200, threads: int = -1, seed: int = 0
) -> Capture:
    """Read a folder of photos of one scene. Poses are estimated from all of them and kept in a cache.

    Args:
        cache: folder of the poses; None: ~/.cache/clear-strategies/sfm, or $CLEAR_CACHE/sfm. Not in the photos' folder.
        max_side: features are extracted from photos reduced to this many pixels.
        threads: of COLMAP; -1: all. With more than one, the poses' last digits may change from run to run.
        seed: of COLMAP's random samples.

    Raises:
        SettingError: a number is outside its range.
        DataError: too few photos, none can be related to each other, or pycolmap is not installed.
    """
    require_whole("data.reader.max_side", max_side, least=1)
    require_whole("data.reader.threads", threads, least=-1)
    require_whole("data.reader.seed", seed, least=0)
    root = Path(root)
    paths = list_images(root)
    if len(paths) < _FEWEST:
        raise DataError(root, "images", f"there are {len(paths)}, poses need at least {_FEWEST}", _MORE)
    sizes = [image_size(inside(root, path.name, file=root)) for path in paths]  # refuses bad ones before the long work
    base = Path(cache) if cache is not None else cache_folder() / "sfm"
    if base.resolve().is_relative_to(root.resolve()):
        raise DataError(root, "cache", f"{base} lies among the photos", "set data.reader.cache to a folder elsewhere")
    folder = base / _key(paths, max_side, seed)
    if (folder / "cameras.bin").is_file():
        _log.info("%s: poses from the cache %s.", root, folder)
    else:
        _reconstruct(
            root, paths, folder, same_camera=len(set(sizes)) == 1, max_side=max_side, threads=threads, seed=seed
        )
    model = colmap.read_model(folder)
    found = colmap.capture(root, model, root, {image.name: root / image.name for image in model.images})
    notes = {
        **found.notes,
        "poses": f"estimated by pycolmap from all {len(paths)} photos, {len(found.frames)} could be placed",
        "photos": root.name,
    }
    label = "estimated here by pycolmap"
    return replace(found, points=colmap.sfm_points(model, label), notes=notes)


def _reconstruct(
    root: Path, paths: list[Path], folder: Path, *, same_camera: bool, max_side: int, threads: int, seed: int
) -> None:
    """Run SfM in a temporary folder beside the result, then move the largest model there."""
    pycolmap = _pycolmap()
    folder.parent.mkdir(parents=True, exist_ok=True)
    _log.info(
        "%s: estimating the poses of %d photos. This takes seconds to minutes per pair of photos.", root, len(paths)
    )
    try:
        with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as work:
            best = _map(pycolmap, root, paths, Path(work), same_camera, max_side, threads, seed)
            placed = best.num_reg_images() if best is not None else 0
            if placed < _FEWEST:
                raise DataError(
                    root, "poses", f"only {placed} of {len(paths)} photos could be related to each other", _MORE
                )
            result = Path(work) / "result"
            result.mkdir()
            best.write_binary(str(result))
            result.rename(folder)
    except (RuntimeError, OSError) as error:
        raise DataError(root, "poses", f"structure-from-motion failed ({error})", _MORE) from error
    _log.info("%s: %d of %d photos could be placed.", root, placed, len(paths))


def _map(
    pycolmap: Any, root: Path, paths: list[Path], work: Path, same_camera: bool, max_side: int, threads: int, seed: int
) -> Any:
    """COLMAP's incremental pipeline: features, all pairs, mapping. The model with the most photos, or None."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value  # its progress is hundreds of lines
    try:
        pycolmap.set_random_seed(seed)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.max_image_size, extraction.num_threads, extraction.use_gpu = max_side, threads, False
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads, matching.use_gpu = threads, False
        mapping = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads, mapping.random_seed = threads, seed
        database = work / "database.db"
        mode = pycolmap.CameraMode.SINGLE if same_camera else pycolmap.CameraMode.AUTO
        names = [path.name for path in paths]
        pycolmap.extract_features(
            database, root, image_names=names, camera_mode=mode, extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )  # fmt: skip
        pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        models = pycolmap.incremental_mapping(database, root, work, options=mapping)
    finally:
        pycolmap.logging.minloglevel = level
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError as error:
        raise DataError(
            "data=photos", "pycolmap", f"cannot be imported ({error})", "pip install 'clear-strategies[colmap]'"
        ) from error
    return pycolmap


def _key(paths: list[Path], *settings: int) -> str:
    digest = hashlib.sha256(repr(settings).encode())
    for path in paths:
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:24]
