"""Colour from spherical harmonics, and its derivative along the Gaussian's position (`slope`).

The direction does not depend on the resolution, so colour and slope are computed once for all grids. The slope (nine
numbers) is kept, so the VJP does not read the coefficients again.
"""

from __future__ import annotations

import warp as wp

from rasterizers.warp_backend.types import Pose

wp.set_module_options({"enable_backward": False})


@wp.func
def band(k: wp.int32, d: wp.vec3) -> wp.vec4:  # noqa: PLR0911, PLR0912 - a table
    """Y_k(d) and its derivatives with respect to d, with the signs of 3DGS."""
    x, y, z = d[0], d[1], d[2]
    xx, yy, zz = x * x, y * y, z * z
    c1, a, b, c = 0.4886025119029199, 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
    p, q, r, s, t = -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, 1.445305721320277
    if k == 0:
        return wp.vec4(0.28209479177387814, 0.0, 0.0, 0.0)
    if k == 1:
        return wp.vec4(-c1 * y, 0.0, -c1, 0.0)
    if k == 2:
        return wp.vec4(c1 * z, 0.0, 0.0, c1)
    if k == 3:
        return wp.vec4(-c1 * x, -c1, 0.0, 0.0)
    if k == 4:
        return wp.vec4(a * x * y, a * y, a * x, 0.0)
    if k == 5:
        return wp.vec4(-a * y * z, 0.0, -a * z, -a * y)
    if k == 6:
        return wp.vec4(b * (2.0 * zz - xx - yy), -2.0 * b * x, -2.0 * b * y, 4.0 * b * z)
    if k == 7:
        return wp.vec4(-a * x * z, -a * z, 0.0, -a * x)
    if k == 8:
        return wp.vec4(c * (xx - yy), 2.0 * c * x, -2.0 * c * y, 0.0)
    if k == 9:
        return wp.vec4(p * y * (3.0 * xx - yy), 6.0 * p * x * y, 3.0 * p * (xx - yy), 0.0)
    if k == 10:
        return wp.vec4(q * x * y * z, q * y * z, q * x * z, q * x * y)
    if k == 11:
        return wp.vec4(r * y * (4.0 * zz - xx - yy), -2.0 * r * x * y, r * (4.0 * zz - xx - 3.0 * yy), 8.0 * r * y * z)
    if k == 12:
        return wp.vec4(
            s * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -6.0 * s * x * z, -6.0 * s * y * z, 3.0 * s * (2.0 * zz - xx - yy)
        )
    if k == 13:
        return wp.vec4(r * x * (4.0 * zz - xx - yy), r * (4.0 * zz - 3.0 * xx - yy), -2.0 * r * x * y, 8.0 * r * x * z)
    if k == 14:
        return wp.vec4(t * z * (xx - yy), 2.0 * t * x * z, -2.0 * t * y * z, t * (xx - yy))
    return wp.vec4(p * x * (xx - 3.0 * yy), 3.0 * p * (xx - yy), -6.0 * p * x * y, 0.0)


@wp.func
def colour_of(
    mean: wp.vec3, center: wp.vec3, base: wp.vec3, higher: wp.array2d[wp.vec3], i: wp.int32
) -> tuple[wp.vec3, wp.mat33]:
    """Colour of Gaussian i before offset and clamp, and ∂rgb/∂mean."""
    offset = mean - center
    distance = wp.length(offset)
    direction = offset / distance
    rgb = wp.vec3(0.5, 0.5, 0.5) + band(0, direction)[0] * base
    slope = wp.mat33()
    for k in range(higher.shape[1]):
        y = band(k + 1, direction)
        rgb += y[0] * higher[i, k]
        slope += wp.outer(higher[i, k], wp.vec3(y[1], y[2], y[3]))
    # The derivative of the unit direction: (I - d dᵀ) / distance.
    return rgb, (slope - wp.outer(slope * direction, direction)) / distance


@wp.kernel
def basis(
    poses: wp.array[Pose], means: wp.array[wp.vec3], visible: wp.array2d[wp.bool], Y: wp.array2d[wp.float32]
) -> None:
    """Y of the Gaussians that are visible on a grid, 0 of the others."""
    i = wp.tid()
    direction, seen = wp.normalize(means[i] - poses[0].center), wp.bool(False)
    for grid in range(visible.shape[0]):
        seen = seen or visible[grid, i]
    for k in range(Y.shape[1]):
        Y[i, k] = wp.where(seen, band(k, direction)[0], 0.0)
