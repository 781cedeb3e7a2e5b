"""The folder maps/: maps of the prior's evidence and of the correction of its gradients, for some training views.

Five maps per view, in [0, 1] at each HR pixel:

- `reliability` R, `demand` A and `weight` R·A: the patch evidence of a strategy that has it, enlarged.  Eq. 9, 10
- `corrected`: the share of its HR gradient that a Gaussian lost by correction, ‖g̃_HR - g_HR‖ / ‖g_HR‖ over all groups
  together.  Eq. 7, 11
- `conflict`: 1 where g_LR and g_HR of a Gaussian have a negative scalar product, else 0.  Eq. 6

The last two are renderings of the Gaussians over black with that number as their grey. The strategies are copied, so that the
run does not change. maps.jpg shows the maps side by side, with the depth of dense stereo if there is any.
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
from clear_strategies.core.evidence import PatchMaps
from clear_strategies.core.gradients import Grads
from clear_strategies.core.progress import told
from clear_strategies.core.step import Step
from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.files import Beside
from clear_strategies.kernels import reconcile
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import figures
from clear_strategies.schedules import WarmupDecay
from clear_strategies.strategies.answers import rows_like
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.field import FieldShot
from clear_strategies.viewing.look import Painter, depth_range

_log = logging.getLogger(__name__)

MAPS: Final = {
    "reliability": "reliability R\nhow far the SR image agrees with the LR photo",
    "demand": "demand A\nhow much detail is there to gain",
    "weight": "weight w = R·A\nhow much the SR image's detail counts",
    "conflict": "conflict\n1 where LR and HR gradients point apart",
    "corrected": "corrected\nby what share the HR gradient was changed",
}
"""Captions of the maps, by their names."""
_COLUMNS: Final = 3  # of maps.jpg
_NOTE: Final = (
    "reliability, demand, weight: means over pixels; corrected, conflict: means over the Gaussians that the view moves "
    "at both scales"
)
_ALWAYS_ON: Final = WarmupDecay(start=0, full=1, decay_from=1, end=1)  # λ_HR = 1 from the first iteration


class ViewMaps(NamedTuple):
    """The maps of one training view at HR, in [0, 1], and their means over pixels or Gaussians, by the names in `MAPS`:
    "corrected" only if a strategy corrects, those of patch evidence only if a strategy has it; and the render.
    """

    maps: Mapping[str, Float[Tensor, "H W"]]
    means: Mapping[str, float]
    render: Float[Tensor, "H W 3"]


def write_maps(
    folder: Path, stems: Mapping[str, str], views: Sequence[View], painter: Painter, conductor: Conductor, t: int,
    beside: Beside,
) -> dict[str, Float[Tensor, "H W 3"]]:  # fmt: skip
    """Write maps.json and, for each view, a folder of 8-bit grey PNGs (value = 255 × number) and maps.jpg.

    Args:
        stems: see `file_stems`.
        views: at least one. The other arguments are those of `view_maps`.
        beside: draws and encodes the pictures.

    Returns:
        The renders of these views by their names, for reuse.
    """
    means, renders = dict[str, Mapping[str, float]](), dict[str, Tensor]()
    for view in told(views, "maps", "views", len(views)):
        view_folder, of_view = folder / stems[view.name], view_maps(painter, conductor, view, t)
        means[view.name], renders[view.name] = of_view.means, of_view.render
        for name, values in of_view.maps.items():
            beside(write_png, view_folder / f"{name}.png", values)
        beside(_write_picture, view_folder / "maps.jpg", view, of_view)
    corrector = conductor.owner("reconcile")
    if corrector is None:
        _log.debug("maps: no strategy of this run corrects, so there is no corrected.png.")
    evidence = _evidence(conductor, views[0])
    makers = {"corrector": corrector, "evidence": None if evidence is None else evidence[0]}
    named = {part: None if maker is None else type(maker).__name__ for part, maker in makers.items()}
    files.write_json(folder / "maps.json", {"note": _NOTE, **named, "views": means})
    return renders


def view_maps(painter: Painter, conductor: Conductor, view: View, t: int) -> ViewMaps:
    """Compute the maps of one view by the strategies of the run in their state at iteration t, without dropout.

    Args:
        painter: of the run's field.
    """
    evidence = _evidence(conductor, view)
    patches = {} if evidence is None else _enlarged(evidence[1], view)
    lr, hr, corrected, render = _gradients(painter, conductor, view, t)
    numbers, compared = _compare(lr, hr, corrected)
    columns = [*numbers.values(), *[torch.zeros_like(numbers["conflict"])] * (3 - len(numbers))]
    pictures = painter.numbers(view.hr.camera, torch.stack(columns, dim=1).float()).clamp(0, 1).cpu().unbind(2)
    drawn = dict(zip(numbers, pictures, strict=False))
    means = {name: float(patch.mean()) for name, patch in patches.items()}
    means |= {name: float(values[compared].mean()) for name, values in numbers.items()}
    return ViewMaps(patches | drawn, means, render)


def _write_picture(path: Path, view: View, found: ViewMaps) -> None:
    """Draw the LR photo, the SR image, the maps, and the depth and the confidence of stereo side by side."""
    tiles = {"LR photo\nwhat the camera saw": view.lr.image, "SR image\nwhat the prior made of it": view.hr.image}
    for name in (name for name in MAPS if name in found.maps):
        tiles[MAPS[name].replace("\n", f", mean {found.means[name]:.2f}\n")] = found.maps[name]
    if (stereo := view.depth) is not None:
        depth, confidence = (x.where(stereo.known, torch.nan) for x in (stereo.depth, stereo.confidence))
        near, far = depth_range(depth)
        title = f"depth by stereo, {near:.3g} (bright) to {far:.3g} (dark) world units\nknown at {stereo.coverage:.0%}"
        tiles |= {title: (far - depth) / (far - near), "confidence of the depth": confidence}
    pixels = {name: image.detach().clamp(0, 1).cpu().numpy() for name, image in tiles.items()}
    figures.write_tiles(path, pixels, f"{view.name}: photo, SR image and maps from 0 (dark) to 1", _COLUMNS)


def _evidence(conductor: Conductor, view: View) -> tuple[Strategy, PatchMaps] | None:
    """The first strategy with patch evidence of the view, and that evidence; None if there is none."""
    known = ((s, patches) for s in conductor.strategies if (patches := s.patch_maps(view)) is not None)
    return next(known, None)


def _enlarged(patches: PatchMaps, view: View) -> dict[str, Tensor]:
    """Enlarge R, A and R·A to HR."""
    edge, camera, R, A = patches.patch * view.factor, view.hr.camera, patches.reliability, patches.demand

    def enlarged(values: Tensor) -> Tensor:
        return images.upsample(values[..., None], edge, "nearest")[: camera.height, : camera.width, 0]

    return {"reliability": enlarged(R), "demand": enlarged(A), "weight": enlarged(R * A)}


def _gradients(
    painter: Painter, conductor: Conductor, view: View, t: int
) -> tuple[Grads, Grads, Grads | None, Float[Tensor, "H W 3"]]:
    """(g_LR, g_HR before correction, g̃_HR or None if no strategy corrects at t, Î_HR on the CPU), with λ_HR = 1."""
    objective = replace(conductor.objective, lambda_hr=_ALWAYS_ON)
    aside = Conductor(*map(_in_its_run, conductor.strategies), objective=objective)
    field = painter.field
    lr, hr = (cast(FieldShot, shot) for shot in field.render_scales(painter.rasterizer, view))  # both are asked for
    (g_lr,) = lr.vjp(objective.lr(lr.image.detach(), view.lr.image, view.lr.shown).cotangents)
    # The field is drawn over the scene's own background, not over one of a strategy.
    opaque = replace(view, hr=replace(view.hr, transparency=None))
    step = Step(t, opaque, params={name: p.detach() for name, p in field.raw().items()})
    from_hr = aside.hr_gradients(hr, step)
    g_lr, g_hr = g_lr.without_detail(), from_hr.g
    if (owner := aside.owner("reconcile")) is None:
        return g_lr, g_hr, None, hr.image.detach().cpu()
    answer = rows_like(owner, "correct", owner.correct(g_lr, g_hr, from_hr.step), g_hr, "of g_HR")
    return g_lr, g_hr, answer, hr.image.detach().cpu()


def _in_its_run(strategy: Strategy) -> Strategy:
    """A copy that also knows the run, which its hooks then do not change."""
    copied = copy.copy(strategy)
    vars(copied).update(copy.deepcopy(vars(strategy)))
    return copied


def _compare(lr: Grads, hr: Grads, corrected: Grads | None) -> tuple[dict[str, Tensor], Bool[Tensor, " N"]]:
    """A number in [0, 1] per Gaussian for each map, 0 unless it has both gradients; and the mask of those that have."""
    p = reconcile.products(lr, hr)
    dot, lr2, hr2 = (x.sum(1) for x in (p.dot, p.l2, p.h2))
    compared = (lr2 > 0) & (hr2 > 0)
    numbers = {}
    if corrected is not None:
        step = corrected + hr * -1.0
        lost = reconcile.products(step, step).l2.sum(1) / hr2.clamp_min(torch.finfo(hr2.dtype).tiny)
        numbers["corrected"] = torch.where(compared, lost.sqrt().clamp(0, 1), 0.0)
    numbers["conflict"] = ((dot < 0) & compared).to(dot)
    return numbers, compared
