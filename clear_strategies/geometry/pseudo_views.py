"""Pseudo views: images at cameras beside the training cameras, warped from the LR photos by stereo depth.

A pseudo view's camera is a training camera moved aside. Its depth is that of the nearest photos' surfaces, its colours are those
of the photos that see the same surface; where no photo does, the colour is unknown. A border view has a training camera with a
wider field: its photo is known, the border around it is not. `clear_strategies.strategies.pseudo_views` trains on them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Final, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.cameras import moved_aside
from clear_strategies.geometry.photos import is_background
from clear_strategies.geometry.projection import inside, projection_matrix
from rasterizers.interface import Camera, Color

_SOURCES: Final = 4  # the nearest photos that a pseudo view is warped from
_NEIGHBOURS: Final = 3  # least number of known pixels in a pixel's 3 × 3 window; with fewer, it is an outlier


class _Source(NamedTuple):
    """A photo with depth: its points, its depth, 0 where its colours are not used, and the median of its depth.

    Points are in camera coordinates, so that float32 resolves them wherever the world's origin is, and stored as rows x, y, z, so
    that torch computes with contiguous coordinates.
    """

    photo: Photo
    points: Float[Tensor, "3 N"]
    depth: Float[Tensor, "h w"]
    median: float


def pseudo_views(
    photos: Mapping[str, Photo],
    depths: Mapping[str, DepthMap],
    *,
    count: int,
    reach: float,
    tolerance: float,
    max_pixels: int,
    background: Color,
    seed: int,
) -> list[Callable[[], Photo]]:
    """Return functions that make `count` pseudo views of the training cameras in turn; none if fewer than two photos have depth.

    Pixels whose colour is unknown are black and not `shown`.

    Args:
        photos, depths: by the photos' names, on one device, where the pseudo views are made.
        reach: largest distance of a pseudo camera from its photo's, as a multiple of the photo's median depth.
        tolerance: relative difference of depth up to which a photo shows a point.
        max_pixels: larger photos are reduced by a whole factor first.
        background: its colour belongs to no surface.
    """
    sources = []
    for name, photo in photos.items():
        factor = photo.factor_to(max_pixels)
        if name in depths and bool((depth_map := depths[name].reduced(factor)).known.any()):
            sources.append(_source(photo.reduced(factor), depth_map, background))
    if len(sources) < 2:
        return []
    generator = torch.Generator().manual_seed(seed)
    views = list[Callable[[], Photo]]()
    for i in range(count):
        source = sources[i % len(sources)]
        camera = moved_aside(source.photo.camera, source.median, reach, generator)
        views.append(partial(_warped, camera, sources, tolerance))
    return views


def border_view(photo: Photo, *, field: float, max_pixels: int) -> Photo:
    """Place the photo, reduced to at most `max_pixels`, in the middle of an image `field` times as wide and as high, of which
    the rest is not `shown`.
    """
    photo = photo.reduced(photo.factor_to(max_pixels))
    c = photo.camera
    x, y = (round(n * (field - 1) / 2) for n in (c.width, c.height))
    wide = replace(c, cx=c.cx + x, cy=c.cy + y, width=c.width + 2 * x, height=c.height + 2 * y)
    through = None if photo.transparency is None else F.pad(photo.transparency, (x, x, y, y))
    return Photo(wide, F.pad(photo.image, (0, 0, x, x, y, y)), F.pad(photo.visible, (x, x, y, y)), through)


def _source(photo: Photo, depth_map: DepthMap, background: Color) -> _Source:
    """Make a source. The colours beside the background, or beside what a mask hides, are mixed with it, and not used."""
    known, depth = depth_map.known, torch.nan_to_num(depth_map.depth)
    points = _behind(photo.camera, depth)[:, known.flatten()]
    apart = is_background(photo.image, background) | ~photo.visible
    mixed = F.max_pool2d(apart[None, None].float(), 3, 1, 1)[0, 0] > 0
    return _Source(photo, points, torch.where(known & ~mixed, depth, 0.0), float(depth[known].median()))


def _warped(camera: Camera, sources: Sequence[_Source], tolerance: float) -> Photo:
    away = torch.stack([torch.linalg.vector_norm(s.photo.camera.center - camera.center) for s in sources])
    nearest = [sources[i] for i in away.argsort()[:_SOURCES].tolist()]
    depth = _front(camera, nearest)
    known = depth.isfinite()
    points = _behind(camera, torch.where(known, depth, 1.0))
    color, weight = torch.zeros_like(points), points.new_zeros(points.shape[1])
    for s in nearest:
        shows, colors = _seen(s, camera, points, tolerance)
        w = shows.float().div_(float((s.photo.camera.center - camera.center).square().sum().clamp_min(1e-24)))
        color += colors.mul_(w)  # the nearest counts most
        weight += w
    image = color.div_(weight.clamp_min(torch.finfo(weight.dtype).tiny)).clamp_(0, 1).reshape(3, *known.shape)
    known &= (weight > 0).reshape(known.shape)
    around = 9 * F.avg_pool2d(known[None, None].float(), 3, 1, 1)[0, 0]
    known &= around >= _NEIGHBOURS - 0.5
    return Photo(camera, torch.where(known, image, 0.0).permute(1, 2, 0).contiguous(), known)


def _front(camera: Camera, sources: Sequence[_Source]) -> Float[Tensor, "h w"]:
    """The depth of the nearest point at each pixel, infinite without one. A point covers 2 × 2 pixels, which closes holes."""
    width, height = camera.width + 1, camera.height + 1
    outside = height * width
    front = sources[0].depth.new_full((outside + 1,), torch.inf)
    for s in sources:
        x, y, depth = _projected(s.points, s.photo.camera, camera)
        # The lower right one of its four pixels, with a border of one pixel.
        column, row = x.add_(0.5).floor_(), y.add_(0.5).floor_()
        shown = inside(column, row, depth, width, height)
        place = torch.where(shown, row.mul_(width).add_(column), outside).long()
        front.scatter_reduce_(0, place, depth, "amin")
    front = front[:outside].reshape(height, width)
    front = torch.minimum(front[:-1], front[1:])
    return torch.minimum(front[:, :-1], front[:, 1:])


def _seen(
    source: _Source, camera: Camera, points: Float[Tensor, "3 N"], tolerance: float
) -> tuple[Bool[Tensor, " N"], Float[Tensor, "3 N"]]:
    """(True where the photo shows a point of the camera, i.e. its depth there agrees up to `tolerance`; the photo's colours)."""
    own = source.photo.camera
    x, y, depth = _projected(points, camera, own)
    shown = inside(x, y, depth, own.width, own.height)
    place = torch.where(shown, y.floor().mul_(own.width).add_(x.floor()), 0.0).long()
    grid = torch.view_as_real(torch.complex(x.mul_(2 / own.width).sub_(1), y.mul_(2 / own.height).sub_(1)))
    image = source.photo.image.permute(2, 0, 1)[None]
    colors = F.grid_sample(image, grid[None, None], padding_mode="border", align_corners=False)[0, :, 0]
    return shown & ((source.depth.flatten()[place] / depth - 1).abs() <= tolerance), colors


def _projected(points: Float[Tensor, "3 N"], of: Camera, to: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Project points in coordinates of one camera to (columns, rows, depths) of another, meaningful where depth > 0."""
    matrix = (projection_matrix(to) @ torch.linalg.inv(of.world_to_camera.double())).to(points)
    x, y, depth = torch.addmm(matrix[:, 3:], matrix[:, :3], points)
    return x.div_(depth), y.div_(depth), depth


def _behind(camera: Camera, depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 N"]:
    """The points on the rays of all pixels at these depths, in camera coordinates."""
    numbers = partial(torch.arange, dtype=torch.float64, device=depth.device)
    x = (numbers(camera.width) + (0.5 - camera.cx)) / camera.fx
    y = (numbers(camera.height) + (0.5 - camera.cy)) / camera.fy
    return torch.stack((x.float() * depth, y.float()[:, None] * depth, depth)).flatten(1)


def continued(image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Fill unknown pixels by a smooth continuation of the colours around; return `image` itself if nothing is known.

    A pull-push pyramid: each level halves the one before by means over known pixels, and a pixel is known if one of its four is.
    From the coarsest level down, each unknown pixel takes the colour of the coarser level, so that colours become smoother the
    further away known pixels are.
    """
    if not bool(known.any()):
        return image
    mask = known[None, None].to(image)
    colors = torch.where(known[..., None], image, 0.0).permute(2, 0, 1)[None]
    return _filled(colors, mask)[0].permute(1, 2, 0).clamp(0, 1)


def _filled(colors: Float[Tensor, "1 3 h w"], mask: Float[Tensor, "1 1 h w"]) -> Float[Tensor, "1 3 h w"]:
    """Fill `colors`, which are 0 where unknown, where `mask` is 0; it is 1 at one pixel at least."""
    if bool(mask.all()):
        return colors
    sums, share = (F.avg_pool2d(x, 2, ceil_mode=True) for x in (colors, mask))  # of each block of four
    coarse = _filled(sums / share.clamp_min(torch.finfo(share.dtype).tiny), (share > 0).to(mask))
    height, width = mask.shape[2:]
    finer = F.interpolate(coarse, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
    return torch.where(mask > 0, colors, finer)
