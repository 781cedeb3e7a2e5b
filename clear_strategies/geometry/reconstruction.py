"""Depth maps and a coloured cloud from photos and cameras as torch tensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.checks import as_color
from clear_strategies.core.points import PointCloud
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.errors import DataError
from clear_strategies.geometry.cameras import centers_of, warn_if_far
from clear_strategies.geometry.dense_stereo.cloud import stereo_cloud
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.photos import blackened, camera_of, image_of, require_shape
from clear_strategies.geometry.projection import seen_pixels
from clear_strategies.geometry.sift import features_of
from rasterizers.modes import on_cpu_by_default


@dataclass(frozen=True, slots=True, eq=False)
class Stereo:
    """The result of `stereo`, on the device of the photos.

    Args:
        depths: one for each photo: `depth` [h, w], z in world units at each pixel's centre, nan where unknown, and
            `confidence` [h, w] in [0, 1], 0 where unknown.
        means: positions of the points, world units.
        colors: of the points, RGB in [0, 1].
        summary: one line: the number of points, the share of each photo whose depth is known, and steps left out because a
            library is missing.
    """

    depths: tuple[DepthMap, ...]
    means: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    summary: str


@on_cpu_by_default
def stereo(
    images: Sequence[Tensor] | Tensor,
    world_to_camera: Tensor,
    Ks: Tensor,
    *,
    background: Sequence[float] | None = None,
    masks: Sequence[Tensor | None] | None = None,
    settings: StereoSettings | None = None,
    fill: bool = True,
    features: tuple[Tensor, Tensor] | None = None,
) -> Stereo:
    """Compute depth maps and a cloud by dense stereo between photos with known poses, as the trainer's data.cloud.init=stereo.

    The result is deterministic, and its bits do not depend on the number of threads. The trainer reduces clouds of more than
    200,000 points; here all of them are returned.

    Args:
        images: V >= 2 photos, each [h, w, 3] and of any size, or one tensor [V, h, w, 3]; uint8, or floating point in
            [0, 1].
        world_to_camera: [V, 4, 4], rigid, OpenCV axes (x right, y down, z forward).
        Ks: [V, 3, 3], focal lengths and principal points in pixels of each photo, without skew; pixel (0, 0) spans
            [0, 1)².
        background: the colour of pixels without a surface, RGB in [0, 1], e.g. Blender's white; None: every pixel shows
            a surface.
        masks: one for each photo, [h, w] of its size: 0 or False hides a pixel, which then gives neither depth nor points; None
            among them, or in their place: nothing is hidden.
        settings: None: `StereoSettings()`.
        fill: add points at completed depth where a photo's depth is unknown. Needs SciPy.
        features: (means [N, 3] in world units, colors [N, 3] in [0, 1]) of known points, e.g. COLMAP's. They give the range of
            depth, the maps are checked against them, and they are part of the cloud where depth is unknown. None: features of
            the photos are triangulated, which needs OpenCV, kornia and SciPy; without them, the cameras give the range.

    Raises:
        DataError: a shape, range or camera is wrong, there are fewer than two photos, or stereo confirms no depth.
    """
    color = None if background is None else as_color("background", list(background))
    settings = settings or StereoSettings()
    photos = _photos(images, world_to_camera, Ks, masks)
    warn_if_far(centers_of([photo.camera for photo in photos]))
    known = features_of(photos) if features is None else _features(*features)
    known = known[_unhidden(known.means, photos).nonzero()[:, 0]]
    maps = depth_maps(photos, known.means, settings, color)
    cloud = stereo_cloud(known, photos, maps, settings, background=color, fill=fill)
    if cloud is None:
        raise DataError(
            "stereo", "images", f"stereo confirms no depth in any of the {len(photos)} photos",
            "check the poses (world-to-camera, OpenCV axes) and Ks (in pixels of these photos), or give photos that see the same "
            "surfaces from 1 to 45 degrees apart",
        )  # fmt: skip
    summary = cloud.source if features is not None or len(known) else f"{cloud.source}; {known.source}"
    means, colors = (x.to(photos[0].image.device) for x in (cloud.means, cloud.colors))
    return Stereo(tuple(maps), means, colors, f"{len(cloud):,} points in all: {summary}")


def _photos(
    images: Sequence[Tensor] | Tensor, poses: Tensor, Ks: Tensor, masks: Sequence[Tensor | None] | None
) -> list[Photo]:
    """Check the arguments of `stereo`, and make photos of them, black at hidden pixels."""
    count = len(images)
    _require(
        count >= 2, "images", f"must be at least 2 photos, got {count}", "depth needs a second photo of the surfaces"
    )
    require_shape("stereo", "world_to_camera", poses, (count, 4, 4), "stack one per photo")
    require_shape("stereo", "Ks", Ks, (count, 3, 3), "stack one per photo")
    masks = [None] * count if masks is None else masks
    found = f"must be one for each of {count} photos, got {len(masks)}"
    _require(len(masks) == count, "masks", found, "give None where none hides")
    photos = []
    for i, (image, pose, K, mask) in enumerate(zip(images, poses.cpu(), Ks.cpu(), masks, strict=True)):
        color = image_of("stereo", f"images[{i}]", image).to(images[0].device)
        camera = camera_of("stereo", (f"world_to_camera[{i}]", pose), (f"Ks[{i}]", K), color)
        if mask is not None:
            require_shape("stereo", f"masks[{i}]", mask, color.shape[:2], "give [h, w] of the photo")
        shown = None if mask is None else mask.detach().to(color.device) > 0
        photos.append(blackened(Photo(camera, color, shown)))
    return photos


def _unhidden(points: Float[Tensor, "N 3"], photos: Sequence[Photo]) -> Bool[Tensor, " N"]:
    """False for points that lie only at hidden pixels of the photos."""
    shown, hidden = torch.zeros(len(points), dtype=torch.bool), torch.zeros(len(points), dtype=torch.bool)
    for photo in photos:
        inside, row, column, _ = seen_pixels(photo.camera, points)
        visible = photo.visible.cpu()[row, column]
        shown[inside] |= visible
        hidden[inside] |= ~visible
    return shown | ~hidden


def _features(means: Tensor, colors: Tensor) -> PointCloud:
    means, colors = (x.detach().cpu().float() for x in (means, colors))
    pair = means.ndim == 2 and means.shape[1] == 3 and means.shape == colors.shape
    found = f"must be positions [N, 3] and colours [N, 3], got {tuple(means.shape)} and {tuple(colors.shape)}"
    _require(pair, "features", found, "give a pair (means, colors)")
    _require(bool(means.isfinite().all()), "features", "must have finite positions", "remove the others")
    in_range = bool(((colors >= 0) & (colors <= 1)).all())
    _require(in_range, "features", "must have colours in [0, 1]", "divide 8-bit values by 255")
    return PointCloud(means, colors, f"{len(means):,} given points")


def _require(condition: bool, field: str, problem: str, remedy: str) -> None:
    if not condition:
        raise DataError("stereo", field, problem, remedy)
