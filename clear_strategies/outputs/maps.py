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
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.evidence import PatchMaps
from clear_strategies.core.gradients import Grads
from clear_strategies.core.progress import Progress
from clear_strategies.core.step import Step
from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.scene import Scene
from clear_strategies.files import Beside
from clear_strategies.geometry.projection import times_seen
from clear_strategies.kernels import reconcile
from clear_strategies.merging.conductor import Conductor
from clear_strategies.outputs import figures
from clear_strategies.schedules import WarmupDecay
from clear_strategies.strategies.answers import rows_like
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.field import FieldShot
from clear_strategies.viewing.cameras import at_most
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

# Settings of maps/coverage.png, which shows how many photos see each part of the scene:
_COMPARED: Final = 64  # largest number of photos that are counted
_LONGER_SIDE: Final = 96  # px, of the depth of a photo
_SOLID: Final = 0.3  # opacity of the Gaussians that count as surface
_MOST_POINTS: Final = 60_000  # on the map
_COLORS: Final = {
    "no photo": figures.RED, "one photo": figures.YELLOW, "two photos": figures.CYAN, "three or more": figures.BLUE,
}  # fmt: skip
_CROP: Final = 0.03  # share of the points that lie beyond each side of the map
_LONGEST_NOTE: Final = 400  # characters below the map


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
    done = Progress("maps", "views", len(views))
    for view in views:
        view_folder, of_view = folder / stems[view.name], view_maps(painter, conductor, view, t)
        means[view.name], renders[view.name] = of_view.means, of_view.render
        for name, values in of_view.maps.items():
            beside(write_png, view_folder / f"{name}.png", values)
        beside(_write_picture, view_folder / "maps.jpg", view, of_view)
        done(len(means))
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


def coverage_of(scene: Scene, painter: Painter) -> tuple[Float[Tensor, "N 3"], Int[Tensor, " N"]]:
    """Points of the field's surface, and the number of training photos that see each of them."""
    field, photos = painter.field, [view.hr.camera for view in scene.train]
    small = [at_most(camera, _LONGER_SIDE) for camera in figures.spaced(photos, _COMPARED)]
    solid = field.means.data[field.opacities.data.sigmoid() > _SOLID].cpu()
    points = solid[:: -(-len(solid) // _MOST_POINTS) or 1]
    return points, times_seen(points, [(camera, painter.depth(camera)) for camera in small])


def write_coverage(path: Path, scene: Scene, painter: Painter, title: str, beside: Beside) -> None:
    """Draw the points, coloured by the number of photos that see them, fewer ones on top, and the cameras. Nothing is drawn if no
    Gaussian is a surface yet.
    """
    points, times = coverage_of(scene, painter)
    if len(points):
        beside(_draw_coverage, path, scene, points, times, title)
    else:
        _log.info("%s: left out, no Gaussian is more opaque than %g.", path.name, _SOLID)


def _draw_coverage(
    path: Path, scene: Scene, points: Float[Tensor, "N 3"], times: Int[Tensor, " N"], title: str
) -> None:
    times = times.clamp(max=len(_COLORS) - 1)
    figure, ((axis,),) = figures.new_figure(1, 1, 8, 7)
    poses = torch.stack([view.hr.camera.world_to_camera[:3, :3].double().cpu() for view in scene.train])
    places = torch.stack([view.hr.camera.center.double().cpu() for view in scene.train])
    plane = _from_above(poses)
    flat, centers, ahead = (x.numpy() @ plane for x in (points.double(), places, poses[:, 2]))
    for seen, (name, color) in reversed([*enumerate(_COLORS.items())]):
        those = (times == seen).numpy()
        label = f"seen by {name}: {those.mean():.0%}"
        axis.scatter(*flat[those].T, s=4, marker="s", color=color, linewidths=0, label=label)
    axis.quiver(*centers.T, *ahead.T, color=figures.INK, angles="xy", scale=18, width=0.005)
    inner = np.quantile(flat, (_CROP, 1 - _CROP), axis=0)
    shown = np.concatenate([inner, centers])
    margin = max(0.06 * float(np.ptp(inner, axis=0).max()), 1e-6)
    low, high = shown.min(0) - margin, shown.max(0) + margin
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set_axis_off()
    figure.legend(loc="outside lower left", ncols=2, fontsize=8, frameon=False, markerscale=4, reverse=True)
    if scene.unplaced:
        listed = "; ".join(f"{name}: {why}" for name, why in scene.unplaced.items())
        note = textwrap.fill(
            textwrap.shorten(f"without a pose, so not used: {listed}", _LONGEST_NOTE, placeholder=" …"), 110
        )
        axis.text(0, 0, note, fontsize=8, va="bottom", transform=axis.transAxes, **figures.AS_WRITTEN)
    figures.set_title(figure, f"{title}: what the photos see, from above")
    figures.save(figure, path)


def _from_above(poses: Float[Tensor, "C 3 3"]) -> Float[np.ndarray, "3 2"]:
    """The horizontal plane: right and ahead of the first camera, orthogonal to the mean of the cameras' up."""
    up = torch.nn.functional.normalize(-poses[:, 1].mean(0), dim=0)
    ahead = poses[0, 2] - (poses[0, 2] @ up) * up
    ahead = torch.nn.functional.normalize(ahead if ahead.norm() > 1e-3 else poses[0, 1], dim=0)
    return np.asarray(torch.stack([torch.linalg.cross(ahead, up), ahead], dim=1).numpy())
