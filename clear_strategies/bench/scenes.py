"""Scenes of the benchmarks: generated ones of known statistics, or the exported field of a run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from scipy.special import expit

from clear_strategies.data.ply import read_gaussians
from clear_strategies.errors import DataError
from clear_strategies.jobs.saved import overview
from rasterizers.geometry import constant_band
from rasterizers.interface import Camera, Splats

SETTINGS: Final = {"kernel": 0.3, "near": 0.01, "alpha_max": 0.999, "antialiased": True}
"""The settings of all rasterizers; their cut-offs come from the preset."""

_BANDS: Final = 15  # SH degree 3
_FOCAL: Final = 0.8  # in units of the image's width

Array = np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Workload:
    """Gaussians and a camera that sees them, in float32."""

    name: str
    splats: Splats
    camera: Camera

    @property
    def lr_factor(self) -> int:
        """HR pixels per LR pixel: the larger of 4 and 3 that divides the image size."""
        return 3 if self.camera.width % 4 or self.camera.height % 4 else 4

    def to(self, device: str, dtype: torch.dtype = torch.float32) -> Workload:
        """The Gaussians on another device; cameras stay on the CPU."""
        return replace(self, splats=self.splats.to(device, dtype))


def surfaces(name: str, n: int, width: int, height: int, *, radius: float, seed: int = 0) -> Workload:
    """Generate a wall with relief, the ground, three spheres and some clutter, as in a trained field.

    The Gaussians are discs aligned to the surfaces, of lognormal sizes, most either faint or opaque.

    Args:
        radius: median 3-sigma radius of the discs before the 2D kernel, px.
    """
    random = np.random.default_rng(seed)
    focal = _FOCAL * width
    points, normals = _surface(random, n, width, height, focal)

    # Two axes of a disc lie in the surface, the third is thin.
    longest = radius / 3 / focal * points[:, 2] * np.exp(random.normal(0, 0.8, n))
    shorter, thickness = np.exp(random.normal(-0.5, 0.4, n)), 0.12 * np.exp(random.normal(0, 0.5, n))
    scales = longest[:, None] * np.stack((np.ones(n), shorter, thickness), 1)
    quats = _facing(normals, random.uniform(0, 2 * np.pi, n)) * random.uniform(0.7, 1.4, (n, 1))
    texture = 0.5 + 0.3 * np.sin(points * (7, 9, 5)) * np.cos(points[:, [1, 2, 0]] * 11)
    colors = texture + random.normal(0, 0.05, (n, 3))
    shuffled = random.permutation(n)  # a trained field has no order
    parts = [points, quats, scales, expit(random.normal(0.8, 2.2, n)), colors, random.normal(0, 0.02, (n, _BANDS, 3))]
    tensors = [torch.from_numpy(x[shuffled]).float() for x in parts]
    tensors[4] = constant_band(tensors[4])
    return Workload(name, Splats(*tensors), Camera(_pose(), focal, focal, width / 2, height / 2, width, height))


def tails(name: str, n: int, width: int, height: int, *, radius: float, seed: int = 0) -> Workload:
    """Generate `surfaces` with the heavy tails of long training: a hundredth of the Gaussians, faint and large, has most of the
    pairs of Gaussian and tile, one covers the image, and a fifteenth lies behind one tile.
    """
    w, random = surfaces(name, n, width, height, radius=radius, seed=seed), np.random.default_rng(seed + 1)
    means, scales, opacities = w.splats.means, w.splats.scales, w.splats.opacities
    chosen = torch.from_numpy(random.permutation(n))
    large, crowd = chosen[: n // 100], chosen[n // 100 : n // 100 + n // 15]
    scales[large] *= torch.from_numpy(45 * np.exp(random.normal(0, 0.5, (len(large), 1)))).float()
    opacities[large] *= 0.1
    scales[large[0]], opacities[large[0]] = float(means[large[0], 2]), 0.05
    toward = means[crowd[0]] / means[crowd[0], 2]
    pixel = means[crowd, 2:] / w.camera.fx
    means[crowd] = toward * means[crowd, 2:] + pixel * torch.from_numpy(random.normal(0, 1.5, (len(crowd), 3))).float()
    scales[crowd] = pixel * torch.from_numpy(np.exp(random.normal(-0.5, 0.4, (len(crowd), 3)))).float()
    return w


def _surface(
    random: np.random.Generator, n: int, width: int, height: int, focal: float
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
    """Points that the camera sees, with a margin of a tenth of the image around it, and their unit normals."""
    unit = width / 1008  # the relief is given in pixels of a 1008-pixel image
    counts = [round(n * share) for share in (0.30, 0.25, 0.15, 0.15, 0.10)]

    def at(u: Array, v: Array, z: Array) -> Array:
        return np.stack(((u - width / 2) / focal * z, (v - height / 2) / focal * z, z), -1)

    def pixels(n: int) -> Array:
        return random.uniform(-0.1, 1.1, (2, n)) * [[width], [height]]

    def directions(n: int) -> Array:
        vectors = random.normal(size=(n, 3))
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))

    u, v = pixels(counts[0])
    depth = 8 + 0.6 * np.sin(u / (90 * unit)) * np.cos(v / (70 * unit)) + random.normal(0, 0.02, len(u))
    parts, normals = [at(u, v, depth)], [np.tile((0.0, 0, 1), (len(u), 1))]
    u, _ = pixels(counts[1])
    v = height * (0.55 + 0.55 * random.uniform(0, 1, len(u)))
    parts.append(at(u, v, np.minimum(1.2 * focal / np.maximum(v - height / 2, 20 * unit), 7.5)))
    normals.append(np.tile((0.0, 1, 0), (len(u), 1)))
    spheres = ((0.35, 0.45, 4.0, 0.8), (0.70, 0.50, 3.0, 0.6), (0.50, 0.65, 2.0, 0.25))
    for count, (x, y, z, size) in zip(counts[2:], spheres, strict=True):
        of_sphere = directions(count)
        of_sphere[:, 2] = np.where(random.random(count) < 0.85, -1, 1) * np.abs(of_sphere[:, 2])
        middle = at(np.array(x * width), np.array(y * height), np.array(z))
        parts.append(middle + size * of_sphere + random.normal(0, 0.01, (count, 3)))
        normals.append(of_sphere)
    u, v = pixels(n - sum(counts))
    parts.append(at(u, v, random.uniform(1.5, 9, len(u))))
    normals.append(directions(len(u)))
    return np.concatenate(parts), np.concatenate(normals)


def from_ply(path: Path) -> Workload:
    """Read exported Gaussians; a DataError if the file is no such export."""
    g = read_gaussians(path, allow_empty=False)
    splats = Splats(g.means, g.quats, g.scales.exp(), g.opacities.sigmoid(), g.sh0, g.shN)
    return Workload(path.stem, splats, overview(splats.means, splats.opacities))


# Gaussians shrink as their number grows, as under densification: the radius is 5.5 px at 100k.
_GENERATED: Final = {
    "tiny": (surfaces, 600, 96, 72, 4.0),
    "small": (surfaces, 5_000, 252, 189, 5.5),
    "s100k": (surfaces, 100_000, 1008, 756, 5.5),
    "s500k": (surfaces, 500_000, 1008, 756, 5.5 * 5**-0.3),
    "tails": (tails, 60_000, 1008, 756, 1.5),
}
_AT_LR: Final = "s100k-lr"  # the same Gaussians at a quarter of the image size
NAMES: Final = ("tiny", "small", "s100k", _AT_LR, "s500k", "tails")


def load(name: str) -> Workload:
    """Make a scene by name, or read a .ply file; a DataError if there is neither, or the file cannot be used."""
    if name == _AT_LR:
        hr = load("s100k")
        return Workload(name, hr.splats, hr.camera.scaled(1 / 4))
    if name in _GENERATED:
        generate, n, width, height, radius = _GENERATED[name]
        return generate(name, n, width, height, radius=radius)
    if Path(name).is_file():
        return from_ply(Path(name))
    raise DataError("--scene", name, "is no scene and no file", f"choose one of {', '.join(NAMES)}, or give a .ply")


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
