"""Selection of a capture's training and test views, and of the sizes of their images."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from clear_strategies.core.checks import refuse, require_choice, require_number, require_whole
from clear_strategies.core.images import DownKernel
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.view_names import bare, matching
from clear_strategies.errors import DataError
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

Sizes = Literal["crop", "round"]
PhotosAre = Literal["lr", "hr", "both"]


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """Selection of training and test views, and of image sizes.

    Args:
        train: the number of training views, evenly spaced among those that are not for testing; None: all of them.
        train_names: exactly these training views instead, by name or file name, with or without its ending.
        test_every: n: every n-th view, in order of names, is for testing, unless the data set has its own split; None or 0:
            none is.
        own_split: keep the data set's own split into training and test views, if it has one. If false, it is ignored.
        test_limit: at most this many test views, evenly spaced; None: all.
        sr_scale: HR pixels per LR pixel, at most: see `max_hr_megapixels`.
        max_hr_megapixels: the largest HR image with photos_are=lr. If sr_scale times the photos are larger, HR is twice as large
            as the photos, or the photos themselves, reduced to this size, are HR; with a prior chosen by name, the photos are
            reduced instead, until sr_scale times them fits. None: no limit.
        shrink: the photos are first reduced by this whole factor (LLFF at 1/8 and 1/2 of its full size: 2).
        sizes: what happens to photos whose sizes are no multiples of shrink · sr_scale. "crop": they lose a few pixels
            at the right and the bottom. "round": they are resized to sr_scale · round(size / (shrink · sr_scale)).
        photos_are: "lr": the photos are the LR observations, and HR is unknown. "hr": they are the truth at HR, which
            training never uses, and LR is made from them, as in the papers. "both": they are the HR images in place of SR
            images, and LR is made from them.
        downsample: D, the operator that makes LR.
        lr_folder: a folder of LR images with the photos' names, as prior=images finds them; None: they are made.
        equalize: scale the training photos to a common exposure and white balance, by a gain for each photo and channel
            (`clear_strategies.geometry.exposure_gains`); needs the depth of data.cloud.init=stereo or auto. Test photos stay as
            they are.
    """

    train: int | None = None
    train_names: Sequence[str] | None = None
    test_every: int | None = None
    own_split: bool = True
    test_limit: int | None = None
    sr_scale: int = 4
    max_hr_megapixels: float | None = 2.1  # 1920x1080 fits
    shrink: int = 1
    sizes: Sizes = "crop"
    photos_are: PhotosAre = "lr"
    downsample: DownKernel = "bicubic"
    lr_folder: str | None = None
    equalize: bool = False

    def __post_init__(self) -> None:
        if self.train_names is not None:
            names = [] if isinstance(self.train_names, str) else list(self.train_names)
            if not names or not all(isinstance(name, str) for name in names):
                rule = "must be null or a list of names"
                refuse("data.views.train_names", rule, self.train_names, "data.views.train_names=[r_2,r_16]")
            object.__setattr__(self, "train_names", tuple(names))
        for name, least in {"train": 1, "test_limit": 0, "test_every": 2, "sr_scale": 1, "shrink": 1}.items():
            if (value := getattr(self, name)) is not None and not (name == "test_every" and value == 0):
                require_whole(f"data.views.{name}", value, least=least)
        if self.max_hr_megapixels is not None:
            require_number("data.views.max_hr_megapixels", self.max_hr_megapixels, above=0)
        for name, choices in {"sizes": Sizes, "photos_are": PhotosAre, "downsample": DownKernel}.items():
            require_choice(f"data.views.{name}", getattr(self, name), get_args(choices))
        if self.photos_are == "lr" and self.lr_folder:
            rule = "must be null with photos_are=lr, the default, because the photos are the LR images"
            refuse("data.views.lr_folder", rule, self.lr_folder, "data.views.photos_are=hr")


def split(capture: Capture, views: ViewSettings) -> tuple[list[Frame], list[Frame]]:
    """(training, test) frames: the data set's own split, or every `test_every`-th for testing (RegNeRF's rule)."""
    frames = list(capture.frames)
    own_split = views.own_split and any(f.split for f in frames)
    if own_split:
        pool, test = [f for f in frames if f.split == "train"], [f for f in frames if f.split == "test"]
    elif views.test_every:
        test = frames[:: views.test_every]
        pool = [f for i, f in enumerate(frames) if i % views.test_every]
    else:
        pool, test = frames, []
    if views.train_names is not None:
        by_name = {f.name: f for f in (pool if own_split else frames)}
        names = [_only(capture, tuple(by_name), name) for name in views.train_names]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise DataError(capture.name, "train_names", f"{twice!r} is named twice", "name each view once")
        pool = [by_name[name] for name in names]
        test = [f for f in test if f not in pool]
    elif views.train is not None:
        if len(pool) < views.train:
            problem = f"{views.train} training views are asked for, there are {len(pool)}"
            raise DataError(capture.name, "views", problem, "lower data.views.train")
        pool = _evenly_spaced(pool, views.train)
    if not pool:
        raise DataError(capture.name, "views", "none is left for training", "give more photos")
    if views.test_limit is not None and len(test) > views.test_limit:
        test = _evenly_spaced(test, views.test_limit)
    return pool, test


def lr_size(camera: Camera, views: ViewSettings) -> tuple[int, int]:
    """(width, height) of the LR photo that is made from the photo of this camera."""
    step = views.shrink * (1 if views.photos_are == "lr" else views.sr_scale)
    width, height = (round(s / step) if views.sizes == "round" else s // step for s in (camera.width, camera.height))
    return width, height


def _only(capture: Capture, names: Sequence[str], wanted: str) -> str:
    """The only name that matches `wanted`, of `train_names`; a DataError if there is none or several."""
    match matching(names, wanted):
        case [match]:
            return match
        case []:
            problem, remedy = f"there is no view {wanted!r}", f"choose among {', '.join(map(bare, names))}"
        case several:
            problem = f"{wanted!r} may be {' or '.join(map(repr, several))}"
            remedy = "give the whole name of one of them"
    raise DataError(capture.name, "train_names", problem, remedy)


def _evenly_spaced(frames: Sequence[Frame], count: int) -> list[Frame]:
    """`count` of the frames by the papers' rule: round(linspace), halves to even."""
    return [frames[round(float(x))] for x in np.linspace(0, len(frames) - 1, count)]


def within_limit(
    capture: Capture, views: ViewSettings, *, reaches: Callable[[int], bool], super_resolve: bool
) -> tuple[Capture, ViewSettings]:
    """Reduce the photos and choose the factor so that the HR images fit into `views.max_hr_megapixels`.

    A phone's photo has 4032x3024 pixels; four times as wide and as high, it would have 195 megapixels. The first of these that
    fits into the limit is taken, unless `photos_are` is not "lr":

    1. The HR images are `sr_scale` times as large as the photos.
    2. They are twice as large as the photos, which keep all of their pixels. The prior must be able to enlarge by 2.
    3. The photos are the HR images, reduced if they are larger than the limit, and the LR images are made from them. No image is
       super-resolved: the photos already hold more detail than the HR images may.

    With `super_resolve`, in place of 3, the photos are reduced until `sr_scale` times their size fits. Where sizes differ, the
    largest photo decides, and each photo is reduced to the limit by itself: one ratio would leave little of a phone's 12
    megapixels beside 48.

    Args:
        reaches: returns True if the prior can enlarge by a factor.
        super_resolve: the HR images must come from the prior, which the user has chosen by name.
    """
    limit, photo = views.max_hr_megapixels, _largest(capture)
    pixels = _megapixels(photo, views)
    if views.photos_are != "lr" or limit is None or views.sr_scale**2 * pixels <= limit:
        return capture, views
    size = f"{photo.width // views.shrink}x{photo.height // views.shrink}"
    why = f"x{views.sr_scale} of {size} is {views.sr_scale**2 * pixels:.3g} megapixels, data.views.max_hr_megapixels is {limit:g}"
    if views.sr_scale > 2 and 4 * pixels <= limit and reaches(2):
        return _noted(capture, f"{why}: x2 instead"), replace(views, sr_scale=2)
    factor = views.sr_scale**2 if super_resolve else 1
    multiple = 1 if super_resolve else views.sr_scale
    ratios = [views.shrink * max(1.0, math.sqrt(factor * _megapixels(f.camera, views) / limit)) for f in capture.frames]
    if max(ratios) > 1:
        frames = [_reduced(f, r, multiple, views.downsample) for f, r in zip(capture.frames, ratios, strict=True)]
        capture = replace(capture, frames=tuple(frames))
        now = _largest(capture)
        span = f"{max(ratios):.3g}" if max(ratios) == min(ratios) else f"{min(ratios):.3g} to {max(ratios):.3g}"
        why += f": photos reduced by {span} to {now.width}x{now.height} (PIL {views.downsample})"
    if not super_resolve:
        why += "; the photos themselves are HR, so no SR image is needed, and LR is made from them"
        views = replace(views, photos_are="both")
    return _noted(capture, why), replace(views, shrink=1)


def _megapixels(camera: Camera, views: ViewSettings) -> float:
    return camera.width * camera.height / views.shrink**2 / 1e6


def _largest(capture: Capture) -> Camera:
    return max((frame.camera for frame in capture.frames), key=lambda camera: camera.width * camera.height)


def _noted(capture: Capture, why: str) -> Capture:
    _log.debug("HR side: %s.", why)
    return replace(capture, notes={**capture.notes, "HR side": why})


def _reduced(frame: Frame, ratio: float, multiple: int, kernel: DownKernel) -> Frame:
    """The frame with a photo `ratio` times smaller, rounded to a size that `multiple` divides."""
    width, height = (max(1, round(s / ratio / multiple)) * multiple for s in (frame.camera.width, frame.camera.height))
    camera = frame.camera.resized(width, height)
    return replace(frame, camera=camera, load=lambda: frame.load().resized(camera, kernel, layers="area"))
