"""maps/coverage.png: how many photos see each part of the scene, from above."""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.data.scene import Scene
from clear_strategies.geometry.projection import times_seen
from clear_strategies.outputs import figures
from clear_strategies.viewing.cameras import at_most
from clear_strategies.viewing.look import Painter

_COMPARED: Final = 64  # photos whose depth is compared, at most
_LONGER_SIDE: Final = 96  # px, of the depth of a photo
_SOLID: Final = 0.3  # opacity of the Gaussians that count as surface
_MOST_POINTS: Final = 60_000  # on the map
_COLORS: Final = {
    "no photo": figures.RED, "one photo": figures.YELLOW, "two photos": figures.CYAN, "3 or more": figures.BLUE,
}  # fmt: skip
_CROP: Final = 0.03  # share of the points that lie beyond each side of the map
_NOTE: Final = 400  # characters below the map


def coverage_of(scene: Scene, painter: Painter) -> tuple[Float[Tensor, "N 3"], Int[Tensor, " N"]]:
    """Points of the field's surface, and how many training photos see each of them."""
    field, photos = painter.field, [view.hr.camera for view in scene.train]
    small = [at_most(camera, _LONGER_SIDE) for camera in figures.spaced(photos, _COMPARED)]
    solid = field.means.data[field.opacities.data.sigmoid() > _SOLID].cpu()
    points = solid[:: -(-len(solid) // _MOST_POINTS) or 1]
    return points, times_seen(points, [(camera, painter.depth(camera)) for camera in small])


def write_coverage(path: Path, scene: Scene, painter: Painter, title: str) -> None:
    """Draw the points in the colours of how many photos see them, and the cameras; what fewer photos see lies on top."""
    points, times = coverage_of(scene, painter)
    times = times.clamp(max=len(_COLORS) - 1)
    figure, ((axis,),) = figures.new_figure(1, 1, 8, 7)
    poses = torch.stack([view.hr.camera.world_to_camera[:3, :3].double().cpu() for view in scene.train])
    places = torch.stack([view.hr.camera.center.double().cpu() for view in scene.train])
    plane = _from_above(poses)
    flat, centers, ahead = (x.numpy() @ plane for x in (points.double(), places, poses[:, 2]))
    for seen, (name, color) in reversed([*enumerate(_COLORS.items())]):
        those = (times == seen).numpy()
        share = those.mean() if len(those) else 0
        axis.scatter(*flat[those].T, s=4, marker="s", color=color, linewidths=0, label=f"seen by {name}: {share:.0%}")
    axis.quiver(*centers.T, *ahead.T, color=figures.INK, angles="xy", scale=18, width=0.005)
    inner = np.quantile(flat, (_CROP, 1 - _CROP), axis=0) if len(flat) else centers
    shown = np.concatenate([inner, centers])
    margin = max(0.06 * float(np.ptp(inner, axis=0).max()), 1e-6)
    low, high = shown.min(0) - margin, shown.max(0) + margin
    axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axis.set_axis_off()
    figure.legend(loc="outside lower left", ncols=2, fontsize=8, frameon=False, markerscale=4, reverse=True)
    if scene.unplaced:
        listed = "; ".join(f"{name}: {why}" for name, why in scene.unplaced.items())
        note = textwrap.fill(textwrap.shorten(f"without a pose, so not used: {listed}", _NOTE, placeholder=" …"), 110)
        axis.text(0, 0, note, fontsize=8, va="bottom", transform=axis.transAxes, **figures.AS_WRITTEN)
    figures.set_title(figure, f"{title}: what the photos see, from above")
    figures.save_png(figure, path)


def _from_above(poses: Float[Tensor, "C 3 3"]) -> Float[np.ndarray, "3 2"]:
    """Right and ahead of the first camera, across the mean of the cameras' up."""
    up = torch.nn.functional.normalize(-poses[:, 1].mean(0), dim=0)
    ahead = poses[0, 2] - (poses[0, 2] @ up) * up
    ahead = torch.nn.functional.normalize(ahead if ahead.norm() > 1e-3 else poses[0, 1], dim=0)
    return np.asarray(torch.stack([torch.linalg.cross(ahead, up), ahead], dim=1).numpy())
