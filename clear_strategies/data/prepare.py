"""From a capture to a scene: which views train, how large they are, how LR was made, what the reference is.

Every choice here changes published numbers, so every choice is written into the scene's notes and printed as the plan.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.view import Photo, View
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.photo_files import inside, list_images, read_image
from clear_strategies.data.points.cloud import CloudSettings, initial_cloud
from clear_strategies.data.priors.upscale import Bicubic, Prior
from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_NOTHING_ADDED: Final = 0.5  # grey levels: what rounding to 8 bits may do

Sizes = Literal["crop", "round"]


@dataclass(frozen=True, slots=True)
class ViewSettings:
    """Which views, at which sizes.

    Args:
        train: how many training views, spread evenly over those that are not for testing; None: all of them.
        train_names: exactly these instead, by file name without its ending.
        test_every: every such view, in order of names, is for testing (where the data set has no split of its own).
        test_limit: at most this many test views, evenly spread; None: all.
        sr_scale: HR pixels per LR pixel.
        shrink: the photos are first reduced by this whole factor (LLFF at 1/8 -> 1/2 of its full size: 2).
        sizes: photos whose sizes are no multiple of shrink · sr_scale lose a few pixels at the right and the bottom
            ("crop"), or are resized to sr_scale · round(size / (shrink · sr_scale)) and keep their border ("round").
        photos_are: "hr": the photos are the truth at HR and LR is made from them, as in the papers; "lr": they are the
            observations, and nobody knows HR.
        downsample: D, the operator that makes LR.
        lr_folder: ready-made LR images by the photos' names, instead of making them.
    """

    train: int | None = 3
    train_names: Sequence[str] | None = None
    test_every: int = 8
    test_limit: int | None = None
    sr_scale: int = 4
    shrink: int = 1
    sizes: Sizes = "crop"
    photos_are: str = "hr"
    downsample: DownKernel = "bicubic"
    lr_folder: str | None = None

    def __post_init__(self) -> None:
        if self.train_names is not None:
            object.__setattr__(self, "train_names", tuple(self.train_names))
        if self.train is not None and self.train < 1:
            raise ValueError(f"train must be at least 1 view, got {self.train}.")
        if self.sr_scale < 1 or self.shrink < 1:
            raise ValueError(f"sr_scale and shrink must be at least 1, got {self.sr_scale} and {self.shrink}.")
        if self.test_every < 2:
            raise ValueError(f"test_every must be at least 2, got {self.test_every}.")
        if self.sizes not in get_args(Sizes):
            raise ValueError(f"sizes must be crop or round, got {self.sizes!r}.")
        if self.photos_are not in ("hr", "lr"):
            raise ValueError(f"photos_are must be hr or lr, got {self.photos_are!r}.")
        if self.photos_are == "lr" and self.lr_folder:
            raise ValueError("with photos_are=lr the photos are the LR images; lr_folder has no use. Leave it null.")


def prepare(capture: Capture, views: ViewSettings, prior: Prior, cloud: CloudSettings, *, seed: int = 0) -> Scene:
    """Split, scale, super-resolve and find the initial points.

    Raises:
        DataError: the capture cannot give what the settings ask for.
    """
    train_frames, test_frames = split(capture, views)
    train = tuple(_view(frame, capture, views, prior, required=True) for frame in train_frames)
    test = tuple(_view(frame, capture, views, prior, required=False) for frame in test_frames)
    ids = [frame.sfm_id for frame in train_frames if frame.sfm_id is not None]
    points = initial_cloud(
        cloud, [v.lr for v in train], sfm=capture.points, train_ids=ids, background=capture.background, seed=seed
    )
    sample, photo = train[0], train_frames[0].camera
    made = {
        "hr": f"{'PIL ' if views.downsample != 'area' else ''}{views.downsample} of the HR photo"
        if views.lr_folder is None else f"read from {views.lr_folder} (D is taken to be {views.downsample})",
        "lr": "the photos themselves; HR is unknown",
    }[views.photos_are]  # fmt: skip
    notes = {
        "scene": f"{capture.name}, {len(capture.frames)} photos",
        **capture.notes,
        "train views": _names(train),
        "test views": _names(test),
        "sizes": f"photos of {_size(photo)}, shrink {views.shrink}, {views.sizes} to whole pixels at both scales",
        "LR": f"{_size(sample.lr.camera)}, {made}",
        "HR": f"{_size(sample.hr.camera)} (x{views.sr_scale}), reference: {sample.reference}",
        "the reference adds": f"{_added_detail(train):.1f} grey levels to bicubic, on average",
        "initial points": f"{len(points):,}: {points.source}",
        "test views had a part in the points": points.saw_test_views,
    }
    synthetic = "synthetic" in sample.reference
    return Scene(capture.name, train, test, points, capture.background, synthetic, notes)


def split(capture: Capture, views: ViewSettings) -> tuple[list[Frame], list[Frame]]:
    """(training, test) frames: the data set's own split, or every `test_every`-th for testing (RegNeRF's rule).

    Raises:
        DataError: a named view does not exist, or there are too few.
    """
    frames = list(capture.frames)
    own_split = any(f.split for f in frames)
    if own_split:
        pool, test = [f for f in frames if f.split == "train"], [f for f in frames if f.split == "test"]
    else:
        test = frames[:: views.test_every]
        pool = [f for i, f in enumerate(frames) if i % views.test_every]
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
        pool = [pool[i] for i in _spread(len(pool), views.train)]
    if not pool:
        raise DataError(capture.name, "views", "none is left for training", "give more photos")
    if views.test_limit is not None and len(test) > views.test_limit:
        test = [test[i] for i in _spread(len(test), views.test_limit)]
    return pool, test


def save_lr(scene: Scene, folder: Path) -> None:
    """Write the training and test LR images as PNG for an external SR model; prior=images reads its results."""
    from clear_strategies.data.photo_files import write_png

    for view in (*scene.train, *scene.test):
        write_png(folder / f"{Path(view.name).stem}.png", view.lr.image)
    _log.info(
        "%d LR images written to %s. Super-resolve them, then train with prior=images prior.path=<results>.",
        len(scene.train) + len(scene.test),
        folder,
    )


def _spread(n: int, count: int) -> list[int]:
    """`count` of n indices, evenly, by the papers' rule: round(linspace), halves to even."""
    return [round(float(x)) for x in np.linspace(0, n - 1, count)]


def _view(frame: Frame, capture: Capture, views: ViewSettings, prior: Prior, *, required: bool) -> View:
    image, camera = frame.load(), frame.camera
    if views.photos_are == "lr":
        image, camera = _reduced(image, camera, views, 1)
        lr, hr_camera, truth = Photo(camera, image), camera.scaled(views.sr_scale), None
    else:
        truth, hr_camera = _reduced(image, camera, views, views.sr_scale)
        lr_camera = hr_camera.scaled(1 / views.sr_scale)
        if views.lr_folder is None:
            lr = Photo(lr_camera, images.downsample(truth, views.sr_scale, views.downsample))
        else:
            lr = Photo(lr_camera, _ready_made(frame, Path(views.lr_folder), lr_camera, capture))
    label = prior.label
    try:
        reference = prior(frame.name, lr.image, views.sr_scale)
    except DataError as missing:
        if required:
            raise
        _log.info("%s: no SR image for this test view (%s); bicubic stands in for it.", frame.name, missing.problem)
        reference, label = Bicubic()(frame.name, lr.image, views.sr_scale), Bicubic().label
    return View(frame.name, lr, Photo(hr_camera, reference), truth=truth, reference=label)


def _reduced(
    image: Float[Tensor, "H W 3"], camera: Camera, views: ViewSettings, multiple: int
) -> tuple[Float[Tensor, "h w 3"], Camera]:
    """The photo reduced by `shrink`, its sizes whole multiples of `multiple`; see `ViewSettings.sizes`."""
    if views.sizes == "round":
        camera = rounded(camera, views.shrink, multiple)
        return images.resize(image, (camera.width, camera.height), views.downsample), camera
    image = images.crop_to_multiple(image, views.shrink * multiple)
    camera = replace(camera, width=image.shape[1], height=image.shape[0])
    return images.downsample(image, views.shrink, views.downsample), camera.scaled(1 / views.shrink)


def rounded(camera: Camera, shrink: int, multiple: int) -> Camera:
    """The same rays through `multiple · round(size / (shrink · multiple))` pixels, each axis by its own ratio.

    Raises:
        ValueError: no pixel would be left.
    """
    width, height = (multiple * round(size / (shrink * multiple)) for size in (camera.width, camera.height))
    x, y = width / camera.width, height / camera.height
    return replace(
        camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y, width=width, height=height
    )


def _ready_made(frame: Frame, folder: Path, camera: Camera, capture: Capture) -> Float[Tensor, "h w 3"]:
    stem = Path(frame.name).stem
    for file in list_images(folder):
        if file.stem == stem:
            path = inside(folder, file.name, file=folder)
            return read_image(path, background=capture.background, expect=(camera.width, camera.height))
    raise DataError(folder, stem, "has no LR image of this name", "name the LR images like the photos")


def _added_detail(views: Sequence[View]) -> float:
    """Mean |I_HR - U(I_LR)| in grey levels of 255; where it is next to nothing, the log says what follows from that."""
    means = [float((v.hr.image - images.upsample(v.lr.image, v.factor)).abs().mean()) for v in views]
    added = 255 * sum(means) / len(means)
    if added < _NOTHING_ADDED:
        _log.warning(
            "the reference adds %.2f grey levels to bicubic: HR still holds the field in place between LR pixels, but "
            "there is no detail to route, and no strategy can find any.", added,
        )  # fmt: skip
    return added


def _names(views: Sequence[View]) -> str:
    shown = ", ".join(v.name for v in views[:8]) + (", …" if len(views) > 8 else "")
    return f"{len(views)}: {shown}" if views else "none"


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
