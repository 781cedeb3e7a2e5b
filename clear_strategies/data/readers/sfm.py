"""Structure from motion on the CPU through pycolmap: a sparse model from photos alone, with bounded memory.

COLMAP reads copies of the photos: upright JPEG files, no larger than needed. Photos of the same size and lens (by EXIF) share a
camera, whose estimate starts at EXIF's focal length. If photos are left without a pose, all are placed again without that focal
length, since programs and adapters write wrong ones, and the model with more photos is used.
"""

from __future__ import annotations

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
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from PIL import Image as Picture

from clear_strategies import files, signals
from clear_strategies.core.images import to_bytes
from clear_strategies.core.progress import Progress
from clear_strategies.data.capture import MORE_PHOTOS, NO_PARALLAX, STEP_ASIDE
from clear_strategies.data.file_names import some
from clear_strategies.data.photo_files import Header, read_image
from clear_strategies.errors import DataError, counted

_log = logging.getLogger(__name__)

FEWEST: Final = 3
MODEL: Final = "cameras.bin"
"""The file of a model that exists only if the model is complete."""
UNPLACED: Final = "unplaced.json"
"""A file in the model's folder: why the pose is unknown, for each photo without one, by its name."""
_DATABASE: Final = "database.db"
_COPIES: Final = "copies"
_WORK: Final = "[0-9a-f]" * 24 + ".????????"
"""Folders of runs that estimate poses: the key in the cache, and tempfile's ending."""
_FEW_FEATURES: Final = 200  # a photo with fewer shows too little
_MATCHED: Final = 50  # inlier matches, from which a pair's two-view geometry is trusted
_NEARLY_ALL: Final = 0.9  # of the pairs
_ROTATION: Final = 0.03  # largest entry of HᵀH - I, up to which a homography H is a rotation with lens distortion
_LISTED: Final = 3  # photos without a pose in the warning, at most
_UNKNOWN: Final = 1.2  # focal length in longer sides of the photo: COLMAP's default guess
_DIAGONAL_35MM: Final = math.hypot(36, 24)  # mm
_LARGE: Final = 1_200_000  # pixels of a copy, above which features are first found without enlarging it
_ENOUGH: Final = 0.25  # share of `max_features`, below which they are found again in enlarged copies
_PER_THREAD: Final = 2  # photos per thread whose features are found between two updates of the progress
_PER_FEATURE, _PER_DATABASE = 320, 8 << 20  # bytes that features, matches and models take on the disk, at most
_PER_WORKER: Final = 256 << 20  # bytes of address space for each thread of COLMAP's, and for COLMAP itself
_BLOCK: Final = 20  # photos per block of matching; COLMAP builds an index of their features for each block

_Groups = dict[tuple[int, int, float | None, tuple[str, ...]], list[str]]
"""The names of copies by width, height, focal length (pixels of the copy, or None) and lens: those of one camera."""


@dataclass(frozen=True, slots=True)
class SfmSettings:
    """Settings of the estimation of poses: the arguments of `photos.read`, with `precise` resolved to a bool."""

    max_side: int
    max_features: int
    precise: bool
    threads: int
    seed: int


def reconstruct(root: Path, photos: Mapping[Path, Header], folder: Path, settings: SfmSettings) -> None:
    """Estimate the poses of these photos, and write the largest model to `folder`, with images named by `copy_name`.

    Args:
        photos: their paths and headers.

    Raises:
        DataError: pycolmap is not installed, memory is limited to too little, or too few photos can be placed.
    """
    pycolmap = _pycolmap()
    _require_addresses(root, _threads(settings))
    folder.parent.mkdir(parents=True, exist_ok=True)
    _sweep(folder.parent)
    count = len(photos)
    _log.info("%s: estimating the poses of %d photos, up to %d features each.", root, count, settings.max_features)
    try:
        with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as work, files.hold(Path(work)):
            models = sorted(
                _models(pycolmap, photos, Path(work), settings), key=lambda m: m.num_reg_images(), reverse=True
            )
            require_placed(root, _most_placed(models), count)
            (result := Path(work) / "result").mkdir()
            models[0].write_binary(str(result))
            placed = [{image.name for image in model.images.values()} for model in models]  # a photo may be in several
            names = [path.name for path in photos]
            files.write_json(result / UNPLACED, _unplaced(pycolmap, Path(work) / _DATABASE, names, placed[0]))
            files.install(result, folder, MODEL)
    except RuntimeError as error:
        raise DataError(root, "poses", f"structure-from-motion failed ({error})", MORE_PHOTOS) from error
    groups = [len(group.difference(*placed[:i])) for i, group in enumerate(placed)]
    if any(groups[1:]):
        told = ", ".join(str(count) for count in groups if count)
        _log.warning(
            "%s: the photos fall into groups that nothing connects (%s photos); the largest is used.", root, told
        )


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


def require_placed(root: Path, placed: int, count: int, least: float = 0.0) -> None:
    """Raise a DataError where fewer than `FEWEST` of `count` photos are placed, or a smaller share than `least`."""
    if placed >= FEWEST and placed / count >= least:
        return
    remedy = MORE_PHOTOS
    if placed >= FEWEST:
        share = 1000 * placed // count / 1000  # rounded up, it would be refused again
        remedy += f"; or go on with the {placed}: data.reader.least_placed={share}"
    few = f"only {placed}" if placed else "none"
    raise DataError(root, "poses", f"{few} of the {count} photos could be related to each other", remedy)


def _models(pycolmap: Any, photos: Mapping[Path, Header], work: Path, settings: SfmSettings) -> list[Any]:
    """Run COLMAP's incremental pipeline: extract features, match all pairs, and map; returns the models. If photos are left over,
    those mapped without EXIF's focal lengths are returned where they place more photos.
    """
    database, root = work / _DATABASE, next(iter(photos)).parent
    level = pycolmap.logging.minloglevel
    # COLMAP's progress is hundreds of lines, and its errors are raised.
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    try:
        pycolmap.set_random_seed(settings.seed)
        groups = _write_copies(photos, work / _COPIES, settings.max_side)
        if shutil.disk_usage(work).free < len(photos) * settings.max_features * _PER_FEATURE + _PER_DATABASE:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(work.parent))  # COLMAP would end the process
        _extract_features(pycolmap, database, groups, settings, root)
        _match(pycolmap, database, [name for names in groups.values() for name in names], settings.threads)
        _require_parallax(pycolmap, database, root)
        models, count = _mapped(pycolmap, work, len(photos), settings), len(photos)
        lengths = sorted({said.focal_35mm for said in photos.values() if said.focal_35mm is not None})
        if (placed := _most_placed(models)) < count and lengths:
            _log.info("%d of %d photos are placed: again, without EXIF's focal length.", placed, count)
            _forget_focal_lengths(pycolmap, database, settings.threads)
            free = _mapped(pycolmap, work, count, settings)
            if (more := _most_placed(free)) > placed:
                models, told = free, some([f"{focal:g} mm" for focal in lengths])
                message = "%s: EXIF's focal length (%s on 35 mm film) is not used: %d of %d photos are placed with it, %d without"
                _log.warning(message, root, told, placed, count, more)
    finally:
        pycolmap.logging.minloglevel = level
    return models


def _extract_features(pycolmap: Any, database: Path, groups: _Groups, settings: SfmSettings, root: Path) -> None:
    """Find features and keep the coarsest; in enlarged copies, too, where photos are small or have few. Warns of few."""
    find = functools.partial(_find_features, pycolmap, database, groups, settings)
    if min(width * height for width, height, *_ in groups) <= _LARGE:
        found = find(octave=-1)
    elif (found := find(octave=0)) < _ENOUGH * settings.max_features:
        _log.info(
            "half of the photos have %d features or fewer: they are found again, in photos enlarged twice.", found
        )
        database.unlink()
        found = find(octave=-1)
    if found < _FEW_FEATURES:
        why = "they are small, blurred, dark, or without texture"
        _log.warning("%s: half of the photos have %d features or fewer: %s.", root, found, why)
    _keep_coarsest(pycolmap, database, settings.max_features)


def _mapped(pycolmap: Any, work: Path, count: int, settings: SfmSettings) -> list[Any]:
    """Run COLMAP's mapper on the verified pairs; returns the models."""
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = settings.threads, settings.seed
    # COLMAP's thresholds are for hundreds of photos: they place four of ten photos around a table, these place six.
    mapping.mapper.init_min_num_inliers, mapping.mapper.init_min_tri_angle = 50, 8.0
    mapping.mapper.abs_pose_min_num_inliers = 15
    # With few photos most points are seen by two only. These points make the six poses four times more exact.
    mapping.triangulation.ignore_two_view_tracks = False
    _log.info("placing the photos.")
    progress, placed = Progress("placing", "photos", count), itertools.count(3)  # after the first two
    models = pycolmap.incremental_mapping(
        work / _DATABASE, work / _COPIES, work, options=mapping, next_image_callback=lambda: progress(next(placed))
    )
    return list(models.values())


def _most_placed(models: Sequence[Any]) -> int:
    """The number of photos in the largest model."""
    return max((model.num_reg_images() for model in models), default=0)


def _forget_focal_lengths(pycolmap: Any, database: Path, threads: int) -> None:
    """Reset the cameras' focal lengths to unknown, and verify the matched pairs again."""
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            size = camera.width, camera.height
            unknown = pycolmap.Camera.create_from_model_id(camera.camera_id, camera.model, _UNKNOWN * max(size), *size)
            opened.update_camera(unknown)
        opened.clear_two_view_geometries()
    options = pycolmap.GeometricVerifierOptions()
    options.num_threads = threads
    pycolmap.geometric_verification(database, options)


def _find_features(pycolmap: Any, database: Path, groups: _Groups, settings: SfmSettings, *, octave: int) -> int:
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
    for (width, height, focal, _), names in groups.items():
        reader = pycolmap.ImageReaderOptions()
        if focal is not None:
            reader.camera_params = f"{focal},{width / 2},{height / 2},0"  # of SIMPLE_RADIAL, its default
        for first in range(0, len(names), at_once):
            batch = names[first : first + at_once]
            pycolmap.extract_features(
                database, database.with_name(_COPIES), image_names=batch, camera_mode=pycolmap.CameraMode.SINGLE,
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


def _require_parallax(pycolmap: Any, database: Path, root: Path) -> None:
    """Raise a DataError if the photos differ only by rotations, for some focal length: COLMAP would invent motion."""
    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = {int(kind) for kind in (kinds.PLANAR, kinds.PANORAMIC, kinds.PLANAR_OR_PANORAMIC)}
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        of_image = {image.image_id: cameras[image.camera_id] for image in opened.read_all_images()}
        pairs = [
            (*map(of_image.get, pycolmap.pair_id_to_image_pair(pair)), found)
            for pair, found in zip(*opened.read_two_view_geometries(), strict=True)
            if len(found.inlier_matches) >= _MATCHED
        ]

    def centred(camera: Any) -> Float[np.ndarray, "3 3"]:
        """The matrix from pixels to coordinates around the middle of the photo, in longer sides."""
        width, height = int(camera.width), int(camera.height)
        size = max(width, height)
        return np.array([[1, 0, -width / 2], [0, 1, -height / 2], [0, 0, size]]) / size

    maps = [centred(b) @ found.H @ np.linalg.inv(centred(a)) for a, b, found in pairs if int(found.config) in flat]
    if len(maps) < _NEARLY_ALL * len(pairs) or not maps:
        return
    homographies = np.stack([H / np.cbrt(np.linalg.det(H)) for H in maps])

    def distance_from_rotations(focal: float) -> float:
        """The median over pairs of the largest entry of |RᵀR - I| with R = K⁻¹ H K."""
        R = homographies * np.array([1 / focal, 1 / focal, 1])[:, None] * np.array([focal, focal, 1])
        return float(np.median(np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))))

    if min(map(distance_from_rotations, np.geomspace(0.3, 5.0, 60))) < _ROTATION:
        raise DataError(root, "poses", NO_PARALLAX, STEP_ASIDE)


def _keep_coarsest(pycolmap: Any, database: Path, most: int) -> None:
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


def _write_copies(photos: Mapping[Path, Header], folder: Path, max_side: int) -> _Groups:
    """Write copies for COLMAP, no larger than `max_side`."""
    folder.mkdir()
    groups: _Groups = {}
    for i, (path, header) in enumerate(photos.items()):
        image = read_image(path, turn=True)
        height, width = image.shape[:2]
        scale = min(1.0, max_side / max(width, height))
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        copy = Picture.fromarray(to_bytes(image)).resize(size, Picture.Resampling.LANCZOS)
        copy.save(folder / copy_name(i), quality=95, subsampling=0)
        focal = header.focal_35mm and round(header.focal_35mm / _DIAGONAL_35MM * math.hypot(*size), 2)
        groups.setdefault((*size, focal, header.lens), []).append(copy_name(i))
    return groups


def _threads(settings: SfmSettings) -> int:
    return settings.threads if settings.threads > 0 else os.cpu_count() or 1


def _require_addresses(root: Path, threads: int) -> None:
    """Raise a DataError if the system limits memory to less than COLMAP takes: its libraries would abort, or wait for ever."""
    try:
        if sys.platform != "win32":  # Windows has no such limit
            mmap.mmap(-1, (threads + 1) * _PER_WORKER, flags=mmap.MAP_PRIVATE, prot=0).close()
    except OSError as error:
        needed = (
            f"COLMAP takes up to {(threads + 1) * _PER_WORKER >> 20} MB of addresses with {counted(threads, 'thread')}"
        )
        remedy = "raise `ulimit -v`" + ", or set data.reader.threads=1" * (threads > 1)
        raise DataError(root, "memory", f"{needed}, and the system leaves this process less", remedy) from error


def _pycolmap() -> Any:
    try:
        # The import sets a handler of SIGTERM that prints a stack trace, and turns an exception into an ImportError, or drops it.
        with signals.held():
            import pycolmap
    except (ImportError, RuntimeError) as error:  # its own, where a library of the system is missing
        remedy = "pip install 'clear-strategies[colmap]'; PyPI has none for Linux on arm64, there give poses of another program"
        raise DataError("data=photos", "pycolmap", f"cannot be imported ({error})", remedy) from error
    return pycolmap


def _unplaced(pycolmap: Any, database: Path, names: Sequence[str], placed: Set[str]) -> dict[str, str]:
    """The reason why a photo has no pose, by its name, for each copy that is not `placed`.

    Args:
        names: of the photos, in the order of their copies.
    """
    with pycolmap.Database.open(database) as opened:
        copies = {image.image_id: image.name for image in opened.read_all_images()}
        features = {number: opened.num_keypoints_for_image(number) for number in copies}
        pairs = list(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))
    name_of = {copy_name(i): name for i, name in enumerate(names)}
    most = {number: (0, "") for number, copy in copies.items() if copy not in placed}
    for pair, matches in pairs:
        for number, other in itertools.permutations(pycolmap.pair_id_to_image_pair(pair)):
            if number in most and copies[other] in placed:
                most[number] = max(most[number], (matches, name_of[copies[other]]))
    return {name_of[copies[number]]: _why(features[number], *best) for number, best in most.items()}


def _why(features: int, matches: int, other: str) -> str:
    if features < _FEW_FEATURES:
        return f"{features} features: blurred, dark, or without texture"
    if not matches:
        return "shares nothing with the placed photos: overlap by two thirds"
    return f"{matches} features in common with {other}, less with every other photo: more overlap"


def warn_unplaced(root: Path, unplaced: Mapping[str, str], count: int) -> None:
    """Log which of `count` photos have no pose, and why."""
    if unplaced:
        placed = count - len(unplaced)
        listed = "; ".join(f"{name} ({why})" for name, why in list(unplaced.items())[:_LISTED])
        more = f"; and {len(unplaced) - _LISTED} more" if len(unplaced) > _LISTED else ""
        message = "%s: %d of %d photos could be placed (%.0f%%). Without a pose: %s%s."
        _log.warning(message, root, placed, count, 100 * placed / count, listed, more)
