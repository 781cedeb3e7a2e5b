"""Where a run's squared error on its test views lies, and what PSNR each part would give if it were perfect.

Every group of parts is a partition, so its shares add up to 1: pixels are counted once, and the waves are those of an
orthonormal cosine transform, which keeps sums of squares.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import torch
from jaxtyping import Float, Int
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from scipy.fft import dctn
from scipy.optimize import nnls
from torch import Tensor

from clear_strategies.bench.results import Results
from clear_strategies.data.prepare import photos_of
from clear_strategies.data.view_settings import split
from clear_strategies.errors import DataError
from clear_strategies.geometry.visibility import seen_by
from clear_strategies.jobs.saved import open_splat
from clear_strategies.jobs.scene import read
from clear_strategies.jobs.settings import JobSettings, settings_of
from clear_strategies.outputs import metrics
from clear_strategies.outputs.figures import BLUE, ERROR_MAX, RED, YELLOW, error_map, spaced

_SOLID: Final = 0.9  # alpha below it counts as a hole
_OUTSIDE: Final = 0.25  # a camera farther than this from the training cameras is outside, see `distance_from_hull`
_SEEN_BY: Final = ("no training view", "one", "several")
_STEEPEST: Final = 0.2  # the share of a photo's pixels that are its edges
_PICTURED: Final = 3  # test views, from the worst to the best
_COLORS: Final = (RED, YELLOW, BLUE)  # of _SEEN_BY
_WAVES: Final = (1, 4, 16)  # the longest wave of each band, in the shortest waves that the LR photos hold


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """A test view, drawn.

    Args:
        images: renders in [0, 1] by the name of their run.
        seen: the number of training views that see the surface at each pixel.
        distance: from the hull of the training cameras.
        factor: pixels per LR pixel.
    """

    name: str
    truth: Float[Tensor, "H W 3"]
    images: Mapping[str, Float[Tensor, "H W 3"]]
    alpha: Float[Tensor, "H W"]
    seen: Int[Tensor, "H W"]
    distance: float
    factor: int


def measure(results: Results, *, run: Path, reference: Path | None = None) -> None:
    """Fill `results` with the parts of the error, the views, and a picture of some of them.

    Args:
        reference: another run of the same test views. How many views see a surface is measured in `run` alone.

    Raises:
        DataError: a folder holds no finished run, it has no test views, or its data are not there.
    """
    splats = {"run": open_splat(run)} | ({} if reference is None else {"reference": open_splat(reference)})
    settings = _settings(run)
    capture, view_settings = read(settings.data, settings.prior)
    _, frames = split(capture, view_settings)
    if not frames:
        remedy = "train with test views: data.views.test_every=8"
        raise DataError(run, "test views", "there are none, and training photos say nothing of the error", remedy)
    painter, train = splats["run"].painter, splats["run"].poses()
    depths = [(camera, painter.depth(camera)) for camera in train]
    centers = torch.stack([camera.center for camera in train])
    views = [
        HeldOut(
            name=Path(frame.name).stem,
            truth=photo.image,
            images={name: splat.painter.color(photo.camera) for name, splat in splats.items()},
            alpha=painter.numbers(photo.camera, torch.ones(len(painter.field))),
            seen=seen_by(photo.camera, painter.depth(photo.camera), depths),
            distance=distance_from_hull(photo.camera.center, centers),
            factor=1 if view_settings.photos_are == "lr" else view_settings.sr_scale,
        )
        for frame, photo in zip(frames, photos_of(frames, view_settings), strict=True)
    ]
    results.tables["errors"], results.tables["errors_views"] = budget(views), by_view(views)
    results.figures["errors"] = _picture(views)
    for name, splat in splats.items():
        mean = results.tables["errors_views"][f"{name}: psnr"].mean()
        results.note(f"{name}: {splat.source}; mean PSNR of {len(views)} test views {mean:.2f} dB.")
    if view_settings.photos_are == "lr":
        results.note("HR is unknown: renders at LR are compared with the LR photos.")


def _settings(run: Path) -> JobSettings:
    """The settings of a run, from its metrics.json."""
    nested: dict[str, Any] = {}
    for key, value in metrics.read(run / "metrics.json", "give the folder of a finished run").config.items():
        *above, name = key.split(".")
        node = nested
        for part in above:
            node = node.setdefault(part, {})
        node[name] = value
    return settings_of(nested)


def distance_from_hull(center: Float[Tensor, " 3"], centers: Float[Tensor, "V 3"]) -> float:
    """The distance from the convex hull of `centers`, as a share of the largest distance between two of them.

    inf where the hull is a single point.
    """
    points = (centers - center).double().numpy()
    scale = float(torch.pdist(centers.double()).max()) if len(centers) > 1 else 0.0
    # The nearest point of the hull is a mean with weights >= 0 whose sum a heavy equation holds at 1.
    heavy = 1e3 * max(float(np.abs(points).max()), 1e-12)
    _, residual = nnls(np.vstack((points.T, np.full(len(points), heavy))), np.array([0, 0, 0, heavy]))
    return residual / scale if scale > 0 else math.inf


def waves(error: Float[Tensor, "H W 3"], factor: int) -> dict[str, float]:
    """The sum of squares of an error image by the length of its waves in pixels; "bias" is each channel's mean.

    Waves shorter than 2 · `factor` pixels are beyond the LR photos.
    """
    height, width = error.shape[:2]
    power = (dctn(error.double().numpy(), axes=(0, 1), norm="ortho") ** 2).sum(axis=2)
    frequency = np.hypot(np.arange(height)[:, None] / height, np.arange(width) / width) / 2  # cycles per pixel
    limits = [2 * factor * longest for longest in _WAVES]
    band = np.searchsorted([1 / limit for limit in reversed(limits)], frequency, side="right")
    band[0, 0] = -1
    between = [f"{short} to {long} px" for short, long in itertools.pairwise(limits)]
    names = ("bias", f"over {limits[-1]} px", *reversed(between), f"under {limits[0]} px, beyond LR")
    return {name: float(power[band == i - 1].sum()) for i, name in enumerate(names)}


def parts(view: HeldOut) -> Iterator[dict[str, object]]:
    """The pixels and the squared error of every part of every group, for each run of a view."""
    down, right = torch.gradient(view.truth.mean(dim=2))
    steepness = torch.hypot(down, right).double()
    edge = steepness > torch.quantile(steepness.flatten()[:: max(1, steepness.numel() >> 20)], 1 - _STEEPEST)
    several, hole = view.seen.clamp(max=2), view.alpha < _SOLID
    outside = torch.full_like(hole, view.distance > _OUTSIDE)
    masks = [
        ("all", "all pixels", torch.ones_like(hole)),
        *(("seen by", name, several == i) for i, name in enumerate(_SEEN_BY)),
        ("alpha", f"below {_SOLID}", hole), ("alpha", f"from {_SOLID}", ~hole),
        ("edges", "steepest fifth", edge), ("edges", "the rest", ~edge),
        ("camera", "in the training cameras' hull", ~outside), ("camera", "outside of it", outside),
    ]  # fmt: skip
    for run, image in view.images.items():
        error = image - view.truth
        squared = error.double().square().sum(dim=2)
        for group, part, mask in masks:
            of_part = float(squared[mask].sum())
            yield {"run": run, "group": group, "part": part, "pixels": int(mask.sum()), "error": of_part}
        for part, power in waves(error, view.factor).items():
            yield {"run": run, "group": "waves", "part": part, "pixels": squared.numel(), "error": power}


def budget(views: Sequence[HeldOut]) -> pd.DataFrame:
    """A row for each part of each group, over all views.

    Returns:
        group, part; pixels: their share; of each run: its share of the squared error, its PSNR there, and what the PSNR of all
        pixels would be if it had no error there, dB. PSNR is that of the mean over all pixels of all views.
    """
    rows = pd.DataFrame([row for view in views for row in parts(view)])
    everything = sum(view.alpha.numel() for view in views)
    columns: list[pd.DataFrame | pd.Series[float]] = []
    for run, of_run in rows.groupby("run", sort=False):
        table = of_run.groupby(["group", "part"], sort=False)[["pixels", "error"]].sum()
        total = table.loc[("all", "all pixels"), "error"]
        measures = {
            "share": table["error"] / total,
            "psnr": _psnr(table["error"], table["pixels"]),
            "if perfect": _psnr(total - table["error"], everything),
        }
        columns = columns or [table["pixels"] / everything]
        columns.append(pd.DataFrame(measures).add_prefix(f"{run}: "))
    return pd.concat(columns, axis=1).reset_index()


def by_view(views: Sequence[HeldOut]) -> pd.DataFrame:
    """A row for each view: PSNR of each run, distance from the training cameras, and shares of its pixels."""
    rows = []
    for view in views:
        squared = {f"{run}: psnr": (image - view.truth).double().square() for run, image in view.images.items()}
        row: dict[str, Any] = {"view": view.name}
        row |= {column: _psnr(float(error.sum()), view.alpha.numel()) for column, error in squared.items()}
        row |= {"distance": view.distance}
        row |= {name: float((view.seen.clamp(max=2) == i).double().mean()) for i, name in enumerate(_SEEN_BY)}
        rows.append(row | {"holes": float((view.alpha < _SOLID).double().mean())})
    return pd.DataFrame(rows)


def _psnr(squared_error: Any, pixels: Any) -> Any:
    """Decibels of a sum over pixels and channels; nan where there are none."""
    return -10 * np.log10(np.maximum(squared_error / (3 * pixels), 1e-10))


def _picture(views: Sequence[HeldOut]) -> Figure:
    """Photo, render, error and classes of some views, the worst at the top."""
    worst_first = sorted(views, key=lambda view: -float((view.images["run"] - view.truth).square().mean()))
    shown = spaced(worst_first, _PICTURED)
    height, width = shown[0].alpha.shape
    figure = Figure(figsize=(13, len(shown) * (3.2 * height / width + 0.3) + 0.3), layout="constrained")
    for axes, view in zip(figure.subplots(len(shown), 4, squeeze=False), shown, strict=True):
        truth, image = view.truth.numpy(), view.images["run"].numpy()
        classes = np.array([to_rgb(color) for color in _COLORS])[view.seen.clamp(max=2).numpy()]
        classes[(view.alpha < _SOLID).numpy()] *= 0.5
        columns = {view.name: truth, "render": image, "error": error_map(image, truth), "seen by": classes}
        for axis, (title, pixels) in zip(axes, columns.items(), strict=True):
            axis.imshow(pixels, cmap="magma", vmin=0, vmax=ERROR_MAX)
            axis.set_title(title, fontsize=9)
            axis.axis("off")
    legend = [Patch(color=color, label=f"seen by {name}") for color, name in zip(_COLORS, _SEEN_BY, strict=True)]
    legend.append(Patch(color="#333333", label=f"dark: alpha below {_SOLID}"))
    figure.legend(handles=legend, loc="outside lower right", ncols=len(legend), fontsize=9)
    return figure
