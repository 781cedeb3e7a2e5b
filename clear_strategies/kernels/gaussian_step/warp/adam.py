"""Adam on one number. Same operations as training.optim.Adam, except that the division by the second moment's bias is a
multiplication here.
"""

from __future__ import annotations

import warp as wp


@wp.struct
class Rates:
    """Of each attribute, - learning rate / bias of the first moment."""

    means: wp.float32
    quats: wp.float32
    scales: wp.float32
    opacities: wp.float32
    sh0: wp.float32
    shN: wp.float32  # noqa: N815 - gsplat's name
    detail: wp.float32


@wp.struct
class AdamStep:
    """What changes from step to step, and the settings that all attributes share."""

    rates: Rates

    beta1: wp.float32
    beta2: wp.float32
    gain1: wp.float32  # 1 - β
    gain2: wp.float32
    per_bias2: wp.float32  # 1 / bias of the second moment
    eps: wp.float32
    lambda_hr: wp.float32
    lambda_hf: wp.float32  # λ_HR λ_HF, next to it; no kernel here reads it


@wp.struct
class Attribute:
    """A parameter tensor with its moments, row-major, what is added to its gradient, and its limits."""

    p: wp.array[wp.float32]
    m: wp.array[wp.float32]
    v: wp.array[wp.float32]
    hr: wp.array[wp.float32]  # ĝ_HR where a strategy has computed it
    plus: wp.array[wp.float32]
    width: wp.int32
    given: wp.bool  # there is `hr`
    added: wp.bool  # there is `plus`
    bounded: wp.bool  # a row that takes no step may still decay or be clamped
    keep: wp.float32  # factor of the decay per step (f_det), 1: none
    limit: wp.float32


@wp.kernel
def write(values: AdamStep, out: wp.array[AdamStep]) -> None:
    out[0] = values


@wp.func
def step_number(
    adam: AdamStep, a: Attribute, rate: wp.float32, at: wp.int32, gradient: wp.float32, moves: wp.bool
) -> None:
    """Decay, step and clamp one number; with `moves` False only decay and clamp it."""
    if not (moves or a.bounded):
        return
    p = a.p[at]
    g = gradient
    if a.given:
        g += a.hr[at] * adam.lambda_hr
    if a.added:
        g += a.plus[at]
    after = p * a.keep
    if moves:
        m = g * adam.gain1 + a.m[at] * adam.beta1
        v = g * adam.gain2 * g + a.v[at] * adam.beta2
        a.m[at] = m
        a.v[at] = v
        after += m * rate / (wp.sqrt(v * adam.per_bias2) + adam.eps)
    if after > a.limit:  # False for NaN, which stays
        after = a.limit
    elif after < -a.limit:
        after = -a.limit
    a.p[at] = after


@wp.func
def is_still(a: Attribute, i: wp.int32, width: wp.int32) -> wp.bool:
    """Whether a row to which the losses give nothing would stay as it is: both moments and what is added are 0."""
    for at in range(a.width * i, a.width * i + width):
        if a.m[at] != 0.0 or a.v[at] != 0.0:
            return False
        if a.given and a.hr[at] != 0.0:
            return False
        if a.added and a.plus[at] != 0.0:
            return False
    return True
