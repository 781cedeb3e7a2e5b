"""Initial clouds: what training starts from, honestly. Each says where it came from and whether test views helped."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data.capture import SfmPoints
from clear_strategies.data.ply import read_points
from clear_strategies.data.triangulate import TriangulationSettings, triangulate
from clear_strategies.data.view import Photo, PointCloud
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

Init = Literal["auto", "triangulated", "sfm_train", "sfm", "ply", "random"]

_ENOUGH: Final = 50  # triangulated points with which `auto` is content


@dataclass(frozen=True, slots=True)
class CloudSettings:
    """Which points, and what is done to them.

    Args:
        init: "triangulated" from the training LR images under their known poses; "sfm_train": the scene's points seen
            by at least `min_views` training views (still triangulated from all views); "sfm": all of the scene's
            points; "ply": a given file; "random" in the cameras' common box; "auto": the best honest one, that is
            triangulated where at least 50 points come of it, else random.
        path: the PLY file for init=ply.
        densify: add points between those found, at interpolated inverse depth, one every `stride` LR pixels per view.
        random_points: how many for init=random. box: half-edge of their box around the origin, world units; None: the
            box that all cameras look into.
        outlier_neighbours, outlier_ratio: points whose mean distance to that many neighbours exceeds the average by more
            than `ratio` standard deviations are removed; 0 neighbours: none are.
        voxel: points are averaged in cubes of this edge, world units; None: they are not.
        max_points: a random choice of these at most.
    """

    init: Init = "auto"
    path: str | None = None
    min_views: int = 2
    densify: bool = True
    stride: int = 2
    random_points: int = 10_000
    box: float | None = None
    outlier_neighbours: int = 16
    outlier_ratio: float = 3.0
    voxel: float | None = None
    max_points: int = 200_000
    triangulation: TriangulationSettings = field(default_factory=TriangulationSettings)

    def __post_init__(self) -> None:
        if self.init not in get_args(Init):
            raise ValueError(f"init must be one of {', '.join(get_args(Init))}, got {self.init!r}.")
        if self.stride < 1 or self.random_points < 1 or self.max_points < 1 or self.min_views < 1:
            raise ValueError("stride, random_points, max_points and min_views must be at least 1.")
        if self.outlier_neighbours < 0 or self.outlier_ratio <= 0:
            raise ValueError("outlier_neighbours must be >= 0 and outlier_ratio > 0.")
        if self.voxel is not None and not self.voxel > 0:
            raise ValueError(f"voxel must be > 0 world units or null, got {self.voxel}.")
        if self.init == "ply" and not self.path:
            raise ValueError("init=ply needs the file: set data.cloud.path.")


def initial_cloud(
    settings: CloudSettings,
    photos: Sequence[Photo],
    *,
    sfm: SfmPoints | None = None,
    train_ids: Sequence[int] = (),
    seed: int = 0,
) -> PointCloud:
    """The cloud a run starts from.

    Args:
        photos: the training views at LR. sfm: the scene's own points, if it has some. train_ids: their ids of the
            training frames.

    Raises:
        DataError: the cloud that was asked for cannot be had from this scene.
    """
    cloud = _chosen(settings, photos, sfm, train_ids, seed)
    if settings.outlier_neighbours and len(cloud) > settings.outlier_neighbours and settings.init != "random":
        kept = remove_outliers(cloud.means, settings.outlier_neighbours, settings.outlier_ratio)
        _log.info("%d of %d points removed as outliers.", len(cloud) - len(kept), len(cloud))
        cloud = replace(cloud, means=cloud.means[kept], colors=cloud.colors[kept])
    if settings.densify and not cloud.source.startswith("random"):
        cloud = densify(cloud, photos, settings.stride)
    if settings.voxel is not None:
        means, colors = voxel_grid(cloud.means, cloud.colors, settings.voxel)
        cloud = replace(cloud, means=means, colors=colors, source=f"{cloud.source}, voxels of {settings.voxel:g}")
    if len(cloud) > settings.max_points:
        chosen = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(seed))[: settings.max_points]
        _log.info("%d of %d points chosen at random (cloud.max_points).", settings.max_points, len(cloud))
        cloud = replace(cloud, means=cloud.means[chosen], colors=cloud.colors[chosen])
    return cloud


def _chosen(
    settings: CloudSettings, photos: Sequence[Photo], sfm: SfmPoints | None, train_ids: Sequence[int], seed: int
) -> PointCloud:
    match settings.init:
        case "ply":
            return read_points(Path(str(settings.path)))
        case "random":
            return random_cloud(photos, settings.random_points, seed, settings.box)
        case "sfm" | "sfm_train":
            if sfm is None:
                raise DataError(
                    "scene", "points", f"there are none, but data.cloud.init={settings.init}", "use init=triangulated"
                )
            return from_tracks(sfm, train_ids if settings.init == "sfm_train" else None, settings.min_views)
        case "triangulated":
            cloud = triangulate(photos, settings.triangulation)
            if len(cloud) == 0:
                raise DataError(
                    "scene", "points", "no point could be triangulated from the training LR images",
                    "use data.cloud.init=random, or more or closer views",
                )  # fmt: skip
            return cloud
        case _:
            cloud = triangulate(photos, settings.triangulation)
            if len(cloud) >= _ENOUGH:
                _log.info("init: auto chose %s.", cloud.source)
                return cloud
            _log.warning(
                "init: auto chose random points: only %d could be triangulated from the training LR images.", len(cloud)
            )
            return random_cloud(photos, settings.random_points, seed, settings.box)


def from_tracks(sfm: SfmPoints, train_ids: Sequence[int] | None, min_views: int) -> PointCloud:
    """The scene's own points; with `train_ids`, those that at least `min_views` of these frames saw.

    Their positions were triangulated from all views, test views too: no filter undoes that, and the cloud says so.
    """
    if train_ids is None:
        return PointCloud(sfm.means.float(), sfm.colors.float(), sfm.source, saw_test_views="yes")
    observed = torch.isin(sfm.seen_by, torch.tensor(list(train_ids), dtype=sfm.seen_by.dtype))
    pairs = torch.unique(torch.stack((sfm.point[observed], sfm.seen_by[observed]), dim=1), dim=0)
    counts = torch.bincount(pairs[:, 0], minlength=len(sfm.means))
    kept = counts >= min_views
    if not bool(kept.any()):
        raise DataError(
            "scene",
            "points",
            f"none is seen by {min_views} training views",
            "lower data.cloud.min_views, or use another init",
        )
    source = f"{int(kept.sum()):,} of the scene's points, seen by >= {min_views} training views ({sfm.source})"
    return PointCloud(sfm.means[kept].float(), sfm.colors[kept].float(), source, saw_test_views="yes")


def random_cloud(photos: Sequence[Photo], count: int, seed: int, box: float | None = None) -> PointCloud:
    """Uniform points of near-grey colour, in a box around the origin, or in the one that all cameras look into."""
    g = torch.Generator().manual_seed(seed)
    if box is not None:
        low, high, where = torch.full((3,), -box), torch.full((3,), box), f"[-{box:g}, {box:g}]³"
    else:
        low, high = common_box(photos)
        where = "the cameras' common box"
    means = low + (high - low) * torch.rand(count, 3, generator=g)
    colors = 0.5 + (torch.rand(count, 3, generator=g) - 0.5) * 0.1
    return PointCloud(means, colors, f"random: {count:,} points in {where}")


def common_box(photos: Sequence[Photo]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """An axis-aligned box of what most cameras see: around the point closest to all their axes.

    Cameras that look in parallel have no such point; theirs lies where they look, as far as they are apart times ten.
    """
    centers = torch.stack([p.camera.center.double() for p in photos])
    forward = torch.stack([p.camera.world_to_camera[2, :3].double() for p in photos])
    # Least squares over lines: Σ (I - d dᵀ) (x - c) = 0, held a little at the cameras' reach where lines are parallel.
    projector = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    spread = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
    reach = centers.mean(0) + forward.mean(0) * 10 * spread
    weight = 1e-3 * len(photos)
    left = projector.sum(0) + weight * torch.eye(3, dtype=torch.float64)
    middle = torch.linalg.solve(left, (projector @ centers[:, :, None]).sum(0)[:, 0] + weight * reach)
    distance = torch.linalg.vector_norm(centers - middle, dim=-1).mean()
    narrowest = min(0.5 * min(p.camera.width / p.camera.fx, p.camera.height / p.camera.fy) for p in photos)
    half = float(distance) * narrowest
    return (middle - half).float(), (middle + half).float()


def densify(cloud: PointCloud, photos: Sequence[Photo], stride: int) -> PointCloud:
    """Add, per training view, a point every `stride` pixels at the interpolated inverse depth of the cloud.

    Inverse depth is linear on planes. Between the projected points it is interpolated linearly, outside their hull it is
    the nearest point's. Points hidden behind others would bend the surface: of those falling on one cell of `stride`
    pixels only the nearest to the camera counts.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    means, colors = [cloud.means], [cloud.colors]
    for photo in photos:
        camera = photo.camera
        pixels, inverse_depth = _visible_samples(cloud.means, photo, 2 * stride)
        if len(pixels) < 4:
            continue
        x = np.arange(stride / 2, camera.width, stride)
        y = np.arange(stride / 2, camera.height, stride)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        try:
            values = LinearNDInterpolator(pixels, inverse_depth)(grid)
        except QhullError:  # all on a line
            values = np.full(len(grid), np.nan)
        nearest = NearestNDInterpolator(pixels, inverse_depth)(grid)
        z = torch.from_numpy(1 / np.where(np.isfinite(values), values, nearest))
        u = torch.from_numpy(grid)
        local = torch.stack(((u[:, 0] - camera.cx) / camera.fx * z, (u[:, 1] - camera.cy) / camera.fy * z, z), -1)
        pose = camera.world_to_camera.double()
        means.append(((local - pose[:3, 3]) @ pose[:3, :3]).float())
        column, row = u[:, 0].long(), u[:, 1].long()
        colors.append(photo.image[row, column])
    added = sum(len(m) for m in means[1:])
    source = f"{cloud.source}, densified by {added:,} points at interpolated inverse depth"
    return replace(cloud, means=torch.cat(means), colors=torch.cat(colors), source=source)


def _visible_samples(means: Float[Tensor, "N 3"], photo: Photo, cell: int) -> tuple[np.ndarray, np.ndarray]:
    """(pixels, inverse depths) of the points in view, the nearest one of each cell."""
    camera, pose = photo.camera, photo.camera.world_to_camera.double()
    local = means.double() @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2]
    u = camera.fx * local[:, 0] / z + camera.cx
    v = camera.fy * local[:, 1] / z + camera.cy
    inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixels, depth = torch.stack((u, v), -1)[inside].numpy(), z[inside].numpy()
    order = np.argsort(depth, kind="stable")
    cells = (pixels[order] // cell).astype(np.int64) @ np.array([1, 1 << 20])
    _, first = np.unique(cells, return_index=True)
    kept = order[first]
    return pixels[kept], 1 / depth[kept]


def remove_outliers(means: Float[Tensor, "N 3"], neighbours: int, ratio: float) -> Tensor:
    """Indices of the points to keep: mean distance to their neighbours at most `ratio` deviations above the average.

    Open3D's definition (the point itself is its own first neighbour; sample standard deviation); by open3d where it is
    installed, else by scipy, with the same result.
    """
    points = means.double().cpu().numpy()
    open3d = _open3d()
    if open3d is not None:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        _, kept = cloud.remove_statistical_outlier(nb_neighbors=neighbours, std_ratio=ratio)
        return torch.tensor(sorted(kept), dtype=torch.long)
    from scipy.spatial import cKDTree

    k = min(neighbours, len(points))
    distances = np.asarray(cKDTree(points).query(points, k=k)[0]).reshape(len(points), k).mean(1)
    valid = distances > 0
    if valid.sum() < 2:
        return torch.arange(len(points))
    limit = distances[valid].mean() + ratio * distances[valid].std(ddof=1)
    return torch.from_numpy(np.flatnonzero(valid & (distances < limit)))


def voxel_grid(
    means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], edge: float
) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]]:
    """Average positions and colours in cubes of `edge` aligned half a cube below the smallest corner (Open3D's grid)."""
    points = means.double().cpu().numpy()
    open3d = _open3d()
    if open3d is not None:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.colors = open3d.utility.Vector3dVector(colors.double().cpu().numpy())
        small = cloud.voxel_down_sample(edge)
        merged = np.concatenate((np.asarray(small.points), np.asarray(small.colors)), axis=1)
    else:
        cells = np.floor((points - (points.min(0) - edge / 2)) / edge).astype(np.int64)
        _, owner = np.unique(cells, axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        values = np.concatenate((points, colors.double().cpu().numpy()), axis=1)
        merged = np.stack([np.bincount(owner, column) for column in values.T], axis=1) / np.bincount(owner)[:, None]
    merged = merged[np.lexsort(merged.T)]  # neither library promises an order; ours is fixed
    both = torch.from_numpy(merged)
    return both[:, :3].to(means), both[:, 3:].to(colors)


def _open3d() -> Any:
    """The module, or None where it is not installed or its system libraries are missing."""
    try:
        import open3d
    except ImportError as reason:
        _log.info("scipy instead of open3d (%s).", " ".join(str(reason).split()))
        return None
    _log.info("open3d %s.", open3d.__version__)
    return open3d
