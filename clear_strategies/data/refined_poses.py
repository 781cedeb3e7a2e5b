"""Refinement of given poses by bundle adjustment, through pycolmap: those of networks and phones are too inexact for detail.

Features are found and matched as for photos without poses, and triangulated from the given poses. Then poses, focal lengths and
points are adjusted together, in rounds with falling thresholds. At last a similarity brings the poses back to the given ones.
"""

from __future__ import annotations

import hashlib
import logging
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from clear_strategies import files
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.file_names import some
from clear_strategies.data.priors import cache_folder
from clear_strategies.data.readers import features, sfm
from clear_strategies.data.readers.colmap_model import read_model
from clear_strategies.data.readers.features import CopyCamera, Groups, SfmSettings, copy_name
from clear_strategies.geometry.cameras import centers_of
from rasterizers.interface import Camera

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_log = logging.getLogger(__name__)

_ROUNDS: Final = (0.04, 0.016, 0.008, 0.004)
"""The largest reprojection error of a point in each round, in longer sides of the largest copy."""
_DEGREES: Final = 500.0  # largest angle between a point and a ray to it, per that error
# Relative differences of focal lengths, up to which …
_SQUARE: Final = 0.05  # … those of x and y are one, because pixels are square
_ONE_LENS: Final = 0.1  # … photos of one size share a camera
_FEWEST_POINTS: Final = 30  # of a photo, from which its pose is adjusted
_VERSION: Final = "four rounds, shared focal lengths"


def refined(capture: Capture, cache: Path | None = None, settings: SfmSettings | None = None) -> Capture:
    """Refine the poses and focal lengths of a capture, and triangulate its points anew. The result is kept in a cache.

    Photos that share too few points with others keep their poses. The world's axes and units stay, up to the errors of the given
    poses.

    Args:
        cache: see `photos.read`.

    Raises:
        DataError: pycolmap is not installed or fails, or memory is limited to too little.
    """
    frames, cache = capture.frames, cache_folder() / "sfm" if cache is None else cache
    settings = SfmSettings(precise=len(frames) <= features.PRECISE) if settings is None else settings
    with features.workspace(Path(capture.name), cache, "0" * 24, settings) as (pycolmap, work):
        groups = _write_copies(frames, work / features.COPIES, settings.max_side)
        folder = cache / _cache_key(frames, work / features.COPIES, settings)
        if not (folder / sfm.MODEL).is_file():
            _log.info("%s: refining the poses of %d photos.", capture.name, len(frames))
            if (model := _adjusted(pycolmap, work, capture, groups, settings)) is None:
                _log.warning("data.refine_poses has no effect: no two photos share %d points.", _FEWEST_POINTS)
                return capture
            (result := work / "result").mkdir()
            model.write_binary(str(result))
            files.install(result, folder, sfm.MODEL)
    return _with_model(capture, folder)


def _write_copies(frames: Sequence[Frame], folder: Path, max_side: int) -> Groups:
    """Write the copies of the undistorted photos, by their cameras."""
    folder.mkdir()
    groups: Groups = {}
    for i, (frame, camera) in enumerate(zip(frames, _shared([frame.camera for frame in frames]), strict=True)):
        width, height = features.write_copy(frame.load().image, folder / copy_name(i), max_side)
        seen = camera.resized(width, height)
        # Networks estimate both focal lengths, although pixels are square, unless undistortion has stretched them.
        distorted = frame.lens is not None and frame.lens.distorts
        square = not distorted and math.isclose(seen.fx, seen.fy, rel_tol=_SQUARE)
        focal = ((seen.fx + seen.fy) / 2,) if square else (seen.fx, seen.fy)
        params = ",".join(map(repr, (*focal, seen.cx, seen.cy)))
        model = "SIMPLE_PINHOLE" if square else "PINHOLE"
        groups.setdefault(CopyCamera(width, height, params, model), []).append(copy_name(i))
    return groups


def _shared(cameras: Sequence[Camera]) -> list[Camera]:
    """The cameras, with the same intrinsics where photos of one size have nearly the same focal length: networks estimate one for
    each photo, although one camera has taken all. A shared focal length makes poses two to five times as exact.
    """

    def lens_of(camera: Camera) -> Camera:
        same = [other for other in cameras if (other.width, other.height) == (camera.width, camera.height)]
        middle = statistics.median(other.fx for other in same)
        near = [other for other in same if math.isclose(other.fx, middle, rel_tol=_ONE_LENS)]
        if camera not in near:
            return camera
        names = ("fx", "fy", "cx", "cy")
        return replace(camera, **{name: statistics.median(getattr(other, name) for other in near) for name in names})

    return list(map(lens_of, cameras))


def _cache_key(frames: Sequence[Frame], copies: Path, settings: SfmSettings) -> str:
    digest = hashlib.sha256(repr((_VERSION, replace(settings, threads=0))).encode())
    for i, frame in enumerate(frames):
        camera = frame.camera
        numbers = camera.fx, camera.fy, camera.cx, camera.cy, *camera.world_to_camera.flatten().tolist()
        digest.update(repr(numbers).encode() + (copies / copy_name(i)).read_bytes())
    return digest.hexdigest()[:24]


def _adjusted(pycolmap: Any, work: Path, capture: Capture, groups: Groups, settings: SfmSettings) -> Any:
    """The adjusted model, in which photos that are not adjusted are not registered; None if fewer than two are."""
    database = features.find_and_match(pycolmap, work, groups, settings, Path(capture.name))
    frame_of = {copy_name(i): frame for i, frame in enumerate(capture.frames)}
    with pycolmap.Database.open(database) as opened:
        model = pycolmap.Reconstruction()
        model.load(pycolmap.DatabaseCache.create(opened, pycolmap.DatabaseCacheOptions()))
    for image in model.images.values():
        pose = frame_of[image.name].camera.world_to_camera[:3].double().numpy()
        model.frame(image.frame_id).rig_from_world = pycolmap.Rigid3d(pose)
        model.register_frame(image.frame_id)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = settings.threads, settings.seed
    options.triangulation.ignore_two_view_tracks = False  # as `sfm`
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    longest = max(max(camera.width, camera.height) for camera in groups)
    if model.num_reg_images() < 2:
        return None
    for error in _ROUNDS:
        pixels = error * longest
        options.mapper.filter_max_reproj_error = pixels
        rays = options.triangulation
        rays.create_max_angle_error = rays.continue_max_angle_error = error * _DEGREES
        rays.merge_max_reproj_error = rays.complete_max_reproj_error = pixels
        model = pycolmap.triangulate_points(model, database, work / features.COPIES, work, options=options)
        for image in list(model.images.values()):
            if image.has_pose and image.num_points3D < _FEWEST_POINTS:
                model.deregister_frame(image.frame_id)
        if model.num_reg_images() < 2:
            return None
        features.adjust(pycolmap, model, adjustment)
    _align(pycolmap, model, frame_of)
    return model


def _align(pycolmap: Any, model: Any, frame_of: dict[str, Frame]) -> None:
    """Transform the model by the similarity that brings its axes and camera centres closest to the given ones."""
    images = [image for image in model.images.values() if image.has_pose]
    given = [frame_of[image.name].camera for image in images]
    adjusted = _rotations(image.cam_from_world().matrix() for image in images)
    R = (_rotations(camera.world_to_camera for camera in given).inv() * adjusted).mean().as_matrix()
    there = centers_of(given).numpy()
    here = np.array([image.projection_center() for image in images]) @ R.T
    apart, away = there - there.mean(0), here - here.mean(0)
    scale = float((apart * away).sum() / max((away * away).sum(), np.finfo(float).tiny))
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(R), there.mean(0) - scale * here.mean(0)))


def _with_model(capture: Capture, folder: Path) -> Capture:
    """The capture with the poses, focal lengths and points of the adjusted model."""
    model = read_model(folder)
    adjusted = {image.name: image for image in model.images}
    frames, turned = [], []
    for i, frame in enumerate(capture.frames):
        if (image := adjusted.get(copy_name(i))) is None:
            frames.append(replace(frame, sfm_id=None))
            continue
        lens, given = model.lenses[image.camera], frame.camera
        x, y = given.width / lens.width, given.height / lens.height
        camera = replace(
            given, world_to_camera=image.pose, fx=x * lens.fx, fy=y * lens.fy, cx=x * lens.cx, cy=y * lens.cy
        )
        frames.append(_seen_by(frame, camera, image.id))
        turned.append((given.world_to_camera, image.pose))
    if kept := [frame.name for i, frame in enumerate(capture.frames) if copy_name(i) not in adjusted]:
        message = "data.refine_poses: %d of %d photos share too little with the others, and keep their poses: %s."
        _log.warning(message, len(kept), len(frames), some(kept))
    before, after = map(_rotations, zip(*turned, strict=True))
    angles = np.degrees((before * after.inv()).magnitude())
    told = f"{len(adjusted)} of {len(frames)} refined by pycolmap, by {np.median(angles):.2f} degrees (median)"
    points = replace(model.points, source=f"{len(model.points.means):,} points, triangulated from refined poses")
    notes = {**capture.notes, "poses": f"{capture.notes.get('poses', 'given')}; {told}"}
    return replace(capture, frames=tuple(frames), points=points, notes=notes)


def _seen_by(frame: Frame, camera: Camera, sfm_id: int) -> Frame:
    """The frame with another camera of the same photo."""
    return replace(frame, camera=camera, sfm_id=sfm_id, load=lambda: replace(frame.load(), camera=camera))


def _rotations(poses: Iterable[Any]) -> Rotation:
    """The rotations of these poses, [3 or 4, 4]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix([np.asarray(pose, np.float64)[:3, :3] for pose in poses])
