"""Structure from motion on the CPU through pycolmap: a sparse model from photos alone, with bounded memory and progress.

COLMAP reads copies of the photos: upright JPEG files, no larger than needed. Photos of the same size and the same focal length in
EXIF share a camera, whose estimate starts at that focal length.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import signal
import sqlite3
import tempfile
import threading
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from PIL import Image as Picture

from clear_strategies import files
from clear_strategies.core.images import to_bytes
from clear_strategies.core.progress import EVERY, Progress
from clear_strategies.data.photo_files import Exif, read_image
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

FEWEST: Final = 3
MORE_PHOTOS: Final = (
    "take more photos that overlap by two thirds, with the same camera and zoom, of a scene with texture"
)
MODEL: Final = "cameras.bin"
"""The file of a model that exists only if the model is complete."""
UNPLACED: Final = "unplaced.json"
"""A file in the model's folder: for each photo without a pose, by the name of its copy, how it is related to the others."""
_DATABASE: Final = "database.db"
_PAIR: Final = 2147483647  # COLMAP's id of a pair of images is this times the first id, plus the second
_FEW_FEATURES: Final = 200  # a photo with fewer shows too little
_LISTED: Final = 3  # photos without a pose in the warning, at most
_MEGA: Final = 1 << 20
_DISTANCES: Final = 4  # bytes of each pair of features that are compared
_MEMORY: Final = 4 << 30  # bytes that all threads together may take in matching


@dataclass(frozen=True, slots=True)
class SfmSettings:
    """How poses are estimated: the arguments of `photos.read`, with `precise` decided."""

    max_side: int
    max_features: int
    precise: bool
    threads: int
    seed: int

    @property
    def matchers(self) -> int:
        """Threads that match at the same time: as many as fit into `_MEMORY`."""
        asked = self.threads if self.threads > 0 else os.cpu_count() or 1
        return max(1, min(asked, _MEMORY // self.memory))

    @property
    def memory(self) -> int:
        """Bytes that a thread takes to match two photos: every feature is compared with every other, once more if `precise`."""
        return (3 if self.precise else 2) * _DISTANCES * self.max_features**2


def reconstruct(root: Path, photos: Mapping[Path, Exif], folder: Path, settings: SfmSettings) -> None:
    """Estimate the poses of these photos, and write the model with most of them to `folder`. Its images have `copy_name`s.

    Raises:
        DataError: pycolmap is not installed, or too few photos can be placed.
    """
    pycolmap = _pycolmap()
    folder.parent.mkdir(parents=True, exist_ok=True)
    count = len(photos)
    _log.info(
        "%s: estimating the poses of %d photos: up to %d features each, %d pairs, about %d MB in matching.",
        root, count, settings.max_features, count * (count - 1) // 2, settings.matchers * settings.memory // _MEGA,
    )  # fmt: skip
    try:
        with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as work:
            models = _map(pycolmap, photos, Path(work), settings)
            models.sort(key=lambda model: model.num_reg_images(), reverse=True)
            sizes = [model.num_reg_images() for model in models]
            require_placed(root, sizes[0] if sizes else 0, count)
            result = Path(work) / "result"
            result.mkdir()
            models[0].write_binary(str(result))
            placed = {image.name for image in models[0].images.values()}
            files.write_json(result / UNPLACED, _unplaced(Path(work) / _DATABASE, placed))
            files.install(result, folder, MODEL)
    except RuntimeError as error:
        raise DataError(root, "poses", f"structure-from-motion failed ({error})", MORE_PHOTOS) from error
    if len(sizes) > 1:
        groups = ", ".join(map(str, sizes))
        _log.warning(
            "%s: the photos fall into groups that nothing connects (%s photos); the largest is used.", root, groups
        )


def copy_name(index: int) -> str:
    """The file name of the copy of photo `index`, which is its name in the model."""
    return f"{index:05d}.jpg"


def require_placed(root: Path, placed: int, count: int, least: float = 0.0) -> None:
    """Refuse poses of too few photos.

    Args:
        least: the least share of the photos.

    Raises:
        DataError: fewer than `FEWEST` of `count` photos are placed, or a smaller share.
    """
    if placed >= FEWEST and placed / count >= least:
        return
    remedy = MORE_PHOTOS
    if placed >= FEWEST:
        share = 1000 * placed // count / 1000  # rounded up, it would be refused again
        remedy += f"; or go on with the {placed}: data.reader.least_placed={share}"
    some = f"only {placed}" if placed else "none"
    raise DataError(root, "poses", f"{some} of the {count} photos could be related to each other", remedy)


def _map(pycolmap: Any, photos: Mapping[Path, Exif], work: Path, settings: SfmSettings) -> list[Any]:
    """The models that COLMAP's incremental pipeline finds: features, matching of all pairs, mapping."""
    copies, database, count = work / "copies", work / _DATABASE, len(photos)
    level = pycolmap.logging.minloglevel
    # COLMAP's progress is hundreds of lines, and its errors are raised.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        pycolmap.set_random_seed(settings.seed)
        groups = _write_copies(photos, copies, settings.max_side)
        extraction = pycolmap.FeatureExtractionOptions()
        extraction.num_threads, extraction.use_gpu = settings.threads, False
        extraction.sift.max_num_features = settings.max_features
        extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = settings.precise
        with _progress(database, "keypoints", "features", "photos", count):
            for (width, height, focal), names in groups.items():
                reader = pycolmap.ImageReaderOptions()
                if focal is not None:
                    reader.camera_params = f"{focal},{width / 2},{height / 2},0"  # of SIMPLE_RADIAL, its default
                pycolmap.extract_features(
                    database, copies, image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader, extraction_options=extraction, device=pycolmap.Device.cpu,
                )  # fmt: skip
        _keep_coarsest(database, settings.max_features)
        matching = pycolmap.FeatureMatchingOptions()
        matching.num_threads, matching.use_gpu = settings.matchers, False
        matching.guided_matching = settings.precise
        with _progress(database, "two_view_geometries", "matching", "pairs", count * (count - 1) // 2):
            pycolmap.match_exhaustive(database, matching_options=matching, device=pycolmap.Device.cpu)
        mapping = pycolmap.IncrementalPipelineOptions()
        mapping.num_threads, mapping.random_seed = settings.threads, settings.seed
        # COLMAP's thresholds are for hundreds of photos. Of ten photos around a table these place six where those place four.
        mapping.mapper.init_min_num_inliers, mapping.mapper.init_min_tri_angle = 50, 8.0
        mapping.mapper.abs_pose_min_num_inliers = 15
        # Most points of few photos are seen by two photos only. With these points those six poses are four times more exact.
        mapping.triangulation.ignore_two_view_tracks = False
        _log.debug("placing the photos.")
        # COLMAP may start again from another pair, so attempts are counted; the first call follows a pair.
        placed, progress = itertools.count(3), Progress("placing the photos", "photos", count)
        models = pycolmap.incremental_mapping(
            database, copies, work, options=mapping, next_image_callback=lambda: progress(next(placed))
        )
    finally:
        pycolmap.logging.minloglevel = level
    return list(models.values())


def _keep_coarsest(database: Path, most: int) -> None:
    """Leave each photo at most that many features, those of the coarsest scales, which COLMAP writes first.

    COLMAP's own limit counts points, and a point with several orientations is several features.
    """
    with contextlib.closing(sqlite3.connect(database)) as connection, connection:
        for table in ("keypoints", "descriptors"):
            connection.execute(
                f"UPDATE {table} SET data = substr(data, 1, :most * (length(data) / rows)), rows = :most "  # noqa: S608
                "WHERE rows > :most",
                {"most": most},
            )


def _write_copies(
    photos: Mapping[Path, Exif], folder: Path, max_side: int
) -> dict[tuple[int, int, float | None], list[str]]:
    """Copies for COLMAP; their names by width, height and focal length (pixels of the copy, or None)."""
    folder.mkdir()
    groups: dict[tuple[int, int, float | None], list[str]] = {}
    for i, (path, exif) in enumerate(photos.items()):
        image = read_image(path, turn=True)
        height, width = image.shape[:2]
        scale = min(1.0, max_side / max(width, height))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        copy = Picture.fromarray(to_bytes(image)).resize(size, Picture.Resampling.LANCZOS)
        copy.save(folder / copy_name(i), quality=95, subsampling=0)
        focal = exif.focal_pixels(*size)
        groups.setdefault((*size, focal and round(focal, 2)), []).append(copy_name(i))
    known = sum(len(names) for (_, _, focal), names in groups.items() if focal is not None)
    _log.debug("%d cameras; the focal length of %d of %d photos is in EXIF.", len(groups), known, len(photos))
    return groups


@contextlib.contextmanager
def _progress(database: Path, table: str, what: str, unit: str, total: int) -> Iterator[None]:
    """Log every few seconds how many rows a table of COLMAP's database has, because its calls return only at their end."""
    done, progress = threading.Event(), Progress(what, unit, total)

    def watch() -> None:
        while not done.wait(EVERY / 4):
            with (
                contextlib.suppress(sqlite3.Error),
                contextlib.closing(sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True)) as connection,
            ):
                rows = connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]  # noqa: S608
                progress(rows)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _pycolmap() -> Any:
    handler = signal.getsignal(signal.SIGTERM)
    try:
        import pycolmap
    except ImportError as error:
        raise DataError(
            "data=photos", "pycolmap", f"cannot be imported ({error})", "pip install 'clear-strategies[colmap]'"
        ) from error
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)  # the import sets one that prints a stack trace
    return pycolmap


def _unplaced(database: Path, placed: Set[str]) -> dict[str, dict[str, Any]]:
    """For each photo without a pose: its features, the most matches with any placed photo, and that photo's name."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        names = dict(connection.execute("SELECT image_id, name FROM images"))
        features = dict(connection.execute("SELECT image_id, rows FROM keypoints"))
        pairs = connection.execute("SELECT pair_id, rows FROM two_view_geometries").fetchall()
    unplaced = {
        name: {"features": features.get(i, 0), "matches": 0, "with": ""}
        for i, name in names.items()
        if name not in placed
    }
    for pair, matches in pairs:
        two = [names[i] for i in divmod(pair, _PAIR)]
        for name, other in (two, two[::-1]):
            if name in unplaced and other in placed and matches > unplaced[name]["matches"]:
                unplaced[name] |= {"matches": matches, "with": other}
    return unplaced


def why_unplaced(entry: Mapping[str, Any], names: Mapping[str, str]) -> str:
    """Why a photo has no pose.

    Args:
        entry: of the photo in `UNPLACED`.
        names: the photos' names, by those of their copies.
    """
    if entry["features"] < _FEW_FEATURES:
        return f"{entry['features']} features: blurred, dark, or without texture"
    if not entry["matches"]:
        return "shares nothing with the placed photos: overlap by two thirds"
    other = names[entry["with"]]
    return f"{entry['matches']} features in common with {other}, less with every other photo: more overlap"


def warn_unplaced(root: Path, unplaced: Mapping[str, str], count: int) -> None:
    """Log which of `count` photos have no pose, and why."""
    if unplaced:
        placed = count - len(unplaced)
        listed = "; ".join(f"{name} ({why})" for name, why in list(unplaced.items())[:_LISTED])
        more = f"; and {len(unplaced) - _LISTED} more" if len(unplaced) > _LISTED else ""
        message = "%s: %d of %d photos could be placed (%.0f%%). Without a pose: %s%s."
        _log.warning(message, root, placed, count, 100 * placed / count, listed, more)
