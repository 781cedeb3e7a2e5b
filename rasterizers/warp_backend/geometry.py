"""Projection of one Gaussian to an ellipse, and its VJP. Arithmetic only; no arrays.

    Σ' = T Tᵀ + kernel·I,   T = J W R(q) diag(s)   (2 × 3)

Determinants are sums of squared minors of the factor T (Cauchy-Binet), because ac - b² loses all digits for a needle.
"""

from __future__ import annotations

import warp as wp

from rasterizers.warp_backend.types import Cuts, Grid, Moments, Pose

wp.set_module_options({"enable_backward": False})


@wp.struct
class Centre:
    """Depth and tangents in float64: in float32, an image coordinate of 1,000 px is off by 1e-4 px, which shifts thin needles."""

    z: wp.float64
    tan: wp.vec2d


@wp.struct
class Geometry:
    """The part of a projection that does not depend on the focal length; the grids of a pose share it."""

    inverse_z: wp.float32
    tan: wp.vec2  # x/z, y/z
    limited: wp.vec2  # `tan`, clamped far outside the image, where the affine approximation diverges
    unit: wp.vec4  # q / |q|
    inverse_norm: wp.float32
    rotation: wp.mat33  # of the Gaussian
    axes: wp.mat33  # W R diag(s)
    x: wp.vec3  # the rows of T for focal length 1
    y: wp.vec3


@wp.struct
class Footprint:
    """The ellipse. Lengths are in units of `size`, the larger of T's largest entry and √kernel, so that fourth powers neither
    overflow nor underflow.
    """

    X: wp.vec3  # the rows of T
    Y: wp.vec3
    size: wp.float32
    kernel: wp.float32  # / size²
    a: wp.float32  # T Tᵀ / size²
    c: wp.float32
    normal: wp.vec3  # X × Y / size²
    area: wp.float32  # length of `normal`, √det(T Tᵀ) / size²
    det: wp.float32  # det Σ' / size⁴
    A: wp.float32  # dᵀ Σ'⁻¹ d = A (dx + S dy)² + D dy²: a sum of squares, without cancellation
    S: wp.float32
    D: wp.float32
    compensation: wp.float32  # Mip-Splatting: √(det T Tᵀ / det Σ'), opacity factor that makes up for the kernel's blur


@wp.func
def centre_of(pose: Pose, mean: wp.vec3) -> Centre:
    exact = wp.vec3d(wp.float64(mean[0]), wp.float64(mean[1]), wp.float64(mean[2]))
    p = pose.exact_rotation * exact + pose.exact_translation
    centre = Centre()
    centre.z = p[2]
    centre.tan = wp.vec2d(p[0] / p[2], p[1] / p[2])
    return centre


@wp.func
def rotation_of(unit: wp.vec4) -> wp.mat33:
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def geometry_of(pose: Pose, grid: Grid, centre: Centre, quat: wp.vec4, scale: wp.vec3) -> Geometry:
    g = Geometry()
    g.inverse_z = 1.0 / wp.float32(centre.z)
    g.tan = wp.vec2(wp.float32(centre.tan[0]), wp.float32(centre.tan[1]))
    g.limited = wp.min(wp.max(g.tan, grid.low), grid.high)

    # Divides by the largest component first, so that |q|² neither overflows nor underflows. The zero quaternion is the
    # identity.
    largest = wp.max(wp.abs(quat))
    g.unit = wp.vec4(1.0, 0.0, 0.0, 0.0)
    g.inverse_norm = 0.0
    if largest > 0.0:
        scaled = quat / largest
        length = wp.length(scaled)
        g.unit = scaled / length
        g.inverse_norm = 1.0 / length / largest
    g.rotation = rotation_of(g.unit)

    g.axes = pose.rotation * g.rotation * wp.diag(scale)
    g.x = (g.axes[0] - g.limited[0] * g.axes[2]) * g.inverse_z
    g.y = (g.axes[1] - g.limited[1] * g.axes[2]) * g.inverse_z
    return g


@wp.func
def footprint_of(g: Geometry, grid: Grid, cuts: Cuts) -> Footprint:
    f = Footprint()
    f.X = grid.focal[0] * g.x
    f.Y = grid.focal[1] * g.y
    f.size = wp.max(wp.sqrt(cuts.kernel), wp.max(wp.max(wp.abs(f.X)), wp.max(wp.abs(f.Y))))
    shrink = 1.0 / f.size
    x, y = f.X * shrink, f.Y * shrink
    f.kernel = cuts.kernel * shrink * shrink
    f.a = wp.dot(x, x)
    f.c = wp.dot(y, y)
    f.normal = wp.cross(x, y)
    area2 = wp.dot(f.normal, f.normal)
    f.area = wp.sqrt(area2)
    f.det = area2 + f.kernel * (f.a + f.c) + f.kernel * f.kernel
    blurred = f.c + f.kernel
    f.A = shrink * shrink * blurred / f.det
    f.S = -wp.dot(x, y) / blurred
    f.D = shrink * shrink / blurred
    f.compensation = 1.0
    if cuts.antialiased:
        f.compensation = f.area / wp.sqrt(f.det)
    return f


@wp.func
def screen_vjp(f: Footprint, first: wp.vec2) -> wp.vec2:
    """The gradient of the projected centre, Σ'⁻¹ Σ q d, from Σ q u and Σ q d_y."""
    along = f.A * first[0]
    return wp.vec2(along, f.S * along + f.D * first[1])


@wp.func
def geometry_vjp(
    pose: Pose, grid: Grid, cuts: Cuts, g: Geometry, f: Footprint, scale: wp.vec3, sums: Moments
) -> tuple[wp.vec3, wp.vec4, wp.vec3]:
    """The VJP of the projection, with ρ the compensation: ∂L/∂T = Σ'⁻¹ (Σ q d dᵀ) Σ'⁻¹ T + q ∂ log ρ/∂T.

    Returns the gradients of mean, quaternion and scale.
    """
    screen = screen_vjp(f, wp.vec2(sums[1], sums[2]))
    du, dv = screen[0], screen[1]

    # ∂L/∂T, row by row. In the coordinates (u, d_y) of `Ellipse`, Σ'⁻¹ is the diagonal (A, D), and the rows of T are X + S Y and
    # Y. The first times A is (y × n + κ x)/det with the rows x and y of T: sums without cancellation, where those of X + S Y lose
    # all digits for a needle.
    shrink = 1.0 / f.size
    x, y = f.X * shrink, f.Y * shrink
    along_x = wp.cross(y, f.normal)
    pu, py = (along_x + f.kernel * x) * (shrink / f.det), f.D * f.Y
    dX = f.A * (sums[3] * pu + sums[4] * py)
    dY = f.S * dX + f.D * (sums[4] * pu + sums[5] * py)
    if cuts.antialiased:
        # log ρ = ½ log area² - ½ log(area² + κ tr + κ²). This form avoids the cancellation for large Gaussians:
        # ∂ log ρ/∂x = κ/det ((tr + κ)/area² (y × n) - x), and for y with n × x.
        weight = sums[0] * shrink * f.kernel / f.det
        turn = (f.a + f.c + f.kernel) / (f.area * f.area)
        dX += weight * (turn * along_x - x)
        dY += weight * (turn * wp.cross(f.normal, x) - y)

    # T = J axes: gradients of the axes, of 1/z, and of the tangents where they are not clamped.
    gx, gy = grid.focal[0] * g.inverse_z * dX, grid.focal[1] * g.inverse_z * dY
    dtx, dty = grid.focal[0] * du, grid.focal[1] * dv
    if g.tan[0] == g.limited[0]:
        dtx -= wp.dot(g.axes[2], gx)
    if g.tan[1] == g.limited[1]:
        dty -= wp.dot(g.axes[2], gy)
    over_z = dtx * g.tan[0] + dty * g.tan[1] + wp.dot(f.X, dX) + wp.dot(f.Y, dY)
    back = wp.transpose(pose.rotation)
    d_mean = back * (wp.vec3(dtx, dty, -over_z) * g.inverse_z)

    # axes = W R diag(s)
    d_axes = back * wp.matrix_from_rows(gx, gy, -(g.limited[0] * gx + g.limited[1] * gy))
    along = wp.cw_mul(g.rotation, d_axes)
    d_quat = rotation_vjp(g.unit, d_axes * wp.diag(scale)) * g.inverse_norm
    return d_mean, d_quat, along[0] + along[1] + along[2]


@wp.func
def rotation_vjp(unit: wp.vec4, d: wp.mat33) -> wp.vec4:
    """∂L/∂q for |q| = 1 from ∂L/∂R, without the component along q."""
    w, x, y, z = unit[0], unit[1], unit[2], unit[3]
    turn_x, turn_y, turn_z = d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]
    xy, xz, yz = d[0, 1] + d[1, 0], d[0, 2] + d[2, 0], d[1, 2] + d[2, 1]
    free = 2.0 * wp.vec4(
        x * turn_x + y * turn_y + z * turn_z,
        y * xy + z * xz + w * turn_x - 2.0 * x * (d[1, 1] + d[2, 2]),
        x * xy + z * yz + w * turn_y - 2.0 * y * (d[0, 0] + d[2, 2]),
        x * xz + y * yz + w * turn_z - 2.0 * z * (d[0, 0] + d[1, 1]),
    )
    return free - wp.dot(free, unit) * unit
