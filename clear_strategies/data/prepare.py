"""Preparation of a scene from a capture: the views' LR photos, SR images and true HR images, and the initial points.

Every choice made here changes published numbers, so each has a line in the scene's notes (`scene_notes.py`).
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.progress import told
from clear_strategies.core.view import SMALLEST, Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.data.capture import NO_PARALLAX, STEP_ASIDE, Capture, Frame
from clear_strategies.data.cloud import CloudSettings, initial_points, require_source
from clear_strategies.data.depth_files import depth_files
from clear_strategies.data.lenses import forget_maps
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.priors import Bicubic, Prior
from clear_strategies.data.priors.interface import cached, network_of, super_resolved, warn_if_far_from_lr
from clear_strategies.data.scene import Scene, require_shown
from clear_strategies.data.scene_notes import scene_notes, size_of
from clear_strategies.data.view_names import ViewFiles, write_pngs
from clear_strategies.data.view_settings import ViewSettings, lr_size, split
from clear_strategies.errors import DataError
from clear_strategies.geometry.cameras import centers_of, warn_if_far
from clear_strategies.geometry.exposure import exposure_gains
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_READERS: Final = 4  # photos read at once, at most, since each is held at its full size meanwhile
_SAME_EXPOSURE: Final = 0.01  # photos whose gains are closer to 1 stay as they are
# Radius of the cameras' positions around their mean …
_ONE_PLACE: Final = 1e-6  # … over their distance from the origin, up to which rounding in files explains it
_NO_STEP: Final = 1e-3  # … over that of the points, up to which parallax is less than two pixels of a photo of 2,000


def prepare(
    capture: Capture, views: ViewSettings, prior: Prior, cloud: CloudSettings, *, seed: int = 0, work_log: WorkLog | None = None
) -> Scene:  # fmt: skip
    """Split the frames, make LR and HR of each view, and make the initial points.

    The headers of the photos are checked before any photo is decoded.

    Raises:
        DataError: the capture cannot be prepared with these settings.
    """
    train_frames, test_frames = split(capture, views)
    frames = [*train_frames, *map(_opaque, test_frames)]
    lr_files = check_headers(frames, views)
    require_source(cloud, capture.points)
    files = () if cloud.depth is None else depth_files(Path(cloud.depth), train_frames)
    _check_positions(capture, [frame.camera for frame in train_frames], cloud)
    made, work_log = list[View](), WorkLog() if work_log is None else work_log
    with work_log.stage("photos and SR images"):
        loaded = _loaded(capture, views, frames, lr_files)
        for name, photo, lr in told(loaded, "photos and their SR images", "photos", len(frames)):
            made.append(_view(capture, views, prior, name, photo, lr, trains=len(made) < len(train_frames)))
    train, test = tuple(made[: len(train_frames)]), tuple(made[len(train_frames) :])
    require_shown(train)
    with work_log.stage("initial points"):
        initial = initial_points(
            cloud, [v.lr for v in train], hr=[v.hr for v in train], hr_is_photo=views.photos_are == "both", files=files,
            sfm=capture.points, train_ids=[frame.sfm_id for frame in train_frames if frame.sfm_id is not None],
            sfm_is_train=len(train) == len(capture.frames), background=capture.background, seed=seed,
        )  # fmt: skip
    if initial.depths:
        train = tuple(replace(v, depth=depth) for v, depth in zip(train, initial.depths, strict=True))
    train, exposure = _equalized(train) if views.equalize else (train, {})
    notes = scene_notes(capture, views, prior, train, test, train_frames[0].camera, initial.cloud, exposure)
    return Scene(
        capture.name, train, test, initial.cloud, capture.background, synthetic_prior="synthetic" in train[0].sr_source,
        notes=notes, work_log=work_log,
    )  # fmt: skip


def check_headers(frames: Sequence[Frame], views: ViewSettings) -> dict[str, Path]:
    """Check by their headers that these frames can be prepared: a DataError for a photo that is too small, or a ready-made LR
    image that is missing or has another size. No photo is decoded.

    Returns:
        The ready-made LR image of each frame by its name; empty without `lr_folder`.
    """
    factor = 1 if views.photos_are == "lr" else views.sr_scale
    for frame in frames:
        width, height = (factor * size for size in lr_size(frame.camera, views))
        if min(width, height) < SMALLEST:
            size = f"{size_of(frame.camera)}, scored at {width}x{height}"
            smaller = min(frame.camera.width, frame.camera.height) < SMALLEST
            remedy = "give larger photos" if smaller else "lower data.views.shrink or data.views.sr_scale"
            raise DataError(frame.name, "size", f"is {size}, where scores need {SMALLEST} pixels a side", remedy)
    if views.lr_folder is None:
        return {}
    remedies = "name the LR images like the photos", "see data.views for the LR size"
    files = ViewFiles(Path(views.lr_folder), "LR image", *remedies)
    return {frame.name: files.file(frame.name, *lr_size(frame.camera, views)) for frame in frames}


def save_lr(capture: Capture, views: ViewSettings, folder: Path) -> None:
    """Write the training and test LR images as PNG for an external SR model; prior=images reads its results."""
    frames = list(itertools.chain(*split(capture, views)))
    loaded = _loaded(capture, views, frames, check_headers(frames, views))
    written = write_pngs(folder, ((name, lr.image) for name, _, lr in loaded))
    message = "%d LR images written to %s. Super-resolve them, then train with prior=images prior.path=<results>."
    _log.info(message, written, folder)


def truth_of(capture: Capture, views: ViewSettings) -> dict[str, Callable[[], Float[Tensor, "H W 3"]]]:
    """Functions that load the photos at HR, by name, for priors that use the truth."""

    def truth(frame: Frame) -> Float[Tensor, "H W 3"]:
        return _sized(frame.load(), views).image

    return {frame.name: partial(truth, frame) for frame in capture.frames}


def _loaded(
    capture: Capture, views: ViewSettings, frames: Sequence[Frame], lr_files: Mapping[str, Path]
) -> Iterator[tuple[str, Photo, Photo]]:
    """Load the photos of these frames in order, a few at a time: (name, the photo as `_sized` makes it, the LR photo).

    Args:
        lr_files: see `check_headers`.
    """

    def load(frame: Frame) -> tuple[str, Photo, Photo]:
        photo = _sized(frame.load(), views)
        if views.photos_are == "lr":
            return frame.name, photo, photo
        camera = photo.camera.scaled(1 / views.sr_scale)
        if frame.name not in lr_files:
            return frame.name, photo, replace(photo, shown=None).resized(camera, views.downsample)
        file = lr_files[frame.name]
        image = read_image(file, background=capture.background, expect=(camera.width, camera.height))
        check = f"{file} shows this view, undistorted as data.save_lr writes it"
        warn_if_far_from_lr(f"{frame.name}: the photo", photo.image, image, views.sr_scale, check)
        return frame.name, photo, Photo(camera, image)

    with ThreadPoolExecutor(min(torch.get_num_threads(), _READERS)) as pool:
        yield from pool.map(load, frames)
    forget_maps()


def _opaque(frame: Frame) -> Frame:
    """The frame without the photo's transparency, which only training needs."""
    return replace(frame, load=lambda: replace(frame.load(), transparency=None))


def _view(
    capture: Capture, views: ViewSettings, prior: Prior, name: str, photo: Photo, lr: Photo, *, trains: bool
) -> View:
    """The view of a photo, for training or for testing. If the prior has no SR image of a test view, bicubic replaces it."""
    factor, are_both = views.sr_scale, views.photos_are == "both"
    hr, truth = replace(photo, shown=None), None if lr is photo or are_both else photo.image
    source, disagreement = "the photos themselves", None
    if not are_both:
        through = _enlarged(prior, lr.transparency, name, factor)
        try:
            sr = super_resolved(prior, name, lr.image, factor)
        except DataError as missing:
            if trains:
                raise
            _log.info("%s: no SR image for this test view (%s); bicubic replaces it.", name, missing.problem)
            prior = Bicubic()
            sr = super_resolved(prior, name, lr.image, factor)
        camera = lr.camera.scaled(factor) if lr is photo else photo.camera
        hr = Photo(camera, sr.image, transparency=through)
        source, disagreement = prior.label, sr.disagreement
    view = View(
        name, lr, hr, truth, source, disagreement=disagreement, background=capture.background, hr_is_photo=are_both
    )
    shown = photo.reduced(photo.camera.width // lr.camera.width).shown
    return view if shown is None else view.hiding(shown)


def _enlarged(
    prior: Prior, transparency: Float[Tensor, "h w"] | None, name: str, factor: int
) -> Float[Tensor, "H W"] | None:
    """Enlarge transparency to HR, by the prior's network; by bicubic without a network, or if every pixel is opaque."""
    if transparency is None:
        return None
    network = network_of(prior) if bool(transparency.any()) else None
    enlarge = Bicubic() if network is None else cached(network)
    return enlarge(name, images.as_rgb(transparency), factor).mean(dim=2)


def _equalized(train: Sequence[View]) -> tuple[tuple[View, ...], dict[str, str]]:
    """Bring the views to a common exposure; also returns a line for the plan."""
    depths = [view.depth for view in train if view.depth is not None]
    if len(depths) < len(train):
        why = "there is no depth that tells what the photos share. Set data.cloud.init=stereo."
        _log.warning("data.views.equalize has no effect: %s", why)
        return tuple(train), {}
    gains = exposure_gains([view.depth_photo for view in train], depths)
    span = f"photos times {float(gains.min()):.3f} to {float(gains.max()):.3f}"
    if float((gains - 1).abs().max()) < _SAME_EXPOSURE:
        return tuple(train), {"exposure of the photos": f"the same ({span})"}
    equal = tuple(view.brightened(gain) for view, gain in zip(train, gains, strict=True))
    return equal, {"equalized": f"{span} (data.views.equalize)"}


def _sized(photo: Photo, views: ViewSettings) -> Photo:
    """Reduce the photo by `shrink`, to a size that is whole at both scales, see `ViewSettings.sizes`."""
    multiple = 1 if views.photos_are == "lr" else views.sr_scale
    if views.sizes == "round":
        width, height = (multiple * size for size in lr_size(photo.camera, views))
        return photo.resized(photo.camera.resized(width, height), views.downsample)
    whole = photo.cropped(views.shrink * multiple)
    return whole.resized(whole.camera.scaled(1 / views.shrink), views.downsample)


def _check_positions(capture: Capture, cameras: Sequence[Camera], cloud: CloudSettings) -> None:
    """Raise a DataError if all photos are from one place, since depth is then unknown, unless a file gives the points. Warn
    if they are far from the origin.
    """
    centers = centers_of(cameras)
    middle = centers.mean(0)
    apart, away = float((centers - middle).norm(dim=1).max()), float(middle.norm())
    least = _ONE_PLACE * away
    if capture.points is not None and len(capture.points.means):
        least += _NO_STEP * float((capture.points.means.double() - middle).norm(dim=1).median())
    if apart <= least and len(cameras) > 1 and cloud.init != "ply":
        remedy = f"{STEP_ASIDE}; or give the depth: data.cloud.init=ply data.cloud.path=POINTS.ply"
        raise DataError(capture.name, "poses", f"{NO_PARALLAX} (cameras within {apart:.2g} units)", remedy)
    warn_if_far(centers)
