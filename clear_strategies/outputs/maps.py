"""maps/: where a run trusted its prior, and where the photos overruled it, for some of its training views.

Five maps per view, in [0, 1] at each HR pixel:

- `reliability` R, `demand` A and `weight` R·A: the patch evidence of a strategy that has it, enlarged.  Eq. 9, 10
- `corrected`: the share of its HR gradient that a Gaussian lost by correction, ‖g̃_HR - g_HR‖ / ‖g_HR‖ over all groups
  together.  Eq. 7, 11
- `conflict`: 1 where g_LR and g_HR of a Gaussian point apart, else 0.  Eq. 6

The last two render the Gaussians over black with that number as their grey. The strategies are copied, so that the run does not
change. maps.png shows the maps side by side, with the depth that dense stereo found, where it did.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.conflicts import GradientColumns
from clear_strategies.core.evidence import PatchMaps
from clear_strategies.core.gradients import Grads
from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.view_names import file_stem
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import figures
from clear_strategies.schedules import WarmupDecay
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.field import FieldShot, GaussianField
from clear_strategies.viewing.look import DEPTH_COLORS, DepthScale, Painter
from rasterizers.interface import Rasterizer

_log = logging.getLogger(__name__)

MAPS: Final = {
    "reliability": "reliability R\nhow far the SR image agrees with the LR photo",
    "demand": "demand A\nhow much detail is there to gain",
    "weight": "weight w = R·A\nhow much the SR image's detail counts",
    "conflict": "conflict\n1 where LR and HR gradients point apart",
    "corrected": "corrected\nthe share of the HR gradient that was taken away",
}
"""The maps, and what they mean."""
_COLUMNS: Final = 4  # of maps.png
_NOTE: Final = (
    "reliability, demand, weight: means over pixels; corrected, conflict: means over the Gaussians that the view moves "
    "at both scales"
)
_ALWAYS_ON: Final = WarmupDecay(start=0, full=1, decay_from=1, end=1)  # λ_HR = 1 from the first iteration


class ViewMaps(NamedTuple):
    """The maps of one training view at HR, in [0, 1], and their means over pixels or Gaussians, by the names in `MAPS`:
    "corrected" only where a strategy corrects, those of patch evidence only where a strategy has it.
    """

    maps: Mapping[str, Float[Tensor, "H W"]]
    means: Mapping[str, float]


def write_maps(
    folder: Path, views: Sequence[View], painter: Painter, conductor: Conductor, rasterizer: Rasterizer, t: int
) -> None:
    """Write maps.json and, for each view, a folder of 8-bit grey PNGs (value = 255 × number) and maps.png.

    Args:
        views: at least one. The other arguments are those of `view_maps`.
    """
    means: dict[str, Mapping[str, float]] = {}
    for view in views:
        view_folder, of_view = folder / file_stem(view.name), view_maps(painter, conductor, rasterizer, view, t)
        means[view.name] = of_view.means
        for name, values in of_view.maps.items():
            write_png(view_folder / f"{name}.png", values)
        _write_picture(view_folder / "maps.png", view, of_view)
    corrector = conductor.owner("correct")
    if corrector is None:
        _log.debug("maps: no strategy of this run corrects, so there is no corrected.png.")
    evidence = _evidence(conductor, views[0])
    makers = {"corrector": corrector, "evidence": None if evidence is None else evidence[0]}
    named = {part: None if maker is None else type(maker).__name__ for part, maker in makers.items()}
    files.write_json(folder / "maps.json", {"note": _NOTE, **named, "views": means})


def view_maps(painter: Painter, conductor: Conductor, rasterizer: Rasterizer, view: View, t: int) -> ViewMaps:
    """The maps of one view by the strategies of the run as they are at iteration t, without dropout.

    Args:
        painter: of the run's field. rasterizer: of the run.
    """
    evidence = _evidence(conductor, view)
    patches = {} if evidence is None else _enlarged(evidence[1], view)
    numbers, compared = _compare(*_gradients(painter.field, conductor, rasterizer, view, t))
    drawn = {name: painter.numbers(view.hr.camera, values).clamp(0, 1) for name, values in numbers.items()}
    means = {name: float(patch.mean()) for name, patch in patches.items()}
    return ViewMaps(patches | drawn, means | {name: float(values[compared].mean()) for name, values in numbers.items()})


def _write_picture(path: Path, view: View, found: ViewMaps) -> None:
    """Draw the LR photo, the SR image, the maps, and the depth and the confidence of stereo side by side; grey is unknown."""
    panels: list[tuple[str, Tensor, str, tuple[float, float]]] = [
        ("LR photo\nwhat the camera saw", view.lr.image, "", (0.0, 1.0)),
        ("SR image\nwhat the prior made of it", view.hr.image, "", (0.0, 1.0)),
    ]
    for name in (name for name in MAPS if name in found.maps):
        title = MAPS[name].replace("\n", f", mean {found.means[name]:.2f}\n")
        panels.append((title, found.maps[name], "viridis", (0.0, 1.0)))
    if (stereo := view.depth) is not None:
        depth, confidence = (x.where(stereo.known, torch.nan) for x in (stereo.depth, stereo.confidence))
        scale = DepthScale.spanning(depth)
        title = f"depth by stereo, world units\nknown at {stereo.coverage:.0%}"
        panels.append((title, depth, DEPTH_COLORS, (scale.near, scale.far)))
        panels.append(("confidence of the depth", confidence, "viridis", (0.0, 1.0)))
    columns = min(_COLUMNS, len(panels))
    rows, height = -(-len(panels) // columns), 4 * view.hr.camera.height / view.hr.camera.width + 0.7
    from matplotlib import colormaps

    figure, axes = figures.new_figure(rows, columns, 4.5 * columns, rows * height + 0.4)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (title, image, colors, span) in zip(axes.flat, panels, strict=False):
        axis.set_title(title, fontsize=9)
        pixels = (image.clamp(0, 1) if not colors else image).detach().cpu().numpy()
        shown = colormaps[colors or "gray"].with_extremes(bad=figures.RULE)
        drawn = axis.imshow(pixels, cmap=shown, vmin=span[0], vmax=span[1], interpolation="nearest")
        if colors:
            figure.colorbar(drawn, ax=axis, shrink=0.8)
    figures.set_title(figure, f"{view.name}: where the SR image is believed, and where the photo overrules it")
    figures.save_png(figure, path)


def _evidence(conductor: Conductor, view: View) -> tuple[Strategy, PatchMaps] | None:
    """The strategy that has patch evidence of the view, and that evidence."""
    known = ((s, patches) for s in conductor.strategies if (patches := s.patch_maps(view)) is not None)
    return next(known, None)


def _enlarged(patches: PatchMaps, view: View) -> dict[str, Tensor]:
    """R, A and R·A at HR."""
    edge, camera, R, A = patches.patch * view.factor, view.hr.camera, patches.reliability, patches.demand

    def enlarged(values: Tensor) -> Tensor:
        return images.upsample(values[..., None], edge, "nearest")[: camera.height, : camera.width, 0]

    return {"reliability": enlarged(R), "demand": enlarged(A), "weight": enlarged(R * A)}


def _gradients(
    field: GaussianField, conductor: Conductor, rasterizer: Rasterizer, view: View, t: int
) -> tuple[Grads, Grads, Grads | None]:
    """g_LR, g_HR before correction, and g̃_HR where a strategy corrects at t, whatever λ_HR is then."""
    objective = replace(conductor.objective, lambda_hr=_ALWAYS_ON)
    aside = Conductor(*copy.deepcopy(conductor.strategies), objective=objective)
    lr, hr = (cast(FieldShot, shot) for shot in field.render_scales(rasterizer, view))  # both scales are asked for
    (g_lr,) = lr.vjp(objective.lr(lr.image.detach(), view.lr.image, view.lr.shown).cotangents)
    # The field is drawn over the scene's own background, whichever one a strategy would choose.
    opaque = replace(view, hr=replace(view.hr, transparency=None))
    merged = aside.merge(field.raw(), g_lr, aside.hr_gradients(hr, opaque, t), t)
    corrects = aside.owner("correct") is not None
    return g_lr, cast(Grads, merged.hr), merged.corrected if corrects else None


def _compare(lr: Grads, hr: Grads, corrected: Grads | None) -> tuple[dict[str, Tensor], Bool[Tensor, " N"]]:
    """A number in [0, 1] per Gaussian for each map, and which Gaussians have both gradients: the others are 0."""
    p = GradientColumns.of(lr, hr).products()
    dot, lr2, hr2 = (x.sum(1) for x in (p.dot, p.l2, p.h2))
    compared = (lr2 > 0) & (hr2 > 0)
    numbers = {}
    if corrected is not None:
        step = corrected + hr * -1.0
        lost = GradientColumns.of(step, step).products().l2.sum(1) / hr2.clamp_min(torch.finfo(hr2.dtype).tiny)
        numbers["corrected"] = torch.where(compared, lost.sqrt().clamp(0, 1), 0.0)
    numbers["conflict"] = ((dot < 0) & compared).to(dot)
    return numbers, compared
