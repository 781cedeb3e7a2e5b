"""Draws the second scale of a view together with the first, before it is asked for: hosts ask for the two one by one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, Final

from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Camera, Rasterizer, Rendering, Splats, with_depth
from rasterizers.torch_internals import version


class _Ahead(threading.local):
    """The image that is drawn ahead.

    Attributes:
        wanted: its camera, until it is drawn.
        kept: what it shows, the image, and the splats, kept alive so that no other tensors get their addresses.
    """

    wanted: Camera | None = None
    kept: tuple[tuple[Any, ...], Rendering, Splats] | None = None


_ahead: Final = _Ahead()


def _grid(camera: Camera) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height


def _shown(rasterizer: Rasterizer, splats: Splats, camera: Camera, depth: bool) -> tuple[Any, ...]:
    """A key of an image: equal for equal images, as long as the tensors are alive."""
    tensors = (getattr(splats, field.name) for field in fields(Splats))
    memory = [None if x is None else (x.data_ptr(), x.shape, x.stride(), version(x)) for x in tensors]
    return rasterizer, memory, _grid(camera), camera.world_to_camera.tolist(), depth


@contextmanager
def drawing_ahead(viewmat: Float[Tensor, "4 4"], K: Float[Tensor, "3 3"], width: int, height: int) -> Iterator[None]:
    """The first drawing from this pose in the context also draws the image of the same splats by K and without `rgb_offset`.

    The two share projection, colours and depth order. If the second image is asked for in the context, it is ready; it is dropped
    at the end.
    """
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    _ahead.wanted, _ahead.kept = Camera(viewmat.detach(), fx, fy, cx, cy, width, height), None
    try:
        yield
    finally:
        _ahead.wanted = _ahead.kept = None


def is_active() -> bool:
    """Whether an image is to be drawn ahead, or has been and is not yet asked for."""
    return _ahead.wanted is not None or _ahead.kept is not None


def draw(rasterizer: Rasterizer, splats: Splats, camera: Camera, *, depth: bool) -> Rendering:
    """The image, drawn now or ahead."""
    if _ahead.kept is not None and _ahead.kept[0] == _shown(rasterizer, splats, camera, depth):
        rendering, _ahead.kept = _ahead.kept[1], None
        return rendering
    wanted = _ahead.wanted
    if wanted is not None and camera.world_to_camera.tolist() == wanted.world_to_camera.tolist():
        _ahead.wanted = None
        if splats.rgb_offset is not None or _grid(camera) != _grid(wanted):  # else this is the image itself
            plain = replace(splats, rgb_offset=None)
            other = replace(wanted, world_to_camera=camera.world_to_camera)  # so that both share a tensor
            both = [(plain, other), (splats, camera)]
            drawn, rendering = rasterizer.render_scales(both, **({"depth": [True] * 2} if depth else {}))
            _ahead.kept = _shown(rasterizer, plain, other, depth), drawn, plain
            return rendering
    return with_depth(rasterizer, depth)(splats, camera)
