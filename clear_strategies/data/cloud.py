"""The initial point cloud of training, which `initial_points` makes by `CloudSettings`.

`PointCloud.source` and `PointCloud.uses_test_views` record where the points come from.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal, NamedTuple, get_args

import torch

from clear_strategies.core.checks import refuse, require_choice, require_number, require_whole
from clear_strategies.core.points import MAX_POINTS, PointCloud
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.data.capture import BLACK, SfmPoints
from clear_strategies.data.depth_files import DepthFile, completed_by_files
from clear_strategies.data.ply import read_points
from clear_strategies.errors import DataError, counted
from clear_strategies.geometry.cameras import common_box
from clear_strategies.geometry.cleaning import OUTLIER_NEIGHBOURS, OUTLIER_RATIO, averaged_in_voxels, without_outliers
from clear_strategies.geometry.dense_stereo.cloud import stereo_cloud
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.filling import STRIDE, densify, pixel_grid
from clear_strategies.geometry.photos import blackened, cut_out
from clear_strategies.geometry.sift import TriangulationSettings, triangulate
from rasterizers.interface import Color

_log = logging.getLogger(__name__)

_FEW_PHOTOS: Final = 5

Init = Literal["auto", "stereo", "triangulated", "sfm_train", "sfm", "ply", "random"]
Compare = Literal["auto", "hr", "lr"]


@dataclass(frozen=True, slots=True)
class CloudSettings:
    """The source of the initial points, and their post-processing.

    Args:
        init: "stereo": from the depth of the training LR images, which are compared with each other under their known
            poses; "triangulated": from features of the same images; "sfm_train": the scene's SfM points that at least
            `min_views` training views observe (their positions still come from all views); "sfm": all of the scene's
            SfM points; "ply": a file; "random" in a box; "auto": stereo if it finds depth in a training view, else
            triangulated if that gives at least `enough` points, else random. Auto never takes points that test views
            were used for.
        path: the PLY file for init=ply.
        min_views: training views that must observe a point, for init=sfm_train.
        enough: the fewest triangulated points that init=auto uses.
        densify: add points between those of `init`, at completed depth, one every `stride` LR px of each view;
            "auto": if the cloud has fewer points than those grids. With stereo, true and auto add points only where
            there is no depth and no other view looks through them. Random points are never densified.
        stride: see `densify`, LR px.
        random_points: how many for init=random.
        box: half the edge of the box of random points around the origin, world units; None: one in the view of all cameras.
        outlier_neighbours, outlier_ratio: a point is removed if the mean distance to its nearest `outlier_neighbours`
            points (itself included) exceeds the average by more than `outlier_ratio` standard deviations; 0
            neighbours: no point is removed.
        voxel: points are averaged in cubes of this edge, world units, by Open3D (extra [open3d]); None: they are not.
        compare: the images that stereo compares. "lr": the LR photos. "hr": the HR images, up to `stereo.max_pixels`. If these
            are photos, maps and points are made at their size; if they are SR images, their depth completes that of the LR
            photos, except before a plain background. "auto": as "hr", but with more than five photos no SR images, since the
            LR photos then give the same depth in a fraction of the time.
        max_points: a larger cloud is reduced to this many points, chosen at random.
        depth: for init=stereo and auto: a folder with a depth file for each training photo, of a sensor or a network, which
            completes stereo where it finds no depth: z along the camera's axis in any unit, as .npy or in PNG or TIFF of 16
            or 32 bits, with the photo's name. None: stereo alone.
        triangulation: for init=stereo, triangulated and auto.
        stereo: for init=stereo and auto.
    """

    init: Init = "auto"
    path: str | None = None
    min_views: int = 2
    enough: int = 50
    densify: bool | Literal["auto"] = "auto"
    stride: int = STRIDE
    random_points: int = 10_000
    box: float | None = None
    outlier_neighbours: int = OUTLIER_NEIGHBOURS
    outlier_ratio: float = OUTLIER_RATIO
    voxel: float | None = None
    compare: Compare = "auto"
    max_points: int = MAX_POINTS
    depth: str | None = None
    triangulation: TriangulationSettings = field(default_factory=TriangulationSettings)
    stereo: StereoSettings = field(default_factory=StereoSettings)

    def __post_init__(self) -> None:
        require_choice("data.cloud.init", self.init, get_args(Init))
        if self.init == "ply" and not self.path:
            refuse("data.cloud.path", "init=ply needs a PLY file", self.path, "add data.cloud.path=…")
        if self.depth is not None and self.init not in ("stereo", "auto"):
            rule = "completes stereo, of init=stereo and auto"
            refuse("data.cloud.depth", rule, self.depth, f"leave out init={self.init}")
        require_choice("data.cloud.compare", self.compare, get_args(Compare))
        require_choice("data.cloud.densify", self.densify, (True, False, "auto"))
        for name in ("min_views", "enough", "stride", "random_points", "max_points"):
            require_whole(f"data.cloud.{name}", getattr(self, name), least=1)
        require_whole("data.cloud.outlier_neighbours", self.outlier_neighbours, least=0)
        if self.outlier_neighbours == 1:
            rule = "must be 0 or at least 2, since a point is the first of its own neighbours"
            refuse("data.cloud.outlier_neighbours", rule, 1, "0 keeps outliers")
        for name in ("box", "outlier_ratio", "voxel"):
            if name == "outlier_ratio" or getattr(self, name) is not None:
                require_number(f"data.cloud.{name}", getattr(self, name), above=0)


def require_source(settings: CloudSettings, sfm: SfmPoints | None) -> None:
    """Raise a DataError, before any photo is decoded, for an `init` whose points do not exist."""
    if settings.init in ("sfm", "sfm_train") and (sfm is None or len(sfm.means) == 0):
        problem = f"there are none, but init={settings.init} asks for them"
        raise DataError("scene", "points", problem, "use init=triangulated or init=random")
    if settings.init == "ply" and not Path(str(settings.path)).is_file():
        raise DataError(str(settings.path), "file", "is not there", "set data.cloud.path to a PLY file")


class InitialPoints(NamedTuple):
    """The initial cloud, and the depth maps of stereo that it was made from, one per photo; empty without stereo."""

    cloud: PointCloud
    depths: tuple[DepthMap, ...] = ()


def initial_points(
    settings: CloudSettings,
    photos: Sequence[Photo],
    *,
    hr: Sequence[Photo] = (),
    hr_is_photo: bool = False,
    files: Sequence[DepthFile] = (),
    sfm: SfmPoints | None = None,
    train_ids: Sequence[int] = (),
    sfm_is_train: bool = False,
    background: Color | None = None,
    seed: int = 0,
) -> InitialPoints:
    """Make the initial point cloud.

    Args:
        photos: the training views at LR.
        hr: the same views at HR, see `CloudSettings.compare`; empty: stereo compares `photos`.
        hr_is_photo: the HR images are photos, not SR images.
        files: the depth files of the views, see `CloudSettings.depth`; empty: there are none.
        sfm: the scene's SfM points; None: it has none.
        train_ids: ids of the training frames in `SfmPoints.track_image`.
        sfm_is_train: every photo of the capture is a training view, so init=auto may take the SfM points as features.
        background: the colour of pixels without a surface (Blender's white), RGB in [0, 1].
    """
    require_source(settings, sfm)
    shown = [blackened(photo) for photo in photos]
    initial: InitialPoints | None = None
    match settings.init:
        case "ply":
            points = read_points(path := Path(str(settings.path)))
            if len(points) == 0:
                raise DataError(path, "element vertex", "has no points", "give another file, or use another init")
            initial = _cleaned(settings, points, photos, background)
        case "sfm" if sfm is not None:
            initial = _cleaned(settings, from_sfm(sfm), photos, background)
        case "sfm_train" if sfm is not None:
            initial = _cleaned(settings, from_tracks(sfm, train_ids, settings.min_views), photos, background)
        case "triangulated":
            features = triangulate(shown, settings.triangulation)
            if len(features) == 0:
                problem = f"none could be triangulated from the {len(photos)} training LR images"
                raise DataError("scene", "points", problem, "use init=random, or more or closer views")
            initial = _cleaned(settings, features, shown, background)
        case "stereo" | "auto":
            known = _sfm_of_training_views(settings, sfm, train_ids) if sfm_is_train else None
            if settings.init == "auto" and sfm is not None and not sfm_is_train:
                _log.debug("init: auto does not use the scene's own points, because test views were used for them.")
            features = triangulate(shown, settings.triangulation) if known is None else known
            shown_hr = [blackened(photo) for photo in hr]
            initial = _from_depth(settings, shown, shown_hr, hr_is_photo, files, features, background)
            if initial is None and len(features) >= settings.enough:
                initial = _cleaned(settings, features, shown, background)
            if initial is None:
                message = "init: auto chose random points: the training LR images give only %d (data.cloud.enough: %d)."
                _log.warning(message, len(features), settings.enough)
            elif settings.init == "auto":
                _log.debug("init: auto chose %s.", initial.cloud.source)
    cloud, depths = initial or InitialPoints(random_cloud(photos, settings.random_points, seed, settings.box))
    if settings.voxel is not None:
        cloud = averaged_in_voxels(cloud, settings.voxel)
    return InitialPoints(cloud.at_most(settings.max_points, seed), depths)


def _sfm_of_training_views(
    settings: CloudSettings, sfm: SfmPoints | None, train_ids: Sequence[int]
) -> PointCloud | None:
    """SfM points for init=auto, of a capture whose photos are all training views; None: fewer than `settings.enough`."""
    if settings.init != "auto" or sfm is None or len(sfm.means) == 0:
        return None
    try:
        cloud = from_tracks(sfm, train_ids, settings.min_views) if len(sfm.track_point) else from_sfm(sfm)
    except DataError:  # no point is observed by `min_views` frames
        return None
    return replace(cloud, uses_test_views="no") if len(cloud) >= settings.enough else None


def _from_depth(
    settings: CloudSettings,
    lr: Sequence[Photo],
    hr: Sequence[Photo],
    hr_is_photo: bool,
    files: Sequence[DepthFile],
    features: PointCloud,
    background: Color | None,
) -> InitialPoints | None:
    """Make points from stereo depth of `lr` or `hr`, see `CloudSettings.compare`; None: init=auto, and no depth was found."""
    stereo, photos, finer = settings.stereo, lr, 1.0
    auto_compares_hr = hr_is_photo or len(lr) <= _FEW_PHOTOS
    compared = hr if settings.compare == "hr" or (settings.compare == "auto" and auto_compares_hr) else ()
    if compared and hr_is_photo:  # photos that show more than LR
        reduced = [photo.reduced(photo.factor_to(stereo.max_pixels)) for photo in hr]
        if (ratio := reduced[0].camera.width / lr[0].camera.width) > 1:
            stereo, photos, finer = stereo.finer(ratio), reduced, ratio
    maps = depth_maps(photos, features.means, stereo, background)
    if compared and not hr_is_photo and not cut_out(lr, background or BLACK):  # SR images complete what LR leaves open
        factor = hr[0].camera.width // lr[0].camera.width
        least = max(photo.factor_to(stereo.max_pixels) for photo in hr)
        divisor = next((k for k in range(least, factor) if factor % k == 0), factor)
        if divisor < factor:
            by = factor // divisor
            images = [photo.reduced(divisor) for photo in hr]
            finest = depth_maps(images, features.means, stereo.finer(by), background)
            maps = [map_lr.completed_by(map_sr.reduced(by)) for map_lr, map_sr in zip(maps, finest, strict=True)]
    if files:
        maps = completed_by_files(maps, files, photos, features.means, background)
    cloud = stereo_cloud(
        features, photos, maps, stereo, background=background, fill=settings.densify is not False,
        stride=round(finer * settings.stride),  # completed points stay as few as at LR
        outlier_neighbours=settings.outlier_neighbours, outlier_ratio=settings.outlier_ratio,
    )  # fmt: skip
    if cloud is None and settings.init == "stereo":
        none = f"stereo confirms no depth in any of the {len(lr)} training LR images"
        raise DataError("scene", "points", none, "use init=triangulated or random, or closer views")
    if cloud is not None and files:  # of a sensor, or of a network that may have seen any photo
        cloud = replace(cloud, source=f"{cloud.source}, with depth files", uses_test_views="unknown")
    return None if cloud is None else InitialPoints(cloud, tuple(maps))


def _cleaned(
    settings: CloudSettings, cloud: PointCloud, photos: Sequence[Photo], background: Color | None
) -> InitialPoints:
    """Remove outliers, and densify the cloud as `settings.densify` says."""
    cloud = without_outliers(cloud, settings.outlier_neighbours, settings.outlier_ratio)
    grid = sum(len(pixel_grid(photo, settings.stride)) for photo in photos)
    if settings.densify == "auto" and len(cloud) >= grid:
        _log.debug("densify: auto adds nothing: the cloud has %d points, the views' grids %d.", len(cloud), grid)
    elif settings.densify:
        cloud = densify(cloud, photos, settings.stride, background)
    return InitialPoints(cloud)


def from_sfm(sfm: SfmPoints) -> PointCloud:
    """All of the scene's SfM points. They were triangulated from all views, test views included."""
    return PointCloud(sfm.means.float(), sfm.colors.float(), sfm.source, uses_test_views="yes")


def from_tracks(sfm: SfmPoints, train_ids: Sequence[int], min_views: int) -> PointCloud:
    """The scene's SfM points that at least `min_views` of the frames `train_ids` observe.

    Their positions still come from all views, test views included, so `uses_test_views` is "yes".
    """
    if len(sfm.track_point) == 0:
        raise DataError("scene", "points", "come without tracks", "use init=triangulated, or init=sfm for all of them")
    observed = torch.isin(sfm.track_image, torch.tensor(list(train_ids), dtype=sfm.track_image.dtype))
    pairs = torch.unique(torch.stack((sfm.track_point[observed], sfm.track_image[observed]), dim=1), dim=0)
    kept = torch.nonzero(torch.bincount(pairs[:, 0], minlength=len(sfm.means)) >= min_views)[:, 0]
    if len(kept) == 0:
        problem = f"none is observed by {min_views} of the {counted(len(train_ids), 'training view')}"
        raise DataError("scene", "points", problem, "lower min_views, or use init=triangulated")
    source = f"{len(kept):,} points observed by >= {min_views} training views, of {sfm.source}"
    return PointCloud(sfm.means.float(), sfm.colors.float(), source, uses_test_views="yes")[kept]


def random_cloud(photos: Sequence[Photo], count: int, seed: int, box: float | None = None) -> PointCloud:
    """Sample points uniformly, nearly grey, in a box around the origin of half-edge `box`, world units; None: `common_box`."""
    if box is None:
        (low, high), where = common_box(photos), "the cameras' common box"
    else:
        low, high, where = torch.full((3,), -box), torch.full((3,), box), f"[-{box:g}, {box:g}]³"
    g = torch.Generator().manual_seed(seed)
    means = low + (high - low) * torch.rand(count, 3, generator=g)
    # Equal colours would give all points equal colour gradients.
    colors = 0.5 + (torch.rand(count, 3, generator=g) - 0.5) * 0.1
    return PointCloud(means, colors, f"random: {count:,} points in {where}")
