"""Camera paths: closed curves of cameras through those of a run, or on an ellipse around the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float

from clear_strategies.errors import SettingError
from rasterizers.interface import Camera

_MOST_KEYS: Final = 24  # a path through more cameras passes these, as far apart as possible
_WRAP: Final = 3  # keys repeated at both ends, so that the rotation's spline has no seam
_SURROUNDED: Final = 0.5  # cameras surround the scene where the mean of the unit vectors to them is shorter than this
_BEHIND, _ABOVE = 2.0, 1.1  # of the distance of the farthest camera from the scene: where an overview stands
_SWAY: Final = 0.1  # of the distance to the scene: the radii of the ellipse for a single camera


def through(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A closed, smooth path through the cameras: splines of position and rotation, at an even pace.

    Many cameras are thinned to the `_MOST_KEYS` that lie farthest apart, and passed in the order of a short round trip. A
    single camera sways on a small ellipse. All frames have the first camera's lens and size.

    Raises:
        SettingError: there is no camera, or less than one frame.
    """
    _require(cameras, frames)
    if len(cameras) == 1:
        return ellipse(cameras, frames)
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    centers, axes = _centers(cameras), _axes(cameras)
    order = _round_trip(centers, _spread(centers, _MOST_KEYS))
    keys = np.array([order[i % len(order)] for i in range(-_WRAP, len(order) + _WRAP + 1)])
    rotations = Rotation.from_matrix(axes[keys])
    turned = np.array([(rotations[i].inv() * rotations[i + 1]).magnitude() for i in range(len(keys) - 1)])
    moved = np.linalg.norm(np.diff(centers[keys], axis=0), axis=1)
    scale = max(moved.max(), 1e-9)
    lengths = np.maximum(moved / scale + turned, 1e-3)  # the spline's parameter; never still
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    begin, end = at[_WRAP], at[_WRAP + len(order)]
    times = np.linspace(begin, end, frames, endpoint=False)
    positions = CubicSpline(at, centers[keys])(times)
    oriented = RotationSpline(at, rotations)(times).as_matrix()
    return [_placed(cameras[0], c, r) for c, r in zip(positions, oriented, strict=True)]


def ellipse(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """An ellipse through the region of the cameras, looking at the point that they look at.

    Cameras that stand around the scene give an ellipse around it, others one in front of it. All frames have the first
    camera's lens and size.

    Raises:
        SettingError: as `through`.
    """
    _require(cameras, frames)
    centers, focus, up, facing = _arranged(cameras)
    offsets = centers - focus
    if np.linalg.norm(facing) < _SURROUNDED:
        middle = focus + up * (offsets @ up).mean()
        normal = up
    else:
        middle, normal = centers.mean(0), _unit(facing)
    plane = _plane(normal, up)
    flat = (centers - middle) @ plane.T
    # The plane's axes follow the cameras' extent, so that the ellipse is as long and as narrow as their region.
    _, turn = np.linalg.eigh(flat.T @ flat + 1e-12 * np.eye(2))
    plane, flat = turn.T @ plane, flat @ turn
    radii = np.quantile(np.abs(flat), 0.9, axis=0)
    if not radii.any():  # one camera, or several at one place
        radii = np.full(2, _SWAY * max(np.linalg.norm(offsets, axis=1).mean(), 1e-6))
    angles = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1) * radii
    return [_placed(cameras[0], center, _looking(center, focus, up)) for center in middle + circle @ plane]


def overview(cameras: Sequence[Camera]) -> Camera:
    """A camera behind and above all of them that looks at what they look at, with the first one's lens and size."""
    centers, focus, up, facing = _arranged(cameras)
    offsets = centers - focus
    behind = _unit(facing if np.linalg.norm(facing) >= _SURROUNDED else offsets[0])
    center = focus + np.linalg.norm(offsets, axis=1).max() * (_BEHIND * behind + _ABOVE * up)
    return _placed(cameras[0], center, _looking(center, focus, up))


def look_at(cameras: Sequence[Camera]) -> Float[np.ndarray, " 3"]:
    """The point nearest to all optical axes; where these are all but parallel, one as far ahead as the cameras are apart,
    at least one world unit.
    """
    centers, forward = _centers(cameras), _axes(cameras)[:, :, 2]
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    system = across.mean(0)
    spread = float(np.linalg.norm(centers - centers.mean(0), axis=1).max()) if len(cameras) > 1 else 0.0
    if np.linalg.cond(system) < 1e4:
        point = np.linalg.solve(system, (across @ centers[:, :, None]).mean(0)[:, 0])
        if ((point - centers) * forward).sum(1).mean() > 0:  # ahead of the cameras
            return np.asarray(point)
    return np.asarray(centers.mean(0) + _unit(forward.mean(0)) * max(1.0, 2 * spread))


def _arranged(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The cameras' centres [C, 3], what they look at, up, and the mean direction from there to the cameras, at most 1 long."""
    centers, focus = _centers(cameras), look_at(cameras)
    offsets = centers - focus
    facing = (offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-9)).mean(0)
    return centers, focus, _unit(-_axes(cameras)[:, :, 1].mean(0)), facing


def _require(cameras: Sequence[Camera], frames: int) -> None:
    if not cameras:
        raise SettingError("a camera path needs at least one camera.")
    if frames < 1:
        raise SettingError(f"a camera path needs at least 1 frame, got {frames}.")


def _centers(cameras: Sequence[Camera]) -> Float[np.ndarray, "C 3"]:
    return np.stack([camera.center.double().cpu().numpy() for camera in cameras])


def _axes(cameras: Sequence[Camera]) -> Float[np.ndarray, "C 3 3"]:
    """Camera to world: the columns are the axes right, down and forward."""
    return np.stack([camera.world_to_camera[:3, :3].double().cpu().numpy().T for camera in cameras])


def _unit(vector: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


def _spread(centers: Float[np.ndarray, "C 3"], count: int) -> list[int]:
    """At most `count` indices, by farthest-point sampling from the first."""
    chosen = [0]
    distance = np.linalg.norm(centers - centers[0], axis=1)
    while len(chosen) < min(count, len(centers)):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(centers - centers[chosen[-1]], axis=1))
        distance[chosen] = -1
    return chosen


def _round_trip(centers: Float[np.ndarray, "C 3"], chosen: Sequence[int]) -> list[int]:
    """A short closed tour: to the nearest first, then 2-opt until nothing improves. It begins at the first."""
    left, tour = set(chosen[1:]), [chosen[0]]
    while left:
        tour.append(min(sorted(left), key=lambda i: float(np.linalg.norm(centers[i] - centers[tour[-1]]))))
        left.remove(tour[-1])

    def length(i: int, j: int) -> float:
        return float(np.linalg.norm(centers[tour[i % len(tour)]] - centers[tour[j % len(tour)]]))

    improved = len(tour) > 3
    while improved:
        improved = False
        for i in range(len(tour) - 1):
            for j in range(i + 2, len(tour)):
                gain = length(i, i + 1) + length(j, j + 1) - length(i, j) - length(i + 1, j + 1)
                if gain > 1e-9 and (j + 1) % len(tour) != i:
                    tour[i + 1 : j + 1] = reversed(tour[i + 1 : j + 1])
                    improved = True
    return tour


def _plane(normal: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "2 3"]:
    """Two unit vectors across the normal."""
    side = -_across(normal, up)
    return np.stack([side, np.cross(normal, side)])


def _looking(
    center: Float[np.ndarray, " 3"], focus: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """The axes of a camera that looks at the focus, upright."""
    forward = _unit(focus - center)
    right = _across(forward, up)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _across(direction: Float[np.ndarray, " 3"], up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The unit vector direction x up; where they are parallel, another one across the direction."""
    side = np.cross(direction, up)
    if np.linalg.norm(side) < 1e-6:
        side = np.cross(direction, np.eye(3)[int(np.abs(direction).argmin())])
    return _unit(side)


def _placed(like: Camera, center: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"]) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = axes.T
    pose[:3, 3] = -axes.T @ center
    return replace(like, world_to_camera=torch.from_numpy(pose))
