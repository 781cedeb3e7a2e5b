"""The cameras of a run as a file, and a path through them.

A run writes `cameras.json` in the layout of Inria's 3DGS, which SuperSplat and SIBR open: a list of {"id", "img_name",
"width", "height", "position", "rotation" (camera to world, OpenCV axes), "fx", "fy"}. Ours adds "cx", "cy", "split" ("train",
"test") and "background" (RGB).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import torch
from jaxtyping import Float

from clear_strategies import files
from clear_strategies.data import strict_json
from clear_strategies.data.capture import rigid_inverse
from clear_strategies.data.file_names import require_text
from clear_strategies.data.scene import Scene
from clear_strategies.data.strict_json import Number, typed
from clear_strategies.errors import DataError
from rasterizers.interface import Camera, Color

FILE: Final = "cameras.json"
_MOST_KEYS: Final = 24  # a path through more cameras passes every n-th
_FAR: Final = 2.0  # in longest steps: ends of a path further apart are not joined, since the scene may lie between them
_WRAP: Final = 3  # keys repeated at both ends, so that the rotation's spline has no seam
_SWAY: Final = 0.1  # world units by which a single camera moves to each side


@dataclass(frozen=True, slots=True, eq=False)
class SavedCamera:
    """A camera of a run.

    Args:
        camera: at HR. split: train or test.
        background: behind the Gaussians, RGB in [0, 1].
    """

    name: str
    camera: Camera
    split: str
    background: Color


_Vector = tuple[Number, Number, Number]


class _Entry(msgspec.Struct):
    width: Number
    height: Number
    fx: Number
    fy: Number
    rotation: tuple[_Vector, _Vector, _Vector]
    position: _Vector
    cx: Number | None = None
    cy: Number | None = None
    img_name: str | None = None
    split: str = "train"
    background: Color = (0.0, 0.0, 0.0)


def write_cameras(folder: Path, scene: Scene) -> None:
    entries = []
    for number, view in enumerate((*scene.train, *scene.test)):
        camera = view.hr.camera
        entry = {
            "id": number, "img_name": view.name, "width": camera.width, "height": camera.height,
            "position": camera.center.tolist(), "rotation": camera.world_to_camera.double()[:3, :3].T.tolist(),
            "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
            "split": "train" if number < len(scene.train) else "test", "background": list(scene.background),
        }  # fmt: skip
        entries.append(entry)
    files.write_json(folder / FILE, entries)


def read_cameras(path: Path) -> list[SavedCamera]:
    """Read the cameras of a run of this package or of Inria's 3DGS; a DataError if the file is invalid."""
    remedy, found = "give the cameras.json of a run", list[SavedCamera]()
    for i, e in enumerate(typed(path, strict_json.read(path), list[_Entry], remedy=remedy)):
        pose = rigid_inverse(path, f"[{i}].rotation", np.array(e.rotation), np.array(e.position))
        width, height = round(e.width), round(e.height)
        cx, cy = width / 2 if e.cx is None else e.cx, height / 2 if e.cy is None else e.cy
        name = str(i) if e.img_name is None else e.img_name
        try:
            require_text([name])
            camera = Camera(pose, e.fx, e.fy, cx, cy, width, height)
        except ValueError as error:
            raise DataError(path, f"[{i}]", str(error), "correct the camera") from error
        found.append(SavedCamera(name, camera, e.split, e.background))
    if not found:
        raise DataError(path, "json", "is an empty list", remedy)
    return found


def at_most(camera: Camera, longest: int | None) -> Camera:
    """Rescale a camera to even numbers of pixels, as videos need them, and a longer edge of at most `longest` pixels."""
    edge = max(camera.width, camera.height)
    times = 1.0 if longest is None else min(1.0, longest / edge)
    return camera.resized(*(max(2, 2 * round(times * size / 2)) for size in (camera.width, camera.height)))


def through(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """Make a closed, smooth path through the cameras: splines of position and rotation, at an even pace.

    The path goes from each camera to the nearest of the remaining ones, and passes at most `_MOST_KEYS` of them. If its ends are
    far from each other, it returns the same way. A single camera sways to both sides. All frames have the first camera's
    intrinsics and size.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
    axes = np.stack([camera.world_to_camera[:3, :3].double().cpu().numpy().T for camera in cameras])  # camera to world
    if len(cameras) == 1:
        angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        centers = centers + _SWAY * np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes[0, :, :2].T
        axes = axes.repeat(len(centers), 0)
    order = _tour(centers)
    order = order[:: -(-len(order) // _MOST_KEYS)]
    # Photos that were taken upside down are turned: else the path would roll to each and back.
    axes[order, :, :2] *= _upright(axes[order, :, 1])[:, None, None]
    steps = np.linalg.norm(centers[order] - centers[np.roll(order, 1)], axis=1)  # the first is that between the ends
    if steps[0] > _FAR * steps[1:].max(initial=0):
        order += order[-2:0:-1]
    keys = np.array([order[i % len(order)] for i in range(-_WRAP, len(order) + _WRAP + 1)])
    rotations = Rotation.from_matrix(axes[keys])
    turned = (rotations[:-1].inv() * rotations[1:]).magnitude()
    moved = np.linalg.norm(np.diff(centers[keys], axis=0), axis=1)
    lengths = np.maximum(moved / max(moved.max(), 1e-9) + turned, 1e-3)  # the spline's parameter; never still
    at = np.concatenate([[0.0], np.cumsum(lengths)])
    times = np.linspace(at[_WRAP], at[_WRAP + len(order)], frames, endpoint=False)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :3] = RotationSpline(at, rotations)(times).inv().as_matrix()
    poses[:, :3, 3:] = -poses[:, :3, :3] @ CubicSpline(at, centers[keys])(times)[..., None]
    return [replace(cameras[0], world_to_camera=torch.from_numpy(pose)) for pose in poses]


def up(cameras: Sequence[Camera]) -> Float[np.ndarray, " 3"]:
    """The mean of the cameras' upward axes, of length 1; cameras that were held upside down are turned."""
    down = np.stack([camera.world_to_camera[1, :3].double().cpu().numpy() for camera in cameras])
    down = down[_tour(np.stack([camera.center.double().cpu().numpy() for camera in cameras]))]
    mean: Float[np.ndarray, " 3"] = -(_upright(down)[:, None] * down).mean(0)
    mean /= max(np.linalg.norm(mean), 1e-9)
    return mean


def _upright(down: Float[np.ndarray, "C 3"]) -> Float[np.ndarray, " C"]:
    """-1 for cameras that were held upside down, else 1, from their downward axes in the order of a tour; most are upright."""
    changes = np.where((down[1:] * down[:-1]).sum(1) < 0, -1.0, 1.0)
    signs: Float[np.ndarray, " C"] = np.cumprod([1.0, *changes])
    return signs if signs.sum() >= 0 else -signs


def _tour(centers: Float[np.ndarray, "C 3"]) -> list[int]:
    """All indices, beginning with that of an outermost camera, each followed by the nearest of the remaining ones."""
    tour = [int(np.linalg.norm(centers - centers[0], axis=1).argmax())]
    left = np.delete(np.arange(len(centers)), tour)
    while len(left):
        nearest = int(np.linalg.norm(centers[left] - centers[tour[-1]], axis=1).argmin())
        tour.append(int(left[nearest]))
        left = np.delete(left, nearest)
    return tour
