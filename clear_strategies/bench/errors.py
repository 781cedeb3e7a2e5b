"""Where a run's squared error on its test views lies, and what PSNR each part would give if it were perfect."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from clear_strategies.bench.error_budget import SEEN_BY, SOLID, HeldOut, budget, by_view, distance_from_hull
from clear_strategies.bench.results import Results
from clear_strategies.data.prepare import photos_of
from clear_strategies.data.view_settings import split
from clear_strategies.errors import DataError
from clear_strategies.geometry.visibility import seen_by
from clear_strategies.jobs.saved import open_splat
from clear_strategies.jobs.scene import read
from clear_strategies.jobs.settings import JobSettings, settings_of
from clear_strategies.outputs import metrics
from clear_strategies.outputs.figures import ERROR_MAX, error_map, spaced

_PICTURED = 3  # test views, from the worst to the best
_COLORS = ("#ee6677", "#ccbb44", "#4477aa")  # of SEEN_BY


def measure(results: Results, *, run: Path, reference: Path | None = None) -> None:
    """Fill `results` with the parts of the error, the views, and a picture of some of them.

    `reference` is another run of the same test views; what is seen by how many views is that of `run`.

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
    field, train = splats["run"].painter, splats["run"].poses()
    depths = [(camera, field.depth(camera)) for camera in train]
    centers = torch.stack([camera.center for camera in train])
    views = []
    for frame, photo in zip(frames, photos_of(frames, view_settings), strict=True):
        views.append(
            HeldOut(
                Path(frame.name).stem,
                photo.image,
                {name: splat.painter.color(photo.camera) for name, splat in splats.items()},
                field.numbers(photo.camera, torch.ones(len(field.field))),
                seen_by(photo.camera, field.depth(photo.camera), depths),
                distance_from_hull(photo.camera.center, centers),
                1 if view_settings.photos_are == "lr" else view_settings.sr_scale,
            )
        )
    results.tables["errors"], results.tables["errors_views"] = budget(views), by_view(views)
    results.figures["errors"] = _picture(views)
    for name, splat in splats.items():
        mean = results.tables["errors_views"][f"{name}: psnr"].mean()
        results.note(f"{name}: {splat.source}; mean PSNR of {len(views)} test views {mean:.2f} dB.")
    if view_settings.photos_are == "lr":
        results.note("HR is unknown: renders at LR are compared with the LR photos.")


def _settings(run: Path) -> JobSettings:
    """The settings that a run was made with, of its metrics.json."""
    nested: dict[str, Any] = {}
    for key, value in metrics.read(run / "metrics.json", "give the folder of a finished run").config.items():
        *above, name = key.split(".")
        node = nested
        for part in above:
            node = node.setdefault(part, {})
        node[name] = value
    return settings_of(nested)


def _picture(views: Sequence[HeldOut]) -> Figure:
    """Photo, render, error and classes of some views, the worst at the top."""
    worst_first = sorted(views, key=lambda view: -float((view.images["run"] - view.truth).square().mean()))
    shown = spaced(worst_first, _PICTURED)
    height, width = shown[0].alpha.shape
    figure = Figure(figsize=(13, len(shown) * (3.2 * height / width + 0.3) + 0.3), layout="constrained")
    for axes, view in zip(figure.subplots(len(shown), 4, squeeze=False), shown, strict=True):
        truth, image = view.truth.numpy(), view.images["run"].numpy()
        classes = np.array([to_rgb(color) for color in _COLORS])[view.seen.clamp(max=2).numpy()]
        classes[(view.alpha < SOLID).numpy()] *= 0.5
        columns = {view.name: truth, "render": image, "error": error_map(image, truth), "seen by": classes}
        for axis, (title, pixels) in zip(axes, columns.items(), strict=True):
            axis.imshow(pixels, cmap="magma", vmin=0, vmax=ERROR_MAX)
            axis.set_title(title, fontsize=9)
            axis.axis("off")
    legend = [Patch(color=color, label=f"seen by {name}") for color, name in zip(_COLORS, SEEN_BY, strict=True)]
    legend.append(Patch(color="#333333", label=f"dark: alpha below {SOLID}"))
    figure.legend(handles=legend, loc="outside lower right", ncols=len(legend), fontsize=9)
    return figure
