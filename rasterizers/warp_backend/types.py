"""The data types that the kernels share: structures, which are passed by value or lie in arrays."""

from __future__ import annotations

from typing import Any, Final

import warp as wp

from rasterizers.warp_backend.sizes import TILE

wp.set_module_options({"enable_backward": False})

PIXELS: Final = TILE**2
"""Pixels of a tile."""
SUMS: Final = 6
"""Sums of a pair for one cotangent before those of the colour: q = ∂L/∂(log alpha) and its moments."""

Moments: Final[Any] = wp.types.vector(length=SUMS, dtype=wp.float32)
"""Those sums over pixels: q times 1, u, d_y, u², u d_y and d_y² with `Ellipse`'s u and d_y of the pixel."""


def width_of(K: int, absolute: bool) -> int:
    """Sums of a pair: for each of K cotangents `SUMS` and three of the colour, and two of absolute gradients."""
    return (SUMS + 3) * K + 2 * absolute


FAR: Final = 2**31 - 1
"""The depth key of a Gaussian that is not drawn."""


@wp.struct
class Pose:
    """World to camera, in float64 for projected centres, and the camera's position."""

    rotation: wp.mat33
    exact_rotation: wp.mat33d
    exact_translation: wp.vec3d
    center: wp.vec3


@wp.struct
class Grid:
    """One pixel grid of a pose, and the tangents at which the Jacobian is clamped."""

    exact_focal: wp.vec2d
    exact_principal: wp.vec2d
    focal: wp.vec2
    size: wp.vec2i
    tiles: wp.vec2i  # columns and rows of tiles
    low: wp.vec2
    high: wp.vec2


@wp.struct
class Cuts:
    """The numbers of `rasterizers.interface.RasterSettings`."""

    kernel: wp.float32
    near: wp.float64
    near_bits: wp.int64  # of `near`: depth keys count from here
    alpha_min: wp.float32
    alpha_max: wp.float32
    transmittance_min: wp.float32
    antialiased: wp.bool


@wp.struct
class Ellipse:
    """A projected Gaussian: alpha = opacity · exp(-(A u² + D dy²)) with u = dx + S dy, at (dx, dy) px from its centre.

    A conic's expanded form, A dx² + B dx dy + C dy², would lose all digits far along a thin Gaussian, where its terms cancel.
    """

    whole: wp.vec2  # the pixel corner nearest to the centre, px: at 1,000 px a float32 resolves 6e-5 px
    rest: wp.vec2  # the centre minus `whole`
    A: wp.float32
    S: wp.float32
    D: wp.float32
    opacity: wp.float32  # after the Mip compensation
    reach: wp.float32  # alpha >= alpha_min within A u² + D dy² <= reach, with a margin
    half: wp.vec2  # half the box around that region, px
    rgb: wp.vec3  # before its clamp at 0
