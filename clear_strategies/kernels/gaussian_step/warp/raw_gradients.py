"""The gradients of both scales of a view with respect to the raw parameters, computed per Gaussian and never stored."""

from __future__ import annotations

import warp as wp


@wp.struct
class Gradient:
    """One cotangent's rasterizers.interface.SplatGradients; rgb is the factor beside Y of the colour gradient.

    `detail`, of HR, is m λ_HF ∇L_HF of f_det.
    """

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]
    opacities: wp.array[wp.float32]
    rgb: wp.array[wp.vec3]
    detail: wp.array[wp.vec3]


@wp.struct
class Activation:
    """The inputs of the activations' VJP (training.field.Activation), and Y."""

    scales: wp.array[wp.vec3]
    filtered: wp.array[wp.vec3]
    filter: wp.array[wp.float32]
    sigmoid: wp.array[wp.float32]
    factor: wp.array[wp.float32]
    basis: wp.array2d[wp.float32]


@wp.struct
class View:
    """How many Gaussians there are, and which gradients are given."""

    n: wp.int32
    has_hr: wp.bool
    has_detail: wp.bool


@wp.struct
class RawGradient:
    """∇θ of one loss for one Gaussian. shN's gradient stays in factors: Y ⊗ rgb."""

    means: wp.vec3
    quats: wp.vec4
    scales: wp.vec3
    opacity: wp.float32
    sh0: wp.vec3
    rgb: wp.vec3


@wp.func
def activation_vjp(g: Gradient, a: Activation, i: wp.int32) -> RawGradient:
    """The VJP of the 3D filter, exp and sigmoid. Same operations as training.field.Activation.vjp."""
    out = RawGradient()
    scales, filtered, reach = a.scales[i], a.filtered[i], a.filter[i]
    factor, sigmoid, d_opacity = a.factor[i], a.sigmoid[i], g.opacities[i]
    share = wp.vec3(reach / filtered[0], reach / filtered[1], reach / filtered[2])
    share = wp.cw_mul(share, share)  # log(coefficient) grows with log(s) by f² / (s² + f²)
    along = wp.cw_div(wp.cw_mul(g.scales[i], wp.cw_mul(scales, scales)), filtered)
    out.means = g.means[i]
    out.quats = g.quats[i]
    out.scales = along + d_opacity * (factor * sigmoid) * share
    out.opacity = d_opacity * factor * sigmoid * (1.0 - sigmoid)
    out.rgb = g.rgb[i]
    out.sh0 = a.basis[i, 0] * out.rgb
    return out


@wp.func
def load(
    activation: Activation, lr: Gradient, hr: Gradient, view: View, i: wp.int32
) -> tuple[RawGradient, RawGradient]:
    """∇L_LR and g^HR of a Gaussian; 0 for one not given."""
    g_lr, g_hr = activation_vjp(lr, activation, i), RawGradient()
    if view.has_hr:
        g_hr = activation_vjp(hr, activation, i)
    return g_lr, g_hr


@wp.func
def detail_of(hr: Gradient, view: View, i: wp.int32) -> wp.vec3:
    """What f_det learns by, m λ_HF ∇L_HF; 0 where it is not given."""
    g = wp.vec3()
    if view.has_detail:
        g = hr.detail[i]
    return g


@wp.func
def higher_bands2(a: Activation, i: wp.int32) -> wp.float64:
    """‖Y‖² over the higher bands, for ⟨Y ⊗ a, Y ⊗ b⟩ = ‖Y‖² ⟨a, b⟩."""
    total = wp.float64(0.0)
    for k in range(1, a.basis.shape[1]):
        y = wp.float64(a.basis[i, k])
        total += y * y
    return total


@wp.func
def size(g: RawGradient) -> wp.float32:
    """A norm that is 0 only if the gradient is 0; sh0 follows rgb."""
    shape = wp.norm_l1(g.means) + wp.norm_l1(g.quats) + wp.norm_l1(g.scales)
    return shape + wp.abs(g.opacity) + wp.norm_l1(g.rgb)
