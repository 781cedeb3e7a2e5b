"""What the benchmark draws: generated scenes of known statistics, a real point cloud, or an
exported field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.data.ply import read_gaussians
from clear_strategies.errors import DataError
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Splats

SETTINGS: Final = {"kernel": 0.3, "near": 0.01, "alpha_max": 0.999, "antialiased": True}
"""The settings all contenders draw with; their cut-offs come from the preset."""

_BANDS: Final = 15  # SH degree 3
_FOCAL: Final = 0.8  # in units of the image's width

Array = np.ndarray
Surface = tuple[Float[Array, "n 3"], Float[Array, "n 3"]]  # points and unit normals


@dataclass(frozen=True, slots=True, eq=False)
class Workload:
    """Gaussians and a camera that sees them, in float32."""

    name: str
    splats: Splats
    camera: Camera

    @property
    def lr_factor(self) -> int | None:
        """The largest of 4, 3 and 2 that divides the image size; None: the image has no LR grid."""
        sizes = self.camera.width, self.camera.height
        return next((factor for factor in (4, 3, 2) if not any(size % factor for size in sizes)), None)

    def to(self, device: str, dtype: torch.dtype = torch.float32) -> Workload:
        """The Gaussians on another device; cameras stay on the CPU."""
        tensors = {f.name: getattr(self.splats, f.name) for f in fields(self.splats)}
        moved = {name: t.to(device, dtype) for name, t in tensors.items() if t is not None}
        return replace(self, splats=replace(self.splats, **moved))


def surfaces(name: str, n: int, width: int, height: int, *, radius: float, seed: int = 0) -> Workload:
    """A wall with relief, the ground, three spheres and some clutter, as in a trained field.

    The Gaussians are discs aligned to the surfaces, of lognormal sizes, most either faint or opaque.

    Args:
        radius: median 3-sigma radius of the discs before the 2D kernel, px.
    """
    random = np.random.default_rng(seed)
    focal = _FOCAL * width
    frustum = _Frustum(random, width, height, focal)
    counts = [round(n * share) for share in (0.30, 0.25, 0.15, 0.15, 0.10)]
    parts = [
        frustum.wall(counts[0]),
        frustum.ground(counts[1]),
        frustum.sphere(counts[2], (0.35, 0.45, 4.0), 0.8),
        frustum.sphere(counts[3], (0.70, 0.50, 3.0), 0.6),
        frustum.sphere(counts[4], (0.50, 0.65, 2.0), 0.25),
        frustum.clutter(n - sum(counts)),
    ]
    points, normals = (np.concatenate(x) for x in zip(*parts, strict=True))

    # Two axes of a disc lie in the surface, the third is thin.
    longest = radius / 3 / focal * points[:, 2] * np.exp(random.normal(0, 0.8, n))
    shorter, thickness = np.exp(random.normal(-0.5, 0.4, n)), 0.12 * np.exp(random.normal(0, 0.5, n))
    scales = longest[:, None] * np.stack((np.ones(n), shorter, thickness), 1)
    quats = _facing(normals, random.uniform(0, 2 * np.pi, n)) * random.uniform(0.7, 1.4, (n, 1))
    texture = 0.5 + 0.3 * np.sin(points * (7, 9, 5)) * np.cos(points[:, [1, 2, 0]] * 11)
    colors = texture + random.normal(0, 0.05, (n, 3))
    shuffled = random.permutation(n)  # a trained field has no order
    splats = _splats(random, points, quats, scales, expit(random.normal(0.8, 2.2, n)), colors)
    splats = Splats(*(getattr(splats, a)[shuffled] for a in PARAMETERS))
    return Workload(name, splats, Camera(_pose(), focal, focal, width / 2, height / 2, width, height))


class _Frustum:
    """Samples points on surfaces that the camera sees, with a margin of a tenth of the image around it."""

    def __init__(self, random: np.random.Generator, width: int, height: int, focal: float) -> None:
        self.random, self.width, self.height, self.focal = random, width, height, focal
        self.unit = width / 1008  # the relief is given in pixels of a 1008-pixel image

    def wall(self, n: int) -> Surface:
        u, v = self._pixels(n)
        relief = 0.6 * np.sin(u / (90 * self.unit)) * np.cos(v / (70 * self.unit))
        return self._at(u, v, 8 + relief + self.random.normal(0, 0.02, n)), np.tile((0.0, 0, 1), (n, 1))

    def ground(self, n: int) -> Surface:
        u, _ = self._pixels(n)
        v = self.height * (0.55 + 0.55 * self.random.uniform(0, 1, n))
        horizon = np.maximum(v - self.height / 2, 20 * self.unit)
        return self._at(u, v, np.minimum(1.2 * self.focal / horizon, 7.5)), np.tile((0.0, 1, 0), (n, 1))

    def sphere(self, n: int, center: tuple[float, float, float], radius: float) -> Surface:
        """`center` is a share of the image's width and height, and a depth."""
        normals = self._directions(n)
        in_front = np.where(self.random.random(n) < 0.85, -1, 1)
        normals[:, 2] = in_front * np.abs(normals[:, 2])
        middle = self._at(np.array(center[0] * self.width), np.array(center[1] * self.height), np.array(center[2]))
        return middle + radius * normals + self.random.normal(0, 0.01, (n, 3)), normals

    def clutter(self, n: int) -> Surface:
        u, v = self._pixels(n)
        return self._at(u, v, self.random.uniform(1.5, 9, n)), self._directions(n)

    def _pixels(self, n: int) -> tuple[Array, Array]:
        u, v = self.random.uniform(-0.1, 1.1, (2, n))
        return u * self.width, v * self.height

    def _at(self, u: Array, v: Array, z: Array) -> Float[Array, "*n 3"]:
        return np.stack(((u - self.width / 2) / self.focal * z, (v - self.height / 2) / self.focal * z, z), -1)

    def _directions(self, n: int) -> Float[Array, "n 3"]:
        directions = self.random.normal(size=(n, 3))
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def garden(path: Path) -> Workload:
    """The points of gsplat's test_garden.npz as Gaussians: sizes from the distances to three neighbours.

    Raises:
        DataError: the file is missing or is not the garden.
    """
    try:
        with np.load(path) as file:
            points, colors = file["means3d"].astype(np.float64), file["colors"] / 255.0
            pose, K = file["viewmats"][0], file["Ks"][0]
            width, height = int(file["width"]), int(file["height"])
    except (OSError, ValueError, KeyError) as error:
        raise DataError(
            path, "content", f"is not the garden ({error})", "give gsplat's test_garden.npz with --data"
        ) from error
    random, n = np.random.default_rng(0), len(points)
    gaps = np.asarray(cKDTree(points).query(points, k=4)[0])[:, 1:]
    size = np.sqrt(np.square(gaps).mean(1)).clip(1e-4)
    scales = size[:, None] * np.exp(random.normal(-0.3, 0.5, (n, 3)))
    opacities = expit(random.normal(0.3, 1.9, n))
    splats = _splats(random, points, random.normal(size=(n, 4)), scales, opacities, colors)
    fx, fy, cx, cy = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    camera = Camera(torch.from_numpy(pose).float(), fx, fy, cx, cy, width, height)
    return Workload("garden", splats, camera)


def from_ply(path: Path) -> Workload:
    """Gaussians as a run exports them; a DataError where the file is no such export."""
    g = read_gaussians(path)
    splats = Splats(g.means, g.quats, g.scales.exp(), g.opacities.sigmoid(), g.sh0, g.shN)
    return Workload(path.stem, splats, facing_all(splats))


def facing_all(splats: Splats, width: int = 1008, height: int = 756) -> Camera:
    """A camera along +z that sees the middle nine tenths of the Gaussians; a .ply file holds no camera."""
    low, high = (np.quantile(splats.means.numpy(), q, axis=0) for q in (0.05, 0.95))
    center, half = (low + high) / 2, (high - low) / 2
    focal = _FOCAL * width
    back = max(half[0] * focal / (width / 2), half[1] * focal / (height / 2), 1e-3) + half[2]
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([-center[0], -center[1], back - center[2]])
    return Camera(pose, focal, focal, width / 2, height / 2, width, height)


# Gaussians shrink as their number grows, as under densification: the radius is 5.5 px at 100k.
_GENERATED: Final[dict[str, Callable[[], Workload]]] = {
    "tiny": lambda: surfaces("tiny", 600, 96, 72, radius=4.0),
    "small": lambda: surfaces("small", 5_000, 252, 189, radius=5.5),
    "s100k": lambda: surfaces("s100k", 100_000, 1008, 756, radius=5.5),
    "s100k-lr": lambda: _at_lr(_GENERATED["s100k"]()),
    "s300k-2016": lambda: surfaces("s300k-2016", 300_000, 2016, 1512, radius=2 * 5.5 * 3**-0.3),
    "s500k": lambda: surfaces("s500k", 500_000, 1008, 756, radius=5.5 * 5**-0.3),
}
NAMES: Final = (*_GENERATED, "garden")


def load(name: str, data: Path | None = None) -> Workload:
    """A scene by name, or a .ply file.

    Args:
        data: the garden's file.

    Raises:
        DataError: no scene or file has that name, or the file cannot be used.
    """
    if name in _GENERATED:
        return _GENERATED[name]()
    if name == "garden":
        if data is None:
            raise DataError("--scene", name, "has no file", "give gsplat's test_garden.npz with --data")
        return garden(data)
    if Path(name).is_file():
        return from_ply(Path(name))
    raise DataError("--scene", name, "is no scene and no file", f"choose one of {', '.join(NAMES)}, or give a .ply")


def _at_lr(workload: Workload) -> Workload:
    """The same Gaussians at a quarter of the image size."""
    return Workload(f"{workload.name}-lr", workload.splats, workload.camera.scaled(1 / 4))


def _splats(random: np.random.Generator, *parts: Array) -> Splats:
    """Splats of means, quats, scales, opacities and colours, with a little view dependence."""
    means, quats, scales, opacities, colors = (torch.from_numpy(x).float().contiguous() for x in parts)
    higher = torch.from_numpy(random.normal(0, 0.02, (len(means), _BANDS, 3))).float()
    return Splats(means, quats, scales, opacities, ((colors - 0.5) / SH_C0)[:, None], higher)


def _facing(normals: Float[Array, "n 3"], spin: Float[Array, " n"]) -> Float[Array, "n 4"]:
    """Quaternions that rotate by `spin` about the third axis, then turn it along ±normal."""
    x, y, z = (normals * np.where(normals[:, 2:] < 0, -1, 1)).T
    half = np.stack((1 + z, -y, x), 1)  # the shortest rotation from +z to the normal
    w, i, j = (half / np.linalg.norm(half, axis=1, keepdims=True)).T
    c, s = np.cos(spin / 2), np.sin(spin / 2)
    return np.stack((w * c, i * c + j * s, j * c - i * s, w * s), 1)


def _pose() -> Float[torch.Tensor, "4 4"]:
    """A camera pose slightly off the axes, so that nothing is aligned with the pixel grid."""
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.from_euler("XY", (-0.02, 0.03)).as_matrix())
    pose[:3, 3] = torch.tensor([0.05, -0.03, 0.1])
    return pose
