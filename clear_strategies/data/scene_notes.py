"""The notes of a scene, as the plan prints them: a line for each choice of `prepare` that changes published numbers."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import View
from clear_strategies.data.capture import Capture
from clear_strategies.data.priors import Prior, fingerprint, network_of
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.errors import counted
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_ROUNDING: Final = 0.5  # grey levels: the largest difference that rounding to 8 bits makes


def scene_notes(
    capture: Capture,
    views: ViewSettings,
    prior: Prior,
    train: Sequence[View],
    test: Sequence[View],
    photo: Camera,
    points: PointCloud,
    exposure: Mapping[str, str],
) -> dict[str, str]:
    """The notes of a scene, in the order of the plan; `photo`: the camera of the first training photo in the capture."""
    sample, sr = train[0], views.photos_are != "both"
    others = " and other sizes" if len({size_of(view.lr.camera) for view in train}) > 1 else ""
    network = network_of(prior) if sr else None
    unused = len(capture.frames) - len(train) - len(test)
    none = f"none{'' if unused else ': all are trained on'} (data.views.test_every=8 keeps every 8th for testing)"
    notes = {
        "scene": f"{capture.name}, {counted(len(capture.frames), 'photo')}",
        **capture.notes,
        "train views": _names(train) + (f"; not used: {counted(unused, 'photo')} (data.views)" if unused else ""),
        "test views": _names(test) if test else none,
        "sizes": f"photos of {size_of(photo)}, shrink {views.shrink}, {views.sizes} to whole pixels at both scales",
        "LR": f"{size_of(sample.lr.camera)}{others}, {_lr_source(views)}",
        "HR": f"{size_of(sample.hr.camera)}{others} (x{views.sr_scale}), {'SR images: ' if sr else ''}{sample.sr_source}",
        "masks": _masks(train),
        **exposure,
        "back-projection": _back_projection(train, views.downsample),
        "SR network": None if network is None else f"{fingerprint(network)} (SHA-256)",
        "the SR images add": _added_detail(train) if sr else None,
        "initial points": f"{len(points):,}: {points.source}",
        "points use test views": points.uses_test_views,
    }
    return {label: fact for label, fact in notes.items() if fact is not None}


def size_of(camera: Camera) -> str:
    return f"{camera.width}x{camera.height}"


def _names(views: Sequence[View]) -> str:
    return f"{len(views)}: {', '.join(v.name for v in views[:8])}{', …' if len(views) > 8 else ''}"


def _lr_source(views: ViewSettings) -> str:
    if views.photos_are == "lr":
        reduced = "themselves" if views.shrink == 1 else f"reduced {views.shrink} times"
        return f"the photos {reduced}; HR is unknown"
    if views.lr_folder is not None:
        return f"read from {views.lr_folder} (D is taken to be {views.downsample})"
    by = "" if views.downsample == "area" else "PIL "
    return f"{by}{views.downsample} of the {'HR photo' if views.photos_are == 'hr' else 'photos'}"


def _masks(views: Sequence[View]) -> str | None:
    if not (hidden := [float((~view.lr.shown).float().mean()) for view in views if view.lr.shown is not None]):
        return None
    mean = sum(hidden) / len(hidden)
    return f"{len(hidden)} of {len(views)} training photos have one, which hides {mean:.1%} of it"


def _back_projection(views: Sequence[View], down: DownKernel) -> str | None:
    if not (before := [view.disagreement for view in views if view.disagreement is not None]):
        return None
    after = ((images.downsample(view.hr.image, view.factor, down) - view.lr.image).abs() for view in views)
    return f"SR images differed from the LR photos by {_grey_levels(before):.2f} grey levels, now by {_grey_levels(after):.2f}"


def _added_detail(views: Sequence[View]) -> str:
    """Mean |I_HR - U(I_LR)| in grey levels of 255. Logs a warning if there is no detail."""
    added = _grey_levels((v.hr.image - images.upsample(v.lr.image, v.factor)).abs() for v in views)
    if added < _ROUNDING:
        _log.warning(
            "the SR images differ from bicubic interpolation by %.2f grey levels only. They hold hardly any detail, so the "
            "strategies can add none.", added,
        )  # fmt: skip
    return f"{added:.1f} grey levels to bicubic interpolation, on average"


def _grey_levels(differences: Iterable[Tensor]) -> float:
    """The mean over images of their mean difference, in grey levels of 255. A generator keeps one difference in memory."""
    means = [float(difference.mean()) for difference in differences]
    return 255 * sum(means) / len(means)
