"""Initial clouds: what training starts from, honestly. Each says where it came from and whether test views helped."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.data.capture import SfmPoints
from clear_strategies.data.ply import read_points
from clear_strategies.data.points.neighbours import remove_outliers, voxel_grid
from clear_strategies.data.points.sift import TriangulationSettings, project, sample_colors, triangulate
from clear_strategies.data.scene import PointCloud
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

Init = Literal["auto", "triangulated", "sfm_train", "sfm", "ply", "random"]

_FEWEST_SAMPLES: Final = 4  # projected points from which a view's depth is interpolated


@dataclass(frozen=True, slots=True)
class CloudSettings:
    """Which points, and what is done to them.

    Args:
        init: "triangulated" from the training LR images under their known poses; "sfm_train": the scene's points seen
            by at least `min_views` training views (still triangulated from all views); "sfm": all of the scene's
            points; "ply": a given file; "random" in the cameras' common box; "auto": the best honest one, that is
            triangulated where at least `enough` points come of it, else random.
        path: the PLY file for init=ply.
        min_views: training views that must have seen a point, for init=sfm_train.
        enough: triangulated points with which init=auto is content.
        densify: add points between those found, at interpolated inverse depth, one every `stride` LR px of each view;
            "auto": unless there are as many already. Random points are not points of the scene and never densified.
        random_points: how many for init=random.
        box: half-edge of their box around the origin, world units; None: the box that the cameras have in common.
        outlier_neighbours, outlier_ratio: points whose mean distance to that many nearest (the point itself is the
            first) exceeds the average by more than `ratio` standard deviations are removed; 0 neighbours: none are.
        voxel: points are averaged in cubes of this edge, world units; None: they are not.
        max_points: a random choice of these at most.

    Raises:
        ValueError: a number is outside its range, or init=ply without a path.
    """

    init: Init = "auto"
    path: str | None = None
    min_views: int = 2
    enough: int = 50
    densify: bool | Literal["auto"] = "auto"
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
        if self.init == "ply" and not self.path:
            raise ValueError("init=ply needs a file, got none. Set path to it.")
        if self.densify not in (True, False, "auto"):
            raise ValueError(f"densify must be true, false or auto, got {self.densify!r}.")
        for name in ("min_views", "enough", "stride", "random_points", "max_points"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}.")
        if self.outlier_neighbours < 0 or self.outlier_neighbours == 1:
            raise ValueError(f"outlier_neighbours must be 0 or at least 2, got {self.outlier_neighbours}.")
        for name in ("box", "outlier_ratio", "voxel"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be finite and > 0, got {value}.")


def initial_cloud(
    settings: CloudSettings,
    photos: Sequence[Photo],
    *,
    sfm: SfmPoints | None = None,
    train_ids: Sequence[int] = (),
    background: tuple[float, float, float] | None = None,
    seed: int = 0,
) -> PointCloud:
    """The cloud a run starts from.

    Args:
        photos: the training views at LR.
        sfm: the scene's own points, if it has some. train_ids: their ids of the training frames.
        background: a colour behind which there is no surface (Blender's white), RGB in [0, 1].

    Raises:
        DataError: the cloud that was asked for cannot be had from this scene.
    """
    found = _found_points(settings, photos, sfm, train_ids)
    if found is None:
        cloud = random_cloud(photos, settings.random_points, seed, settings.box)
    else:
        cloud = _densified(settings, _without_outliers(settings, found), photos, background)
    if settings.voxel is not None:
        means, colors = voxel_grid(cloud.means, cloud.colors, settings.voxel)
        cloud = replace(cloud, means=means, colors=colors, source=f"{cloud.source}, in voxels of {settings.voxel:g}")
    if len(cloud) > settings.max_points:
        chosen = torch.randperm(len(cloud), generator=torch.Generator().manual_seed(seed))[: settings.max_points]
        _log.info("%d of %d points chosen at random (max_points).", settings.max_points, len(cloud))
        cloud = _subset(cloud, chosen.sort().values)
    return cloud


def from_tracks(sfm: SfmPoints, train_ids: Sequence[int], min_views: int) -> PointCloud:
    """The scene's own points that at least `min_views` of these frames saw.

    Their positions were triangulated from all views, test views too: no filter undoes that, and the cloud says so.

    Raises:
        DataError: there is no such point, or nobody knows who saw which.
    """
    if len(sfm.point) == 0:
        raise DataError("scene", "points", "come without tracks", "use init=triangulated, or init=sfm for all of them")
    observed = torch.isin(sfm.seen_by, torch.tensor(list(train_ids), dtype=sfm.seen_by.dtype))
    sightings = torch.unique(torch.stack((sfm.point[observed], sfm.seen_by[observed]), dim=1), dim=0)
    kept = torch.nonzero(torch.bincount(sightings[:, 0], minlength=len(sfm.means)) >= min_views)[:, 0]
    if len(kept) == 0:
        problem = f"none is seen by {min_views} of the {len(train_ids)} training views"
        raise DataError("scene", "points", problem, "lower min_views, or use init=triangulated")
    source = f"{len(kept):,} points seen by >= {min_views} training views, of {sfm.source}"
    return _subset(PointCloud(sfm.means.float(), sfm.colors.float(), source, saw_test_views="yes"), kept)


def random_cloud(photos: Sequence[Photo], count: int, seed: int, box: float | None = None) -> PointCloud:
    """Uniform points, nearly grey, in a box.

    Args:
        box: half-edge of the box around the origin, world units; None: `common_box`.
    """
    if box is None:
        (low, high), where = common_box(photos), "the cameras' common box"
    else:
        low, high, where = torch.full((3,), -box), torch.full((3,), box), f"[-{box:g}, {box:g}]³"
    g = torch.Generator().manual_seed(seed)
    means = low + (high - low) * torch.rand(count, 3, generator=g)
    # Nearly: equal colours would give all of them equal gradients.
    colors = 0.5 + (torch.rand(count, 3, generator=g) - 0.5) * 0.1
    return PointCloud(means, colors, f"random: {count:,} points in {where}")


def common_box(photos: Sequence[Photo]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """(smallest, largest corner) of a cube around the ball in the middle of what the cameras look at.

    The middle is the point closest to all optical axes. Where they are nearly parallel there is none: then it lies ahead
    of the cameras, ten times as far as they are apart.
    """
    cameras = [photo.camera for photo in photos]
    centers = torch.stack([c.center.double().cpu() for c in cameras])
    axes = torch.stack([c.world_to_camera[2, :3].double().cpu() for c in cameras])
    spread = float(torch.linalg.vector_norm(centers - centers.mean(0), dim=-1).max()) or 1.0
    ahead = centers.mean(0) + axes.mean(0) * 10 * spread

    # Least squares over lines, Σ (I - d dᵀ)(x - c) = 0, held a little at `ahead` in case they are parallel.
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    hold = 1e-3 * len(cameras)
    right = (across @ centers[:, :, None]).sum(0)[:, 0] + hold * ahead
    middle = torch.linalg.solve(across.sum(0) + hold * torch.eye(3, dtype=torch.float64), right)

    distance = float(torch.linalg.vector_norm(centers - middle, dim=-1).mean())
    narrowest = min(math.atan(min(c.width / c.fx, c.height / c.fy) / 2) for c in cameras)
    half = distance * math.sin(narrowest)  # the ball touches the sides of the narrowest frustum
    return (middle - half).float(), (middle + half).float()


def densify(
    cloud: PointCloud, photos: Sequence[Photo], stride: int, background: tuple[float, float, float] | None = None
) -> PointCloud:
    """Add, per view, a point every `stride` pixels at the interpolated inverse depth of the cloud.

    Inverse depth is linear on planes. It is interpolated linearly between the projected points; outside their hull it is
    the nearest point's. Pixels of the background's colour show no surface and get no point.
    """
    means, colors = [cloud.means], [cloud.colors]
    for i, photo in enumerate(photos):
        pixels, inverse_depth = _visible_samples(cloud.means, photo, 2 * stride)
        if len(pixels) < _FEWEST_SAMPLES:
            _log.warning("view %d is not densified: only %d points project into it.", i, len(pixels))
            continue
        grid = _pixel_grid(photo, stride)
        shades = sample_colors(photo.image, grid)
        if background is not None:
            surface = ((shades - torch.tensor(background)).abs() > 2 / 255).any(dim=1)
            grid, shades = grid[surface], shades[surface]
        means.append(_back_projected(photo, grid, 1 / _interpolated(pixels, inverse_depth, grid)))
        colors.append(shades)
    added = sum(map(len, means[1:]))
    if added == 0:
        _log.warning("densify added no point.")
        return cloud
    source = f"{cloud.source}, densified by {added:,} at interpolated inverse depth"
    return replace(cloud, means=torch.cat(means), colors=torch.cat(colors), source=source)


def _found_points(
    settings: CloudSettings, photos: Sequence[Photo], sfm: SfmPoints | None, train_ids: Sequence[int]
) -> PointCloud | None:
    """Points of the scene's surfaces, or None where random ones must do."""
    match settings.init:
        case "random":
            return None
        case "ply":
            return _from_file(Path(str(settings.path)))
        case "sfm" | "sfm_train":
            return _from_scene(settings, sfm, train_ids)
        case "triangulated":
            cloud = triangulate(photos, settings.triangulation)
            if len(cloud) == 0:
                problem = f"none could be triangulated from the {len(photos)} training LR images"
                raise DataError("scene", "points", problem, "use init=random, or more or closer views")
            return cloud
        case "auto":
            return _triangulated_if_enough(settings, photos, sfm)


def _triangulated_if_enough(
    settings: CloudSettings, photos: Sequence[Photo], sfm: SfmPoints | None
) -> PointCloud | None:
    cloud = triangulate(photos, settings.triangulation)
    if sfm is not None:
        _log.info("init: auto leaves the scene's own points unused, test views had a part in them.")
    if len(cloud) >= settings.enough:
        _log.info("init: auto chose %s.", cloud.source)
        return cloud
    problem = "init: auto chose random points: only %d (of %d that are enough) come from the training LR images."
    _log.warning(problem, len(cloud), settings.enough)
    return None


def _from_file(path: Path) -> PointCloud:
    cloud = read_points(path)
    if len(cloud) == 0:
        raise DataError(path, "element vertex", "has no points", "give another file, or use another init")
    return cloud


def _from_scene(settings: CloudSettings, sfm: SfmPoints | None, train_ids: Sequence[int]) -> PointCloud:
    if sfm is None or len(sfm.means) == 0:
        problem = f"there are none, but init={settings.init} asks for them"
        raise DataError("scene", "points", problem, "use init=triangulated or init=random")
    if settings.init == "sfm_train":
        return from_tracks(sfm, train_ids, settings.min_views)
    return PointCloud(sfm.means.float(), sfm.colors.float(), sfm.source, saw_test_views="yes")


def _without_outliers(settings: CloudSettings, cloud: PointCloud) -> PointCloud:
    if settings.outlier_neighbours == 0:
        return cloud
    if len(cloud) <= settings.outlier_neighbours:
        _log.info("%d points are too few to tell outliers.", len(cloud))
        return cloud
    kept = remove_outliers(cloud.means, settings.outlier_neighbours, settings.outlier_ratio)
    if len(kept) == 0:
        _log.warning("outliers were kept: the points coincide, so all of them would have gone.")
        return cloud
    _log.info("%d of %d points removed as outliers.", len(cloud) - len(kept), len(cloud))
    return _subset(cloud, kept)


def _densified(
    settings: CloudSettings,
    cloud: PointCloud,
    photos: Sequence[Photo],
    background: tuple[float, float, float] | None,
) -> PointCloud:
    grid = sum(len(_pixel_grid(photo, settings.stride)) for photo in photos)
    if settings.densify == "auto" and len(cloud) >= grid:
        _log.info("densify: auto adds nothing to %d points, the views' grids hold %d.", len(cloud), grid)
        return cloud
    return densify(cloud, photos, settings.stride, background) if settings.densify else cloud


def _subset(cloud: PointCloud, index: Int[Tensor, " K"]) -> PointCloud:
    return replace(cloud, means=cloud.means[index], colors=cloud.colors[index])


def _pixel_grid(photo: Photo, stride: int) -> Float[Tensor, "G 2"]:
    """The centres of the image's squares of `stride` pixels."""
    x = torch.arange(stride / 2, photo.camera.width, stride, dtype=torch.float64)
    y = torch.arange(stride / 2, photo.camera.height, stride, dtype=torch.float64)
    return torch.cartesian_prod(x, y)


def _visible_samples(
    means: Float[Tensor, "N 3"], photo: Photo, cell: int
) -> tuple[Float[np.ndarray, "V 2"], Float[np.ndarray, " V"]]:
    """(pixels, inverse depths) of the points in view.

    Who saw which is not always known. Points hidden behind others would bend the surface, so of those that fall on one
    square of `cell` pixels only the nearest to the camera counts.
    """
    camera = photo.camera
    pixels, depth = project(camera, means)
    size = torch.tensor([camera.width, camera.height])
    inside = (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
    pixels, depth = pixels[inside], depth[inside]
    order = torch.argsort(depth, stable=True)
    column, row = (pixels[order] / cell).long().unbind(dim=1)
    _, first = np.unique((row * camera.width + column).numpy(), return_index=True)
    kept = order[torch.from_numpy(first)]
    return pixels[kept].numpy(), (1 / depth[kept]).numpy()


def _interpolated(
    pixels: Float[np.ndarray, "V 2"], values: Float[np.ndarray, " V"], at: Float[Tensor, "G 2"]
) -> Float[Tensor, " G"]:
    """Linear between the samples, the nearest one's value outside their hull."""
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    result = np.asarray(NearestNDInterpolator(pixels, values)(at.numpy()))
    try:
        linear = np.asarray(LinearNDInterpolator(pixels, values)(at.numpy()))
    except QhullError:  # all samples on one line: it has no inside
        return torch.from_numpy(result)
    return torch.from_numpy(np.where(np.isfinite(linear), linear, result))


def _back_projected(photo: Photo, pixels: Float[Tensor, "G 2"], depth: Float[Tensor, " G"]) -> Float[Tensor, "G 3"]:
    camera, pose = photo.camera, photo.camera.world_to_camera.double().cpu()
    x = (pixels[:, 0] - camera.cx) / camera.fx * depth
    y = (pixels[:, 1] - camera.cy) / camera.fy * depth
    return ((torch.stack((x, y, depth), dim=1) - pose[:3, 3]) @ pose[:3, :3]).float()
