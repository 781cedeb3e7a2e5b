"""What estimated and refined poses share: features of photos and their matches, by pycolmap on the CPU, in a database, from
copies of the photos, with bounded memory; and bundle adjustment.

COLMAP reads copies of the photos: upright JPEG files, no larger than needed.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import itertools
import logging
import math
import mmap
import os
import shutil
import statistics
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from jaxtyping import Float
from PIL import Image as Picture
from torch import Tensor

from clear_strategies import files, signals
from clear_strategies.core.images import to_bytes
from clear_strategies.core.progress import Progress
from clear_strategies.data.capture import MORE_PHOTOS
from clear_strategies.errors import DataError, counted

_log = logging.getLogger(__name__)

PRECISE: Final = 30
"""Of up to this many photos, features follow a surface's tilt by default (`SfmSettings.precise`)."""
FEW: Final = 200
"""A photo with fewer features shows too little."""
DATABASE: Final = "database.db"
COPIES: Final = "copies"
_LARGE: Final = 1_200_000  # pixels of a copy, above which features are first found without enlarging it
_ENOUGH: Final = 0.25  # share of `max_features`, below which they are found again in enlarged copies
_PER_THREAD: Final = 2  # photos per thread whose features are found between two updates of the progress
_PER_FEATURE, _PER_DATABASE = 320, 8 << 20  # bytes that features, matches and models take on the disk, at most
_PER_WORKER: Final = 256 << 20  # bytes of address space for each thread of COLMAP's, and for COLMAP itself
_WORK: Final = "[0-9a-f]" * 24 + ".????????"
"""Folders of runs that estimate poses: the key in the cache, and tempfile's ending."""
_BLOCK: Final = 20  # photos per block of matching; COLMAP builds an index of their features for each block


class CopyCamera(NamedTuple):
    """The camera of copies, which share it: COLMAP's model and its parameters, pixels of the copy; `params` is empty if unknown.

    Args:
        lens: what tells cameras of equal parameters apart.
    """

    width: int
    height: int
    params: str = ""
    model: str = "SIMPLE_RADIAL"
    lens: tuple[str, ...] = ()


Groups = dict[CopyCamera, list[str]]
"""The names of the copies of each camera."""


@dataclass(frozen=True, slots=True)
class SfmSettings:
    """Settings of the estimation of poses: the arguments of `photos.read`, with `precise` resolved to a bool."""

    max_side: int = 1600
    max_features: int = 8192
    precise: bool = True
    threads: int = -1
    seed: int = 0


@contextlib.contextmanager
def workspace(
    root: Path, cache: Path, prefix: str, settings: SfmSettings, threads: str = ""
) -> Iterator[tuple[Any, Path]]:
    """Make a temporary folder in the cache, in which poses are estimated. Yields pycolmap and the folder.

    Args:
        prefix: 24 hexadecimal digits, by which the folder of a killed run is found.
        threads: the name of the setting by which users limit the threads; empty: there is none.

    Raises:
        DataError: pycolmap is not installed or fails, or memory is limited to too little.
    """
    pycolmap = import_pycolmap()
    _require_addresses(root, _threads(settings), threads)
    cache.mkdir(parents=True, exist_ok=True)
    _sweep(cache)
    level = pycolmap.logging.minloglevel
    # COLMAP's progress is hundreds of lines, and its errors are raised.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        with tempfile.TemporaryDirectory(prefix=f"{prefix}.", dir=cache) as folder, files.hold(Path(folder)):
            pycolmap.set_random_seed(settings.seed)
            yield pycolmap, Path(folder)
    except RuntimeError as error:
        raise DataError(root, "poses", f"structure-from-motion failed ({error})", MORE_PHOTOS) from error
    finally:
        pycolmap.logging.minloglevel = level


def find_and_match(pycolmap: Any, work: Path, groups: Groups, settings: SfmSettings, root: Path) -> Path:
    """Find features in the copies, and match and verify all pairs of copies; returns the database.

    Raises:
        OSError: the disk is too full for the features: COLMAP would end the process.
    """
    names = [name for names in groups.values() for name in names]
    if shutil.disk_usage(work).free < len(names) * settings.max_features * _PER_FEATURE + _PER_DATABASE:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(work.parent))
    database = work / DATABASE
    _extract(pycolmap, database, groups, settings, root)
    _match(pycolmap, database, names, settings.threads)
    return database


def adjust(pycolmap: Any, model: Any, options: Any) -> None:
    """Bundle adjustment of all placed photos. `pycolmap.bundle_adjustment` does the same, but switches COLMAP's log on."""
    variables = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        variables.add_image(number)
    variables.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, variables, model).solve()


def _sweep(cache: Path) -> None:
    """Remove the folders of killed runs, whose locks the system has freed."""
    for left in cache.glob(_WORK):
        try:
            with files.hold(left):
                pass
        except files.HeldError:
            continue
        shutil.rmtree(left, ignore_errors=True)
        _log.debug("%s: removed, a process died while it estimated poses here.", left)


def copy_name(index: int) -> str:
    """The file name of the copy of photo `index`, which is its name in the model."""
    return f"{index:05d}.jpg"


def _extract(pycolmap: Any, database: Path, groups: Groups, settings: SfmSettings, root: Path) -> None:
    """Find features and keep the coarsest; in enlarged copies, too, where photos are small or have few. Warns of few."""
    find = functools.partial(find_features, pycolmap, database, groups, settings)
    if min(camera.width * camera.height for camera in groups) <= _LARGE:
        found = find(octave=-1)
    elif (found := find(octave=0)) < _ENOUGH * settings.max_features:
        _log.info(
            "half of the photos have %d features or fewer: they are found again, in photos enlarged twice.", found
        )
        database.unlink()
        found = find(octave=-1)
    if found < FEW:
        why = "they are small, blurred, dark, or without texture"
        _log.warning("%s: half of the photos have %d features or fewer: %s.", root, found, why)
    keep_coarsest(pycolmap, database, settings.max_features)


def find_features(pycolmap: Any, database: Path, groups: Groups, settings: SfmSettings, *, octave: int) -> int:
    """Find the features of all copies; returns their median number per copy.

    Args:
        octave: of the finest scale: 0, that of the copies; -1, that of copies enlarged twice.
    """
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads, extraction.use_gpu = settings.threads, False
    extraction.sift.first_octave, extraction.sift.max_num_features = octave, settings.max_features
    extraction.sift.estimate_affine_shape = settings.precise
    count = sum(map(len, groups.values()))
    _log.info("features of %d photos.", count)
    progress = Progress("features", "photos", count)
    at_once = _PER_THREAD * _threads(settings)
    for camera, names in groups.items():
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = camera.model, camera.params
        for first in range(0, len(names), at_once):
            batch = names[first : first + at_once]
            pycolmap.extract_features(
                database, database.with_name(COPIES), image_names=batch, camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader, extraction_options=extraction, device=pycolmap.Device.cpu,
            )  # fmt: skip
            with pycolmap.Database.open(database) as opened:
                reader.existing_camera_id = opened.read_image_with_name(batch[0]).camera_id
                progress(opened.num_images())
    with pycolmap.Database.open(database) as opened:
        return int(statistics.median(opened.num_keypoints_for_image(i.image_id) for i in opened.read_all_images()))


def _match(pycolmap: Any, database: Path, copies: Sequence[str], threads: int) -> None:
    """Match and verify all pairs of copies, block by block."""
    options, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    options.num_threads, options.use_gpu = threads, False
    pairing.match_list_path = database.with_name("pairs.txt")
    blocks = [copies[first : first + _BLOCK] for first in range(0, len(copies), _BLOCK)]
    total, done = math.comb(len(copies), 2), 0
    _log.info("matching %s of photos.", counted(total, "pair"))
    progress = Progress("matching", "pairs of photos", total)
    for one, other in itertools.combinations_with_replacement(blocks, 2):
        pairs = list(itertools.combinations(one, 2) if one is other else itertools.product(one, other))
        pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8", newline="\n")
        pycolmap.match_image_pairs(
            database, matching_options=options, pairing_options=pairing, device=pycolmap.Device.cpu
        )
        done += len(pairs)
        progress(done)


def keep_coarsest(pycolmap: Any, database: Path, most: int) -> None:
    """Keep at most `most` features of each photo: those of the coarsest scales, which COLMAP writes first.

    COLMAP's own limit is soft: of photos of 12 megapixels it left 21,609 features for 8192, and the time of matching grows with
    their square.
    """
    kind = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        kept = {
            image.image_id: (
                opened.read_keypoints(image.image_id)[:most].copy(),
                opened.read_descriptors(image.image_id).data[:most].copy(),
            )
            for image in opened.read_all_images()
        }
        opened.clear_keypoints()
        opened.clear_descriptors()
        for number, (keypoints, descriptors) in kept.items():
            opened.write_keypoints(number, keypoints)
            opened.write_descriptors(number, pycolmap.FeatureDescriptors(kind, descriptors))


def write_copy(image: Float[Tensor, "H W 3"], file: Path, max_side: int) -> tuple[int, int]:
    """Write a copy for COLMAP, no larger than `max_side`; returns its width and height."""
    height, width = image.shape[:2]
    scale = min(1.0, max_side / max(width, height))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    Picture.fromarray(to_bytes(image)).resize(size, Picture.Resampling.LANCZOS).save(file, quality=95, subsampling=0)
    return size


def _threads(settings: SfmSettings) -> int:
    return settings.threads if settings.threads > 0 else os.cpu_count() or 1


def _require_addresses(root: Path, threads: int, setting: str) -> None:
    """Raise a DataError if the system limits memory to less than COLMAP takes: its libraries would abort, or wait for ever."""
    try:
        if sys.platform != "win32":  # Windows has no such limit
            mmap.mmap(-1, (threads + 1) * _PER_WORKER, flags=mmap.MAP_PRIVATE, prot=0).close()
    except OSError as error:
        needed = (
            f"COLMAP takes up to {(threads + 1) * _PER_WORKER >> 20} MB of addresses with {counted(threads, 'thread')}"
        )
        remedy = "raise `ulimit -v`" + f", or set {setting}=1" * (threads > 1 and setting != "")
        raise DataError(root, "memory", f"{needed}, and the system leaves this process less", remedy) from error


def import_pycolmap() -> Any:
    try:
        # The import sets a handler of SIGTERM that prints a stack trace, and turns an exception into an ImportError, or drops it.
        with signals.held():
            import pycolmap
    except (ImportError, RuntimeError) as error:  # its own, where a library of the system is missing
        remedy = "pip install 'clear-strategies[colmap]'; PyPI has none for Linux on arm64, there give poses of another program"
        raise DataError("poses", "pycolmap", f"cannot be imported ({error})", remedy) from error
    return pycolmap
