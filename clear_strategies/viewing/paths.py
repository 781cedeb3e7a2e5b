"""The path of a video: a closed curve of cameras through those of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch
from jaxtyping import Float

from clear_strategies.errors import SettingError
from rasterizers.interface import Camera

_MOST_KEYS: Final = 24  # a path through more cameras passes every n-th
_WRAP: Final = 3  # keys repeated at both ends, so that the rotation's spline has no seam
_SWAY: Final = 0.1  # of the distance to what it looks at: how far a single camera moves to each side


def through(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A closed, smooth path through the cameras: splines of position and rotation, at an even pace.

    The path goes from each camera to the nearest that is left, and passes at most `_MOST_KEYS` of them. A single camera sways
    to both sides. All frames have the first camera's lens and size.
    """
    if not cameras:
        raise SettingError("a camera path needs at least one camera.")
    if frames < 1:
        raise SettingError(f"a camera path needs at least 1 frame, got {frames}.")
    if len(cameras) == 1:
        return _swaying(cameras[0], frames)
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    centers, axes = _centers(cameras), _axes(cameras)
    order = _tour(centers)
    order = order[:: -(-len(order) // _MOST_KEYS)]
    keys = np.array([order[i % len(order)] for i in range(-_WRAP, len(order) + _WRAP + 1)])
    rotations = Rotation.from_matrix(axes[keys])
    turned = np.array([(rotations[i].inv() * rotations[i + 1]).magnitude() for i in range(len(keys) - 1)])
    moved = np.linalg.norm(np.diff(centers[keys], axis=0), axis=1)
    scale = max(moved.max(), 1e-9)
    lengths = np.maximum(moved / scale + turned, 1e-3)  # the spline's parameter; never still
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    times = np.linspace(at[_WRAP], at[_WRAP + len(order)], frames, endpoint=False)
    positions = CubicSpline(at, centers[keys])(times)
    oriented = RotationSpline(at, rotations)(times).as_matrix()
    return [_placed(cameras[0], c, r) for c, r in zip(positions, oriented, strict=True)]


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
    ahead = forward.mean(0)
    return np.asarray(centers.mean(0) + ahead / max(np.linalg.norm(ahead), 1e-12) * max(1.0, 2 * spread))


def _centers(cameras: Sequence[Camera]) -> Float[np.ndarray, "C 3"]:
    return np.stack([camera.center.double().cpu().numpy() for camera in cameras])


def _axes(cameras: Sequence[Camera]) -> Float[np.ndarray, "C 3 3"]:
    """Camera to world: the columns are the axes right, down and forward."""
    return np.stack([camera.world_to_camera[:3, :3].double().cpu().numpy().T for camera in cameras])


def _tour(centers: Float[np.ndarray, "C 3"]) -> list[int]:
    """All indices, each followed by the nearest of those that are left."""
    tour, left = [0], np.arange(1, len(centers))
    while len(left):
        nearest = int(np.linalg.norm(centers[left] - centers[tour[-1]], axis=1).argmin())
        tour.append(int(left[nearest]))
        left = np.delete(left, nearest)
    return tour


def _swaying(camera: Camera, frames: int) -> list[Camera]:
    """Positions on a small circle across the camera's axis, all in its direction."""
    (center,), (axes,) = _centers([camera]), _axes([camera])
    radius = _SWAY * float(np.linalg.norm(look_at([camera]) - center))
    angles = np.linspace(0, 2 * np.pi, frames, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes[:, :2].T
    return [_placed(camera, center + radius * offset, axes) for offset in circle]


def _placed(like: Camera, center: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"]) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = axes.T
    pose[:3, 3] = -axes.T @ center
    return replace(like, world_to_camera=torch.from_numpy(pose))
