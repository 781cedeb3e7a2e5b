"""From a capture to a scene: which views train and test, their sizes, their LR photos, SR images and initial points.

Every choice here changes published numbers. Therefore every choice is written into the scene's notes, which the plan
prints.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import refuse, require_choice, require_number, require_whole
from clear_strategies.core.images import DownKernel
from clear_strategies.core.progress import Progress
from clear_strategies.core.view import Photo, View
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.photo_files import image_size, inside, list_images, read_image, write_png
from clear_strategies.data.points import CloudSettings, initial_points, require_source
from clear_strategies.data.priors import Bicubic, Prior, fingerprint, network_of, super_resolved
from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_ROUNDING: Final = 0.5  # grey levels: the largest difference that rounding to 8 bits makes

Sizes = Literal["crop", "round"]
PhotosAre = Literal["lr", "hr", "both"]


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """Which views, at which sizes.

    Args:
        train: the number of training views, evenly spaced among those that are not for testing; None: all of them.
        train_names: exactly these training views instead, by file name without its ending.
        test_every: every view of this number, in order of names, is for testing, unless the data set has its own split;
            None or 0: none is.
        own_split: keep to the data set's own split, if it has one; false: all of its views are alike.
        test_limit: at most this many test views, evenly spaced; None: all.
        sr_scale: HR pixels per LR pixel, at most: see `max_hr_megapixels`.
        max_hr_megapixels: of a view at HR, with photos_are=lr. Larger ones are trained at twice the photos instead, or with
            the photos, reduced to it, as the HR side: `clear_strategies.data.hr_limit`. None: no limit.
        shrink: the photos are first reduced by this whole factor (LLFF at 1/8 and 1/2 of its full size: 2).
        sizes: what happens to photos whose sizes are no multiples of shrink · sr_scale. "crop": they lose a few pixels
            at the right and the bottom. "round": they are resized to sr_scale · round(size / (shrink · sr_scale)).
        photos_are: "lr": the photos are the LR observations, and HR is unknown. "hr": they are the truth at HR, which
            training never sees, and LR is made from them, as in the papers. "both": they are trained on at HR, in place of
            SR images, and LR is made from them.
        downsample: D, the operator that makes LR.
        lr_folder: ready-made LR images by the photos' names, instead of making them.

    Raises:
        SettingError: a value is outside its range, or contradicts another.
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

    def __post_init__(self) -> None:
        if self.train_names is not None:
            names = [] if isinstance(self.train_names, str) else list(self.train_names)
            if not names or not all(isinstance(name, str) for name in names):
                rule = "must be null or a list of names"
                refuse("data.views.train_names", rule, self.train_names, "data.views.train_names=[r_2,r_16]")
            object.__setattr__(self, "train_names", tuple(names))
        if self.train is not None:
            require_whole("data.views.train", self.train, least=1)
        if self.test_limit is not None:
            require_whole("data.views.test_limit", self.test_limit, least=0)
        if self.test_every not in (None, 0):
            require_whole("data.views.test_every", self.test_every, least=2)
        require_whole("data.views.sr_scale", self.sr_scale, least=1)
        if self.max_hr_megapixels is not None:
            require_number("data.views.max_hr_megapixels", self.max_hr_megapixels, above=0)
        require_whole("data.views.shrink", self.shrink, least=1)
        require_choice("data.views.sizes", self.sizes, get_args(Sizes))
        require_choice("data.views.photos_are", self.photos_are, get_args(PhotosAre))
        require_choice("data.views.downsample", self.downsample, get_args(DownKernel))
        if self.photos_are == "lr" and self.lr_folder:
            rule = "must be null with photos_are=lr, the default, because the photos are the LR images"
            refuse("data.views.lr_folder", rule, self.lr_folder, "data.views.photos_are=hr")


def prepare(capture: Capture, views: ViewSettings, prior: Prior, cloud: CloudSettings, *, seed: int = 0) -> Scene:
    """Split the frames, make LR and HR of each view, and find the initial points.

    What the photos' headers tell is checked before any photo is decoded.

    Raises:
        SettingError: a photo is too small for `shrink` and `sr_scale`.
        DataError: the capture cannot give what the settings ask for.
    """
    train_frames, test_frames = split(capture, views)
    lr_files = check_headers(train_frames + test_frames, views)
    held_out = len(train_frames) < len(capture.frames)  # so the capture's points may know what training must not
    require_source(cloud, capture.points)
    progress = Progress("photos and their SR images", "photos", len(train_frames) + len(test_frames))
    found: list[View] = []
    for frame in (*train_frames, *test_frames):
        found.append(_view(frame, capture, views, prior, lr_files, required=len(found) < len(train_frames)))
        progress(len(found))
    train, test = tuple(found[: len(train_frames)]), tuple(found[len(train_frames) :])
    ids = [frame.sfm_id for frame in train_frames if frame.sfm_id is not None]
    initial = initial_points(
        cloud, [v.lr for v in train], sfm=capture.points, train_ids=ids, sfm_is_train=not held_out,
        background=capture.background, seed=seed,
    )  # fmt: skip
    points = initial.cloud
    if initial.depths:
        train = tuple(replace(v, depth=depth) for v, depth in zip(train, initial.depths, strict=True))
    sample, photo, network = train[0], train_frames[0].camera, network_of(prior)
    made = {
        "hr": f"{'PIL ' if views.downsample != 'area' else ''}{views.downsample} of the HR photo"
        if views.lr_folder is None else f"read from {views.lr_folder} (D is taken to be {views.downsample})",
        "lr": "the photos themselves; HR is unknown",
        "both": f"PIL {views.downsample} of the photos",
    }[views.photos_are]  # fmt: skip
    unused = len(capture.frames) - len(train) - len(test)
    notes = {
        "scene": f"{capture.name}, {len(capture.frames)} photos",
        **capture.notes,
        "train views": _names(train),
        "test views": _names(test)
        if test
        else "none: all are trained on (data.views.test_every=8 keeps every 8th for testing)",
        **({"not used": f"{unused} photos, by data.views"} if unused and not test else {}),
        "sizes": f"photos of {_size(photo)}, shrink {views.shrink}, {views.sizes} to whole pixels at both scales",
        "LR": f"{_size(sample.lr.camera)}, {made}",
        "HR": f"{_size(sample.hr.camera)} (x{views.sr_scale}), SR images: {sample.sr_source}",
        **_moved(train, views.downsample),
        **({} if network is None else {"SR network": f"{fingerprint(network)} (SHA-256)"}),
        "the SR images add": f"{_added_detail(train):.1f} grey levels to bicubic, on average",
        "initial points": f"{len(points):,}: {points.source}",
        "points use test views": points.uses_test_views,
    }
    synthetic = "synthetic" in sample.sr_source
    return Scene(capture.name, train, test, points, capture.background, synthetic, notes)


def split(capture: Capture, views: ViewSettings) -> tuple[list[Frame], list[Frame]]:
    """(training, test) frames: the data set's own split, or every `test_every`-th for testing (RegNeRF's rule).

    Raises:
        DataError: a named view does not exist, or there are too few.
    """
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
        by_name = {Path(f.name).stem: f for f in (pool if own_split else frames)}
        missing = [name for name in views.train_names if name not in by_name]
        if missing:
            raise DataError(
                capture.name, "train_names", f"there is no view {missing[0]!r}", f"choose among {', '.join(by_name)}"
            )
        pool = [by_name[name] for name in views.train_names]
        test = [f for f in test if f not in pool]
    elif views.train is not None:
        if len(pool) < views.train:
            raise DataError(
                capture.name, "views", f"{views.train} training views are asked for, there are {len(pool)}",
                "lower data.views.train",
            )  # fmt: skip
        pool = _evenly_spaced(pool, views.train)
    if not pool:
        raise DataError(capture.name, "views", "none is left for training", "give more photos")
    if views.test_limit is not None and len(test) > views.test_limit:
        test = _evenly_spaced(test, views.test_limit)
    return pool, test


def lr_photos(frames: Sequence[Frame], capture: Capture, views: ViewSettings) -> list[Photo]:
    """The LR photos of these frames, without SR images."""
    lr_files = check_headers(frames, views)
    return [_view(frame, capture, views, Bicubic(), lr_files, required=True).lr for frame in frames]


def check_headers(frames: Sequence[Frame], views: ViewSettings) -> dict[str, Path]:
    """Whether these frames can be prepared, as far as headers tell. No photo is decoded.

    Returns:
        The ready-made LR image of each frame, by its name; empty without `lr_folder`.

    Raises:
        SettingError: a photo is too small for `shrink` and `sr_scale`.
        DataError: a ready-made LR image is missing, or has another size.
    """
    for frame in frames:
        if min(lr_size(frame.camera, views)) < 1:
            rule = f"must leave a whole LR pixel of the photo {frame.name} of {_size(frame.camera)}"
            if views.photos_are != "lr":
                rule += f" at sr_scale={views.sr_scale}"
            refuse("data.views.shrink", rule, views.shrink, "lower data.views.shrink")
    if views.lr_folder is None:
        return {}
    folder = Path(views.lr_folder)
    by_stem = {file.stem: file for file in reversed(list_images(folder))}
    found = {}
    for frame in frames:
        stem, (width, height) = Path(frame.name).stem, lr_size(frame.camera, views)
        if stem not in by_stem:
            raise DataError(folder, stem, "has no LR image of this name", "name the LR images like the photos")
        file = found[frame.name] = inside(folder, by_stem[stem].name, file=folder)
        if image_size(file) != (width, height):
            found_size = "{}x{}".format(*image_size(file))
            raise DataError(
                file, "size", f"is {found_size} where {width}x{height} is expected", "see data.views for the LR size"
            )
    return found


def lr_size(camera: Camera, views: ViewSettings) -> tuple[int, int]:
    """(width, height) of the LR photo of a camera whose photo has its own size."""
    step = views.shrink * (1 if views.photos_are == "lr" else views.sr_scale)
    width, height = (round(s / step) if views.sizes == "round" else s // step for s in (camera.width, camera.height))
    return width, height


def save_lr(scene: Scene, folder: Path) -> None:
    """Write the training and test LR images as PNG for an external SR model; prior=images reads its results."""
    for view in (*scene.train, *scene.test):
        write_png((folder / view.name).with_suffix(".png"), view.lr.image)
    _log.info(
        "%d LR images written to %s. Super-resolve them, then train with prior=images prior.path=<results>.",
        len(scene.train) + len(scene.test),
        folder,
    )


def _evenly_spaced(frames: Sequence[Frame], count: int) -> list[Frame]:
    """`count` of the frames by the papers' rule: round(linspace), halves to even."""
    return [frames[round(float(x))] for x in np.linspace(0, len(frames) - 1, count)]


def _view(
    frame: Frame,
    capture: Capture,
    views: ViewSettings,
    prior: Prior,
    lr_files: Mapping[str, Path],
    *,
    required: bool,
) -> View:
    """The view of a frame. Without `required`, bicubic replaces an SR image that the prior does not have."""
    photo = _reduced(frame, views)
    if views.photos_are == "lr":
        lr, hr_camera, truth = photo, photo.camera.scaled(views.sr_scale), None
    else:
        hr_camera, truth = photo.camera, photo.image
        lr_camera = hr_camera.scaled(1 / views.sr_scale)
        if frame.name in lr_files:
            size = (lr_camera.width, lr_camera.height)
            lr = Photo(lr_camera, read_image(lr_files[frame.name], background=capture.background, expect=size))
        else:
            lr = Photo(lr_camera, images.downsample(truth, views.sr_scale, views.downsample))
    if views.photos_are == "both" and truth is not None:
        return View(
            frame.name,
            lr,
            Photo(hr_camera, truth),
            truth=truth,
            sr_source="none, the photos themselves",
            background=capture.background,
        )
    try:
        made, sr_source = super_resolved(prior, frame.name, lr.image, views.sr_scale), prior.label
    except DataError as missing:
        if required:
            raise
        _log.info("%s: no SR image for this test view (%s); bicubic replaces it.", frame.name, missing.problem)
        bicubic = Bicubic()
        made, sr_source = super_resolved(bicubic, frame.name, lr.image, views.sr_scale), bicubic.label
    return View(
        frame.name, lr, Photo(hr_camera, made.image), truth=truth, sr_source=sr_source, disagreement=made.disagreement,
        background=capture.background,
    )  # fmt: skip


def _moved(views: Sequence[View], down: DownKernel) -> dict[str, str]:
    """What back-projection has changed, a line for the plan; empty without it."""
    before = [view.disagreement for view in views if view.disagreement is not None]
    if not before:
        return {}
    after = [(images.downsample(view.hr.image, view.factor, down) - view.lr.image).abs() for view in views]
    text = f"SR images differed from the LR photos by {_grey_levels(before):.2f} grey levels, now by {_grey_levels(after):.2f}"
    return {"back-projection": text}


def _grey_levels(differences: Sequence[Tensor]) -> float:
    """The mean over images of their mean difference, in grey levels of 255."""
    return 255 * sum(float(difference.mean()) for difference in differences) / len(differences)


def _reduced(frame: Frame, views: ViewSettings) -> Photo:
    """The photo reduced by `shrink`, with sizes that are whole at both scales; see `ViewSettings.sizes`."""
    image, camera = frame.load(), frame.camera
    multiple = 1 if views.photos_are == "lr" else views.sr_scale
    if views.sizes == "round":
        width, height = (multiple * size for size in lr_size(camera, views))
        camera = resized(camera, width, height)
        return Photo(camera, images.resize(image, (width, height), views.downsample))
    image = images.crop_to_multiple(image, views.shrink * multiple)
    camera = replace(camera, width=image.shape[1], height=image.shape[0])
    return Photo(camera.scaled(1 / views.shrink), images.downsample(image, views.shrink, views.downsample))


def resized(camera: Camera, width: int, height: int) -> Camera:
    """The same rays through width × height pixels, each axis scaled by its own ratio."""
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def _added_detail(views: Sequence[View]) -> float:
    """Mean |I_HR - U(I_LR)| in grey levels of 255. Logs a warning if there is no detail."""
    means = [float((v.hr.image - images.upsample(v.lr.image, v.factor)).abs().mean()) for v in views]
    added = 255 * sum(means) / len(means)
    if added < _ROUNDING:
        _log.warning(
            "the SR images add %.2f grey levels to bicubic: HR still constrains the field between LR pixels, but there "
            "is no detail to route, and no strategy can find any.", added,
        )  # fmt: skip
    return added


def _names(views: Sequence[View]) -> str:
    first = ", ".join(v.name for v in views[:8]) + (", …" if len(views) > 8 else "")
    return f"{len(views)}: {first}" if views else "none"


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
