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
from clear_strategies.geometry.projection import inside, slopes
from rasterizers.interface import Camera, Color

_SOURCES: Final = 4  # the nearest photos that a pseudo view is warped from
_STEEP: Final = (
    0.3  # largest slope of a surface, change of its inverse depth from one pixel to the next relative to its own
)
_NEIGHBOURS: Final = 3  # least number of known pixels in a pixel's 3 × 3 window; with fewer, it is an outlier


class _Source(NamedTuple):
    """A photo with depth, nan where unknown, the planes of its surfaces, True where its colours are used, and the median depth.

    The plane p of a pixel is that of the points X with p · X = 1. Points and planes are in camera coordinates, so that float32
    resolves them wherever the world's origin is, and stored as rows x, y, z, so that torch computes with contiguous coordinates.
    """

    photo: Photo
    depth: Float[Tensor, "h w"]
    planes: Float[Tensor, "3 N"]
    colored: Bool[Tensor, " N"]
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
    known = depth_map.known
    depth = torch.where(known, depth_map.depth, torch.nan)
    apart = is_background(photo.image, background) | ~photo.visible
    mixed = F.max_pool2d(apart[None, None].float(), 3, 1, 1)[0, 0] > 0
    return _Source(photo, depth, _planes(photo.camera, depth), (known & ~mixed).flatten(), float(depth[known].median()))


def _planes(camera: Camera, depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 N"]:
    """The plane of the surface at each pixel. Inverse depth, p · (x, y, 1), is linear on it."""
    inverse = 1 / depth
    across, down = camera.fx * slopes(inverse, 1), camera.fy * slopes(inverse, 0)
    x, y = _rays(camera, depth.device)
    return torch.stack((across, down, inverse - x * across - y * down)).flatten(1)


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
    """The depth of the nearest surface at each pixel, infinite without one. A point covers the 2 × 2 pixels around it, which
    closes holes, at the depths of its plane there: seen at a grazing angle, a surface is much nearer a pixel further.
    """
    width, height = camera.width + 2, camera.height + 2  # with a border of one pixel
    outside = height * width
    front = sources[0].depth.new_zeros(outside + width + 2)  # the inverse depth
    for s in sources:
        points = _moved(_behind(s.photo.camera, s.depth), s.photo.camera, camera)
        x, y = _pixels(camera, points)
        column, row = (x + 0.5).floor_(), (y + 0.5).floor_()  # of the upper left one of the four pixels
        shown = inside(column, row, points[2], width - 1, height - 1)
        place = torch.where(shown, row.mul(width).add_(column), outside).long()
        inverse = 1 / points[2]
        limit = _STEEP * inverse
        across, down = (slope.clamp_(-limit, limit) for slope in _slopes(s, camera))
        value = inverse + across * (column - 0.5 - x) + down * (row - 0.5 - y)
        for step, change in ((0, 0.0), (1, across), (width, down), (width + 1, across + down)):
            front.scatter_reduce_(0, place + step, value + change, "amax")
    return 1 / front[:outside].reshape(height, width)[1:-1, 1:-1]


def _slopes(source: _Source, camera: Camera) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """How much the inverse depth of the source's planes, seen from another camera, changes per (column, row)."""
    turn, shift = _move(camera, source.photo.camera, source.planes)
    across, down, _ = turn.T @ source.planes / (1 - shift.T @ source.planes)
    return across / camera.fx, down / camera.fy


def _seen(
    source: _Source, camera: Camera, points: Float[Tensor, "3 N"], tolerance: float
) -> tuple[Bool[Tensor, " N"], Float[Tensor, "3 N"]]:
    """(True where the photo shows a point of the camera, i.e. its depth there agrees up to `tolerance`; the photo's colours)."""
    own = source.photo.camera
    points = _moved(points, camera, own)
    x, y = _pixels(own, points)
    shown = inside(x, y, points[2], own.width, own.height)
    place = torch.where(shown, y.floor().mul_(own.width).add_(x.floor()), 0.0).long()
    nearer = (source.planes[:, place] * points).sum(0)  # than the surface on the same ray, by this factor
    grid = torch.view_as_real(torch.complex(x.mul_(2 / own.width).sub_(1), y.mul_(2 / own.height).sub_(1)))
    image = source.photo.image.permute(2, 0, 1)[None]
    colors = F.grid_sample(image, grid[None, None], padding_mode="border", align_corners=False)[0, :, 0]
    return shown & source.colored[place] & ((1 / nearer - 1).abs() <= tolerance), colors


def _move(of: Camera, to: Camera, like: Tensor) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3 1"]]:
    """The rotation and translation from coordinates of one camera to those of another."""
    move = (to.world_to_camera.double() @ torch.linalg.inv(of.world_to_camera.double())).to(like)
    return move[:3, :3], move[:3, 3:]


def _moved(points: Float[Tensor, "3 N"], of: Camera, to: Camera) -> Float[Tensor, "3 N"]:
    """Points in coordinates of one camera, in those of another."""
    turn, shift = _move(of, to, points)
    return torch.addmm(shift, turn, points)


def _pixels(camera: Camera, points: Float[Tensor, "3 N"]) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """(columns, rows) of points in the camera's coordinates, meaningful where they lie before it."""
    x, y, depth = points
    return (x / depth).mul_(camera.fx).add_(camera.cx), (y / depth).mul_(camera.fy).add_(camera.cy)


def _behind(camera: Camera, depth: Float[Tensor, "h w"]) -> Float[Tensor, "3 N"]:
    """The points on the rays of all pixels at these depths, in camera coordinates."""
    x, y = _rays(camera, depth.device)
    return torch.stack((x * depth, y * depth, depth)).flatten(1)


def _rays(camera: Camera, device: torch.device) -> tuple[Float[Tensor, " w"], Float[Tensor, "h 1"]]:
    """The rays through the pixels: x / z of each column and y / z of each row."""
    numbers = partial(torch.arange, dtype=torch.float64, device=device)
    x = (numbers(camera.width) + (0.5 - camera.cx)) / camera.fx
    y = (numbers(camera.height) + (0.5 - camera.cy)) / camera.fy
    return x.float(), y.float()[:, None]


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
