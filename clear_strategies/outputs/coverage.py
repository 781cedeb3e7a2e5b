"""coverage.png and coverage.html: how many photos see each part of the scene."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.data.scene import Scene
from clear_strategies.geometry.visibility import seen_by, times_seen
from clear_strategies.outputs import figures
from clear_strategies.viewing import page
from clear_strategies.viewing.cameras import at_most
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE: Final = "coverage.png"
PAGE: Final = "coverage.html"

_ENOUGH: Final = 3  # photos that see a surface; more of them change little
_COMPARED: Final = 64  # photos whose depth is compared, at most
_LONGER_SIDE: Final = 96  # px, of the depth of a photo
_SOLID: Final = 0.3  # opacity of the Gaussians that count as surface
_MOST_POINTS: Final = 60_000  # in the page and on the map
_COLORS: Final = (figures.RED, figures.YELLOW, figures.CYAN, figures.BLUE)
_SEEN: Final = ("no photo", "one photo", "two photos", f"{_ENOUGH} or more")
_CAMERA: Final = figures.INK
_MOST_LINES: Final = 18  # of the text beside the map
_CROP: Final = 0.03  # share of the points that lie beyond each side of the map


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """What the photos of a run see.

    Args:
        photos: name of a photo -> its camera.
        points: of the field's surface. times: how many photos see each.
        shares: name of a photo, of many photos some -> shares of its pixels whose surface one, two, and three or more photos
            see, itself included.
    """

    photos: Mapping[str, Camera]
    points: Float[Tensor, "N 3"]
    times: Int[Tensor, " N"]
    shares: Mapping[str, Sequence[float]]


def coverage_of(scene: Scene, painter: Painter) -> Coverage:
    """What the training photos see of the field."""
    field, photos = painter.field, {view.name: view.hr.camera for view in scene.train}
    small = {name: at_most(photos[name], _LONGER_SIDE) for name in figures.spaced(list(photos), _COMPARED)}
    seeing = [(camera, painter.depth(camera)) for camera in small.values()]
    solid = field.means.data[field.opacities.data.sigmoid() > _SOLID].cpu()
    points = solid[:: -(-len(solid) // _MOST_POINTS) or 1]
    shares = {}
    for name, (camera, depth) in zip(small, seeing, strict=True):
        seen = seen_by(camera, depth, seeing)[depth.isfinite()].clamp(max=_ENOUGH)
        shares[name] = [int((seen == n).sum()) / max(1, len(seen)) for n in range(1, _ENOUGH + 1)]
    return Coverage(photos, points, times_seen(points, seeing), shares)


def write_coverage(folder: Path, scene: Scene, painter: Painter, title: str) -> None:
    """Write the picture, and the page where viser is installed."""
    coverage = coverage_of(scene, painter)
    _write_picture(folder / PICTURE, coverage, scene, title)
    if page.missing() is None:
        cameras = [
            page.ShownCamera(view.hr.camera, view.name, _rgb(_CAMERA), (view.lr.image.cpu() * 255).byte().numpy())
            for view in scene.train
        ]
        legend = {f"seen by {name}": _rgb(color) for name, color in zip(_SEEN, _COLORS, strict=True)}
        legend["the photos"] = _rgb(_CAMERA)
        colors = torch.from_numpy(_colored(coverage.times))
        with page.optional(PAGE):
            page.write_points_page(folder / PAGE, coverage.points, colors, cameras, title, legend)


def _rgb(color: str) -> page.RGB:
    r, g, b = bytes.fromhex(color.removeprefix("#"))
    return r, g, b


def _colored(times: Int[Tensor, "*S"]) -> Float[np.ndarray, "*S 3"]:
    palette = np.array([_rgb(color) for color in _COLORS], np.float32) / 255
    return np.asarray(palette[times.clamp(max=_ENOUGH).numpy()])


def _write_picture(path: Path, coverage: Coverage, scene: Scene, title: str) -> None:
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(13, 6), layout="constrained")
    map_axes, text_axes = figure.subplots(1, 2, width_ratios=(3, 2))
    _draw_map(map_axes, coverage)
    text_axes.set_axis_off()
    lines = "\n".join(_lines(coverage, scene))
    text_axes.text(0, 1, lines, va="top", fontsize=8.5, color=figures.INK, family="monospace", **figures.AS_WRITTEN)
    patches = [Patch(color=color, label=f"seen by {name}") for color, name in zip(_COLORS, _SEEN, strict=True)]
    map_axes.legend(handles=patches, loc="lower left", fontsize=8, framealpha=0.8, edgecolor="none")
    figures.set_title(figure, f"{title}: what the photos see, from above")
    figures.save_png(figure, path)


def _draw_map(axes: Axes, coverage: Coverage) -> None:
    """The points and the cameras from above; what fewer photos see is drawn on top."""
    poses = torch.stack([camera.world_to_camera[:3, :3].double().cpu() for camera in coverage.photos.values()])
    up = torch.nn.functional.normalize(-poses[:, 1].mean(0), dim=0)
    ahead = poses[0, 2] - (poses[0, 2] @ up) * up
    ahead = torch.nn.functional.normalize(ahead if ahead.norm() > 1e-3 else poses[0, 1], dim=0)
    plane = torch.stack([torch.linalg.cross(ahead, up), ahead], dim=1)  # [3, 2]: right and ahead of the first camera
    flat, order = (coverage.points.double() @ plane).numpy(), coverage.times.argsort(descending=True).numpy()
    axes.scatter(flat[order, 0], flat[order, 1], s=2, c=_colored(coverage.times)[order], linewidths=0)
    places = np.stack([(camera.center.double().cpu() @ plane).numpy() for camera in coverage.photos.values()])
    low, high = np.quantile(flat, (_CROP, 1 - _CROP), axis=0) if len(flat) else (places.min(0), places.max(0))
    low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    length = 0.05 * float((high - low).max())
    for (name, camera), place in zip(coverage.photos.items(), places, strict=True):
        toward = (camera.world_to_camera[2, :3].double().cpu() @ plane).numpy() * length
        axes.annotate("", place + toward, place, arrowprops={"arrowstyle": "-|>", "color": _CAMERA, "linewidth": 1.8})
        axes.annotate(
            name, place, xytext=(3, -9), textcoords="offset points", fontsize=7, color=_CAMERA, **figures.AS_WRITTEN
        )
    margin = 0.06 * (high - low).max()
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _lines(coverage: Coverage, scene: Scene) -> list[str]:
    lines = [f"{'SURFACE SEEN BY':<24}  one   two   {_ENOUGH} or more photos"]
    for name, (one, two, more) in list(coverage.shares.items())[:_MOST_LINES]:
        short = name if len(name) <= 24 else f"…{name[-23:]}"
        lines.append(f"{short:<24} {one:4.0%}  {two:4.0%}  {more:4.0%}")
    if len(coverage.photos) > _MOST_LINES:
        lines.append(f"and {len(coverage.photos) - _MOST_LINES} more")
    if scene.unplaced:
        lines += ["", "WITHOUT A POSE, so not used"]
        lines += textwrap.wrap("; ".join(f"{name}: {why}" for name, why in scene.unplaced.items()), 62)[:_MOST_LINES]
    return lines
