"""From a capture to a scene: which views train and test, their sizes, their LR photos, SR images and initial points.

Every choice here changes published numbers. Therefore every choice is written into the scene's notes, which the plan
prints.
"""

from __future__ import annotations

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
from clear_strategies.core.checks import refuse
from clear_strategies.core.images import DownKernel
from clear_strategies.core.progress import Progress
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.data.cameras import forget_maps
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.photo_files import image_size, read_image
from clear_strategies.data.photo_folders import inside
from clear_strategies.data.points import CloudSettings, initial_points, require_source
from clear_strategies.data.priors import Bicubic, Prior, fingerprint, network_of, super_resolved
from clear_strategies.data.priors.cache import kept_network_of
from clear_strategies.data.priors.interface import warn_if_far_from_lr
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_names import ViewFiles, write_pngs
from clear_strategies.data.view_settings import ViewSettings, lr_size, resized, split
from clear_strategies.errors import DataError
from clear_strategies.geometry.exposure import exposure_gains
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_READERS: Final = 4  # photos read at once, at most: each is held at its full size meanwhile
_WHOLE: Final = 0.99  # of a pixel's mask, for the pixel to be shown
_SAME_EXPOSURE: Final = 0.01  # photos whose gains are closer to 1 stay as they are
_BLURRED: Final = 3e-4  # rounding of positions, in distances of the cameras, that is a visible part of an HR pixel
_ROUNDING: Final = 0.5  # grey levels: the largest difference that rounding to 8 bits makes


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
    _warn_if_far_from_origin([frame.camera for frame in train_frames])
    progress = Progress("photos and their SR images", "photos", len(train_frames) + len(test_frames))
    frames = [*train_frames, *(replace(frame, transparency=None) for frame in test_frames)]  # only training needs it
    found, work_log = list[View](), WorkLog()
    with work_log.stage("photos and SR images"):
        for frame, reduced in zip(frames, photos_of(frames, views), strict=True):
            view = _view(frame, reduced, capture, views, prior, lr_files, required=len(found) < len(train_frames))
            shown = reduced.reduced(reduced.camera.width // view.lr.camera.width).shown
            found.append(view if shown is None else view.hiding(shown))
            progress(len(found))
    train, test = tuple(found[: len(train_frames)]), tuple(found[len(train_frames) :])
    ids = [frame.sfm_id for frame in train_frames if frame.sfm_id is not None]
    with work_log.stage("initial points"):
        initial = initial_points(
            cloud, [v.lr for v in train], hr=[v.hr for v in train], hr_is_photo=views.photos_are == "both",
            sfm=capture.points, train_ids=ids, sfm_is_train=not held_out, background=capture.background, seed=seed,
        )  # fmt: skip
    points = initial.cloud
    if initial.depths:
        train = tuple(replace(v, depth=depth) for v, depth in zip(train, initial.depths, strict=True))
    train, exposure = _equalized(train) if views.equalize else (train, {})
    sample, photo, sr = train[0], train_frames[0].camera, views.photos_are != "both"
    network = network_of(prior) if sr else None
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
        "LR": f"{_size(sample.lr.camera)}, {_lr_source(views)}",
        "HR": f"{_size(sample.hr.camera)} (x{views.sr_scale}), {'SR images: ' if sr else ''}{sample.sr_source}",
        **_hidden(train),
        **exposure,
        **_moved(train, views.downsample),
        **({} if network is None else {"SR network": f"{fingerprint(network)} (SHA-256)"}),
        **({"the SR images add": f"{_added_detail(train):.1f} grey levels to bicubic, on average"} if sr else {}),
        "initial points": f"{len(points):,}: {points.source}",
        "points use test views": points.uses_test_views,
    }
    synthetic = "synthetic" in sample.sr_source
    return Scene(capture.name, train, test, points, capture.background, synthetic, notes, capture.unplaced, work_log)


def lr_photos(frames: Sequence[Frame], capture: Capture, views: ViewSettings) -> list[Photo]:
    """The LR photos of these frames, without SR images."""
    lr_files, photos = check_headers(frames, views), photos_of(frames, views)
    return [
        _view(frame, photo, capture, views, Bicubic(), lr_files, required=True).lr
        for frame, photo in zip(frames, photos, strict=True)
    ]


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
    files, found = ViewFiles(folder, "LR image", "name the LR images like the photos"), {}
    for frame in frames:
        width, height = lr_size(frame.camera, views)
        name = files.file(frame.name).relative_to(folder).as_posix()
        file = found[frame.name] = inside(folder, name, file=folder)
        size = image_size(file)
        if size != (width, height):
            problem = f"is {size[0]}x{size[1]} where {width}x{height} is expected"
            raise DataError(file, "size", problem, "see data.views for the LR size")
    return found


def save_lr(scene: Scene, folder: Path) -> None:
    """Write the training and test LR images as PNG for an external SR model; prior=images reads its results."""
    written = write_pngs(folder, ((view.name, view.lr.image) for view in (*scene.train, *scene.test)))
    message = "%d LR images written to %s. Super-resolve them, then train with prior=images prior.path=<results>."
    _log.info(message, written, folder)


def photos_of(frames: Sequence[Frame], views: ViewSettings) -> Iterator[Photo]:
    """The photos of these frames at their HR size, where that is unknown at their LR size, in order; a few are read at once."""
    with ThreadPoolExecutor(min(torch.get_num_threads(), _READERS)) as pool:
        yield from pool.map(partial(_reduced, views=views), frames)
    forget_maps()


def at_hr(capture: Capture, views: ViewSettings) -> Capture:
    """The capture with photos that load as `photos_of` gives them, for priors that know the truth."""
    plain = (replace(frame, shown=None, transparency=None) for frame in capture.frames)
    return replace(capture, frames=tuple(replace(f, load=partial(_image, f, views)) for f in plain))


def _image(frame: Frame, views: ViewSettings) -> Float[Tensor, "H W 3"]:
    return _reduced(frame, views).image


def _view(
    frame: Frame,
    photo: Photo,
    capture: Capture,
    views: ViewSettings,
    prior: Prior,
    lr_files: Mapping[str, Path],
    *,
    required: bool,
) -> View:
    """The view of a frame and its photo. Without `required`, bicubic replaces an SR image that the prior does not have."""
    if views.photos_are == "lr":
        lr, hr_camera, truth = photo, photo.camera.scaled(views.sr_scale), None
    else:
        hr_camera, truth = photo.camera, photo.image
        lr_camera = hr_camera.scaled(1 / views.sr_scale)
        if frame.name in lr_files:
            size = (lr_camera.width, lr_camera.height)
            lr = Photo(lr_camera, read_image(lr_files[frame.name], background=capture.background, expect=size))
            check = f"{lr_files[frame.name]} shows this view, undistorted as data.save_lr writes it"
            warn_if_far_from_lr(f"{frame.name}: the photo", truth, lr.image, views.sr_scale, check)
        else:
            down = partial(images.downsample, factor=views.sr_scale, kernel=views.downsample)
            lr = Photo(lr_camera, down(truth), transparency=_of_layer(down, photo.transparency))
    if views.photos_are == "both":
        sr_source, hr = "the photos themselves", replace(photo, shown=None)
        return View(frame.name, lr, hr, truth=truth, sr_source=sr_source, background=capture.background)
    try:
        made, sr_source = super_resolved(prior, frame.name, lr.image, views.sr_scale), prior.label
    except DataError as missing:
        if required:
            raise
        _log.info("%s: no SR image for this test view (%s); bicubic replaces it.", frame.name, missing.problem)
        bicubic = Bicubic()
        made, sr_source = super_resolved(bicubic, frame.name, lr.image, views.sr_scale), bicubic.label
    hr = Photo(hr_camera, made.image, transparency=_enlarged(lr.transparency, frame.name, prior, views.sr_scale))
    return View(
        frame.name, lr, hr, truth=truth, sr_source=sr_source, disagreement=made.disagreement,
        background=capture.background,
    )  # fmt: skip


def _enlarged(
    transparency: Float[Tensor, "h w"] | None, name: str, prior: Prior, factor: int
) -> Float[Tensor, "H W"] | None:
    """Transparency at HR, enlarged by the prior's network; by bicubic where there is none, or nothing shows through."""
    seen_through = transparency is not None and bool(transparency.any())
    enlarge = (kept_network_of(prior) if seen_through else None) or Bicubic()
    return _of_layer(lambda image: enlarge(name, image, factor), transparency)


def _of_layer(
    resize: Callable[[Float[Tensor, "H W 3"]], Float[Tensor, "h w 3"]], layer: Float[Tensor, "H W"] | None
) -> Float[Tensor, "h w"] | None:
    """What resizes images, for a layer of one; None for None."""
    return None if layer is None else resize(layer[..., None].expand(-1, -1, 3).contiguous()).mean(dim=2)


def _moved(views: Sequence[View], down: DownKernel) -> dict[str, str]:
    """What back-projection has changed, a line for the plan; empty without it."""
    before = [view.disagreement for view in views if view.disagreement is not None]
    if not before:
        return {}
    after = [(images.downsample(view.hr.image, view.factor, down) - view.lr.image).abs() for view in views]
    text = f"SR images differed from the LR photos by {_grey_levels(before):.2f} grey levels, now by {_grey_levels(after):.2f}"
    return {"back-projection": text}


def _hidden(views: Sequence[View]) -> dict[str, str]:
    """What masks hide of the views, a line for the plan; empty without masks."""
    hidden = [float((~view.lr.shown).float().mean()) for view in views if view.lr.shown is not None]
    if not hidden:
        return {}
    mean = sum(hidden) / len(hidden)
    return {"masks": f"{len(hidden)} of {len(views)} training photos have one, which hides {mean:.1%} of it"}


def _equalized(train: Sequence[View]) -> tuple[tuple[View, ...], dict[str, str]]:
    """The views at their common exposure, and a line for the plan."""
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


def _grey_levels(differences: Sequence[Tensor]) -> float:
    """The mean over images of their mean difference, in grey levels of 255."""
    return 255 * sum(float(difference.mean()) for difference in differences) / len(differences)


def _reduced(frame: Frame, views: ViewSettings) -> Photo:
    """The photo at the size that `views` asks for, its transparency, and its mask: a pixel is shown if all that it covers is."""
    image, camera = frame.load(), frame.camera
    if image.shape[:2] != (camera.height, camera.width):
        problem = f"is {image.shape[1]}x{image.shape[0]}, but its camera is for {_size(camera)}"
        raise DataError(frame.name, "size", problem, "give the photo that its camera was estimated from")

    def sized(layer: Tensor) -> Tensor:
        layer = images.resize(layer, (image.shape[1], image.shape[0]), "area")  # within_limit reduces photos alone
        return _sized(layer, camera, views).image

    through = None if frame.transparency is None else _of_layer(sized, frame.transparency())
    shown = None if frame.shown is None else _of_layer(sized, frame.shown().float())
    photo = replace(_sized(image, camera, views), transparency=through)
    return photo if shown is None else replace(photo, shown=shown > _WHOLE)


def _sized(image: Tensor, camera: Camera, views: ViewSettings) -> Photo:
    """The photo reduced by `shrink`, with sizes that are whole at both scales; see `ViewSettings.sizes`."""
    multiple = 1 if views.photos_are == "lr" else views.sr_scale
    if views.sizes == "round":
        width, height = (multiple * size for size in lr_size(camera, views))
        camera = resized(camera, width, height)
        return Photo(camera, images.resize(image, (width, height), views.downsample))
    image = images.crop_to_multiple(image, views.shrink * multiple)
    camera = replace(camera, width=image.shape[1], height=image.shape[0])
    return Photo(camera.scaled(1 / views.shrink), images.downsample(image, views.shrink, views.downsample))


def _lr_source(views: ViewSettings) -> str:
    """Where the LR photos come from, for the plan."""
    if views.photos_are == "lr":
        return "the photos themselves; HR is unknown"
    if views.lr_folder is not None:
        return f"read from {views.lr_folder} (D is taken to be {views.downsample})"
    by = "" if views.downsample == "area" else "PIL "
    return f"{by}{views.downsample} of the {'HR photo' if views.photos_are == 'hr' else 'photos'}"


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


def _warn_if_far_from_origin(cameras: Sequence[Camera]) -> None:
    """Warn where float32 cannot place Gaussians to a part of a pixel, as in a capture with geographic coordinates."""
    centers = torch.stack([camera.center.double() for camera in cameras])
    away = float(torch.linalg.vector_norm(centers.mean(0)))
    apart = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=1).max())
    rounded = away * torch.finfo(torch.float32).eps / 2
    if rounded > _BLURRED * apart > 0:
        _log.warning(
            "the cameras lie within %.3g units of their mean but %.3g from the origin, where float32 rounds positions to %.2g: "
            "stereo and training lose detail. Subtract the same point from all camera centres and points of the capture.",
            apart, away, rounded,
        )  # fmt: skip


def _size(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"
