"""Adam on one number; operation by operation optim.Adam, but for a division by the bias of the second moment, which is a
multiplication here.
"""

from __future__ import annotations

from typing import no_type_check

import warp as wp


@wp.struct
@no_type_check
class AdamStep:
    """What all attributes share."""

    beta1: wp.float32
    beta2: wp.float32
    gain1: wp.float32  # 1 - β
    gain2: wp.float32
    per_bias2: wp.float32  # 1 / bias of the second moment
    eps: wp.float32


@wp.struct
@no_type_check
class Attribute:
    """A parameter tensor with its moments, row-major, the anchor that holds it, and its limits."""

    p: wp.array[wp.float32]
    m: wp.array[wp.float32]
    v: wp.array[wp.float32]
    anchor: wp.array[wp.float32]  # θ^a
    merged: wp.array[wp.float32]  # where the merged gradient is written instead of a step
    width: wp.int32
    anchored: wp.bool
    merges: wp.bool
    bounded: wp.bool  # a row at rest may change all the same: it decays or is projected
    stiffness: wp.float32  # of the anchor: 2 λ_stab W
    rate: wp.float32  # - learning rate / bias of the first moment
    keep: wp.float32  # what decay leaves of the parameter (f_det)
    limit: wp.float32


@wp.func
@no_type_check
def step_number(adam: AdamStep, a: Attribute, at: wp.int32, gradient: wp.float32, moves: wp.bool) -> None:
    """Decay, step and projection of one number; one that does not move only decays and is projected."""
    if not (moves or a.bounded):
        return
    p = a.p[at]
    g = gradient
    if a.anchored:
        g += (p - a.anchor[at]) * a.stiffness  # Eq. 16
    if a.merges:
        a.merged[at] = g
        return
    after = p * a.keep
    if moves:
        m = g * adam.gain1 + a.m[at] * adam.beta1
        v = g * adam.gain2 * g + a.v[at] * adam.beta2
        a.m[at] = m
        a.v[at] = v
        after += m * a.rate / (wp.sqrt(v * adam.per_bias2) + adam.eps)
    if after > a.limit:  # a NaN is above nothing, and stays
        after = a.limit
    elif after < -a.limit:
        after = -a.limit
    a.p[at] = after


@wp.func
@no_type_check
def is_still(a: Attribute, i: wp.int32, width: wp.int32) -> wp.bool:
    """Whether nothing would move a row whose gradient is 0: no momentum, no pull of the anchor."""
    for at in range(a.width * i, a.width * i + width):
        if a.m[at] != 0.0 or a.v[at] != 0.0:
            return False
        if a.anchored and a.p[at] != a.anchor[at]:
            return False
    return True
