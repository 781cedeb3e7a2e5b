"""Structure from motion on the CPU through pycolmap: a sparse model from photos alone, with bounded memory.

Photos of the same size and lens (by EXIF) share a camera, whose estimate starts at EXIF's focal length. If photos are left
without a pose, all are placed again without that focal length, since programs and adapters write wrong ones, and the model with
more photos is used. If photos that share a camera turn out to be zoomed, each gets a camera of its own.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections import Counter
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from clear_strategies import files
from clear_strategies.core.progress import Progress
from clear_strategies.data.capture import MORE_PHOTOS, NO_PARALLAX, STEP_ASIDE
from clear_strategies.data.file_names import some
from clear_strategies.data.photo_files import Header, read_image
from clear_strategies.data.readers import features
from clear_strategies.data.readers.features import SfmSettings, copy_name
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

FEWEST: Final = 3
MODEL: Final = "cameras.bin"
"""The file of a model that exists only if the model is complete."""
UNPLACED: Final = "unplaced.json"
"""A file in the model's folder: why the pose is unknown, for each photo without one, by its name."""
_MATCHED: Final = 50  # inlier matches, from which a pair's two-view geometry is trusted
_NEARLY_ALL: Final = 0.9  # of the pairs
_ROTATION: Final = 0.03  # largest entry of HᵀH - I, up to which a homography H is a rotation with lens distortion
_LISTED: Final = 3  # photos without a pose in the warning, at most
_ZOOM: Final = 1.1  # ratio of focal lengths, from which photos are zoomed; of one lens, it was at most 1.07
_OBSERVED: Final = 50  # points of a photo, from which its focal length is told
_UNKNOWN: Final = 1.2  # focal length in longer sides of the photo: COLMAP's default guess
_LITTLE_PARALLAX: Final = (
    "too little parallax: the photos are from nearly one place, which does not tell how far away anything is"
)
_DIAGONAL_35MM: Final = math.hypot(36, 24)  # mm


def reconstruct(root: Path, photos: Mapping[Path, Header], folder: Path, settings: SfmSettings) -> None:
    """Estimate the poses of these photos, and write the largest model to `folder`, with images named by `copy_name`.

    Args:
        photos: their paths and headers.

    Raises:
        DataError: pycolmap is not installed, memory is limited to too little, or too few photos can be placed.
    """
    count = len(photos)
    with features.workspace(root, folder.parent, folder.name, settings, "data.reader.threads") as (pycolmap, work):
        _log.info("%s: estimating the poses of %d photos, up to %d features each.", root, count, settings.max_features)
        models = sorted(_models(pycolmap, photos, work, settings), key=lambda m: m.num_reg_images(), reverse=True)
        require_placed(root, _most_placed(models), count)
        (result := work / "result").mkdir()
        models[0].write_binary(str(result))
        placed = [{image.name for image in model.images.values()} for model in models]  # a photo may be in several
        names = [path.name for path in photos]
        files.write_json(result / UNPLACED, _unplaced(pycolmap, work / features.DATABASE, names, placed[0]))
        files.install(result, folder, MODEL)
    groups = [len(group.difference(*placed[:i])) for i, group in enumerate(placed)]
    if any(groups[1:]):
        told = ", ".join(str(count) for count in groups if count)
        _log.warning(
            "%s: the photos fall into groups that nothing connects (%s photos); the largest is used.", root, told
        )


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
    groups, root = _write_copies(photos, work / features.COPIES, settings.max_side), next(iter(photos)).parent
    database = features.find_and_match(pycolmap, work, groups, settings, root)
    _require_parallax(pycolmap, database, root)
    distortion, count = _most_distortion(pycolmap, database), len(photos)
    models = _mapped(pycolmap, work, count, settings, distortion)
    lengths = sorted({said.focal_35mm for said in photos.values() if said.focal_35mm is not None})
    if (placed := _most_placed(models)) < count and lengths:
        _log.info("%d of %d photos are placed: again, without EXIF's focal length.", placed, count)
        _forget_focal_lengths(pycolmap, database, settings.threads)
        free = _mapped(pycolmap, work, count, settings, distortion)
        if (more := _most_placed(free)) > placed:
            models, told = free, some([f"{focal:g} mm" for focal in lengths])
            message = (
                "%s: EXIF's focal length (%s on 35 mm film) is not used: %d of %d photos are placed with it, %d without"
            )
            _log.warning(message, root, told, placed, count, more)
    largest, zoomed = max(models, key=lambda model: model.num_reg_images(), default=None), ""
    if largest is not None and (zoom := _zoom(pycolmap, largest, settings.threads)) > _ZOOM:
        _forget_focal_lengths(pycolmap, database, settings.threads, share=False)
        own = _sound(pycolmap, _mapped(pycolmap, work, count, settings, distortion), distortion)
        models, told = (
            (own, "Each photo gets its own") if _most_placed(own) >= FEWEST else (models, "Poses may be wrong")
        )
        zoomed = f"focal lengths of one camera differ by a factor of {zoom:.2g}. {told}."
    if not (models := _sound(pycolmap, models, distortion)):
        _require_unmatched(pycolmap, database, root)
    elif zoomed:
        _log.warning("%s: the photos are zoomed: %s", root, zoomed)
    return models


def _zoom(pycolmap: Any, model: Any, threads: int) -> float:
    """The largest ratio of the focal lengths of photos that share a camera, if they are adjusted one by one.

    The reprojection error does not tell zoomed photos: with one focal length for all, wrong poses explain them nearly as well.
    """
    own, numbers = pycolmap.Reconstruction(), list(model.reg_image_ids())
    for number in numbers:
        image = model.image(number)
        camera = pycolmap.Camera(model.camera(image.camera_id).todict() | {"camera_id": number})
        seen = np.array([point.xy for point in image.points2D])
        copy = pycolmap.Image(image.name, keypoints=seen, camera_id=number, image_id=number)
        own.add_camera_with_trivial_rig(camera)
        own.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        own.add_point3D(point.xyz, point.track)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.solver_options.num_threads = threads
    features.adjust(pycolmap, own, options)
    lengths: dict[int, list[float]] = {}
    for number in numbers:
        if own.image(number).num_points3D >= _OBSERVED:
            lengths.setdefault(model.image(number).camera_id, []).append(own.camera(number).mean_focal_length())
    return max((max(of) / min(of) for of in lengths.values()), default=1.0)


def _mapped(pycolmap: Any, work: Path, count: int, settings: SfmSettings, distortion: float) -> list[Any]:
    """Run COLMAP's mapper on the verified pairs, with this largest |k1| of a camera; returns the models."""
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = settings.threads, settings.seed
    # COLMAP's thresholds are for hundreds of photos: they place four of ten photos around a table, these place six.
    mapping.mapper.init_min_num_inliers, mapping.mapper.init_min_tri_angle = 50, 8.0
    mapping.mapper.abs_pose_min_num_inliers = 15
    mapping.max_extra_param = distortion
    # The first two photos may lie one behind the other, as of a dolly: the angle above already demands parallax.
    mapping.mapper.init_max_forward_motion = 1.0
    # With few photos most points are seen by two only. These points make the six poses four times more exact.
    mapping.triangulation.ignore_two_view_tracks = False
    _log.info("placing the photos.")
    progress, placed = Progress("placing", "photos", count), itertools.count(3)  # after the first two
    models = pycolmap.incremental_mapping(
        work / features.DATABASE,
        work / features.COPIES,
        work,
        options=mapping,
        next_image_callback=lambda: progress(next(placed)),
    )
    return list(models.values())


def _sound(pycolmap: Any, models: Sequence[Any], distortion: float) -> list[Any]:
    """Remove photos without points or with diverged cameras, as COLMAP does from 20 photos on; returns models with points."""
    limits = pycolmap.IncrementalPipelineOptions()
    lengths = limits.min_focal_length_ratio, limits.max_focal_length_ratio
    for model in models:
        for frame in pycolmap.ObservationManager(model).filter_frames(*lengths, distortion, 1):
            model.deregister_frame(frame)
        model.tear_down()  # forgets what is not registered
    return [model for model in models if model.num_points3D()]


def _most_distortion(pycolmap: Any, database: Path) -> float:
    """The largest |k1| of a sound camera. COLMAP's limit suits its default focal length; a lens that is n times as long, as EXIF
    tells, sees 1/n of the field, where n² times the k1 distorts as much.
    """
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    longest = max(c.mean_focal_length() / max(c.width, c.height) for c in cameras)
    return float(pycolmap.IncrementalPipelineOptions().max_extra_param * max(1.0, longest / _UNKNOWN) ** 2)


def _most_placed(models: Sequence[Any]) -> int:
    """The number of photos in the largest model."""
    return max((model.num_reg_images() for model in models), default=0)


def _forget_focal_lengths(pycolmap: Any, database: Path, threads: int, *, share: bool = True) -> None:
    """Reset the cameras' focal lengths to unknown, and verify the matched pairs again.

    Args:
        share: photos share the cameras that they shared; else each has its own.
    """
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            size = camera.width, camera.height
            unknown = pycolmap.Camera.create_from_model_id(camera.camera_id, camera.model, _UNKNOWN * max(size), *size)
            opened.update_camera(unknown)
        if not share:
            opened.clear_frames()  # COLMAP's mapper makes frames and rigs of images that have none
            opened.clear_rigs()
            for image in opened.read_all_images():
                camera = opened.write_camera(opened.read_camera(image.camera_id))
                opened.update_image(pycolmap.Image(image.name, camera_id=camera, image_id=image.image_id))
        opened.clear_two_view_geometries()
    options = pycolmap.GeometricVerifierOptions()
    options.num_threads = threads
    pycolmap.geometric_verification(database, options)


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


def _require_unmatched(pycolmap: Any, database: Path, root: Path) -> None:
    """Raise a DataError if a photo matches two others: that no model came of them is then due to too little parallax."""
    with pycolmap.Database.open(database) as opened:
        pairs = list(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))
    trusted = [pycolmap.pair_id_to_image_pair(pair) for pair, matches in pairs if matches >= _MATCHED]
    if any(count > 1 for count in Counter(itertools.chain(*trusted)).values()):
        raise DataError(root, "poses", _LITTLE_PARALLAX, STEP_ASIDE)


def _write_copies(photos: Mapping[Path, Header], folder: Path, max_side: int) -> features.Groups:
    """Write the copies; photos of the same size and lens share a camera."""
    folder.mkdir()
    groups: features.Groups = {}
    for i, (path, header) in enumerate(photos.items()):
        width, height = size = features.write_copy(read_image(path, turn=True), folder / copy_name(i), max_side)
        focal = header.focal_35mm and round(header.focal_35mm / _DIAGONAL_35MM * math.hypot(*size), 2)
        params = "" if focal is None else f"{focal},{width / 2},{height / 2},0"
        groups.setdefault(features.CopyCamera(*size, params, lens=header.lens), []).append(copy_name(i))
    return groups


def _unplaced(pycolmap: Any, database: Path, names: Sequence[str], placed: Set[str]) -> dict[str, str]:
    """The reason why a photo has no pose, by its name, for each copy that is not `placed`.

    Args:
        names: of the photos, in the order of their copies.
    """
    with pycolmap.Database.open(database) as opened:
        copies = {image.image_id: image.name for image in opened.read_all_images()}
        found = {number: opened.num_keypoints_for_image(number) for number in copies}
        pairs = list(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))
    name_of = {copy_name(i): name for i, name in enumerate(names)}
    most = {number: (0, "") for number, copy in copies.items() if copy not in placed}
    for pair, matches in pairs:
        for number, other in itertools.permutations(pycolmap.pair_id_to_image_pair(pair)):
            if number in most and copies[other] in placed:
                most[number] = max(most[number], (matches, name_of[copies[other]]))
    return {name_of[copies[number]]: _why(found[number], *best) for number, best in most.items()}


def _why(found: int, matches: int, other: str) -> str:
    if found < features.FEW:
        return f"{found} features: blurred, dark, or without texture"
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
