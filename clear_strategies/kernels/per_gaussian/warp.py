"""Functions of `reference` by kernels of Warp, for float32 tensors on CUDA. Importing this module imports Warp."""

from __future__ import annotations

from typing import Final

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.evidence import Evidence
from rasterizers.warp_runtime import lanes_on, launch

wp.set_module_options({"enable_backward": False})

LANES: Final = 256
"""Threads per block, see `warp_runtime.lanes_on`."""
_UNIT: Final = wp.constant(wp.float32(2.0**20))  # see `core.gradients.screen_norm`
_TINY: Final = wp.constant(wp.float32(torch.finfo(torch.float32).tiny))


@wp.kernel
def _activate(
    log_scales: wp.array[wp.vec3],
    logits: wp.array[wp.float32],
    filters: wp.array[wp.float32],
    gate: wp.array[wp.float32],
    scales: wp.array[wp.vec3],
    filtered: wp.array[wp.vec3],
    sigmoid: wp.array[wp.float32],
    coefficient: wp.array[wp.float32],
    factor: wp.array[wp.float32],
    opacities: wp.array[wp.float32],
) -> None:
    i = wp.tid()
    raw, s, larger, c = log_scales[i], wp.vec3(), wp.vec3(), wp.float32(1.0)
    for d in range(3):
        s[d] = wp.exp(raw[d])
        larger[d] = wp.max(s[d], wp.sqrt(s[d] * s[d] + filters[i] * filters[i]))  # s where the squares vanish
        c *= s[d] / larger[d]
    scales[i] = s
    filtered[i] = larger
    coefficient[i] = c
    o = 1.0 / (1.0 + wp.exp(-logits[i]))
    if gate.shape[0] > 0:
        c *= gate[i]
    sigmoid[i] = o
    factor[i] = c
    opacities[i] = c * o


def activate(
    log_scales: Float[Tensor, "N 3"], logits: Float[Tensor, " N"], filters: Float[Tensor, " N"], gate: Tensor | None
) -> tuple[Tensor, ...]:
    n = len(logits)
    scales, filtered = log_scales.new_empty(2, n, 3).unbind()
    rest = logits.new_empty(4, n).unbind()
    launch(_activate, [n], (log_scales, logits, filters, gate, scales, filtered, *rest), block=LANES)
    return scales, filtered, *rest


@wp.kernel
def _look_up(
    maps: wp.array3d[wp.float32],
    centers: wp.array[wp.vec2],
    visible: wp.array[wp.bool],
    patch: wp.float32,
    reliability: wp.array[wp.float32],
    demand: wp.array[wp.float32],
    parts: wp.array[wp.vec3d],
) -> None:
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    share = wp.vec3d()
    if i < visible.shape[0]:
        q, a = wp.float32(0.0), wp.float32(0.0)
        if visible[i]:
            column = wp.clamp(wp.int32(centers[i][0] / patch), 0, maps.shape[2] - 1)
            row = wp.clamp(wp.int32(centers[i][1] / patch), 0, maps.shape[1] - 1)
            q, a = wp.float32(maps[0, row, column]), wp.float32(maps[1, row, column])
            share = wp.vec3d(wp.float64(1.0), wp.float64(q), wp.float64(q * a))
        reliability[i] = q
        demand[i] = a
    wp.tile_store(parts, wp.tile_sum(wp.tile(share, preserve_type=True)), offset=(block,))


def evidence(
    maps: Float[Tensor, "2 ph pw"], centers: Float[Tensor, "N 2"], visible: Bool[Tensor, " N"], patch: float
) -> Evidence:
    q, a = maps.new_empty(2, len(centers)).unbind()
    parts = _parts(q, 3)
    launch(_look_up, [len(parts)], (maps, centers.detach(), visible, patch, q, a, parts), block=LANES, together=True)
    return Evidence(q, a, parts.sum(0))


@wp.kernel
def _route(
    reliability: wp.array[wp.float32],
    demand: wp.array[wp.float32],
    sums: wp.array[wp.vec3d],
    floor: wp.float32,
    normalized: wp.bool,
    m: wp.array[wp.float32],
) -> None:
    i = wp.tid()
    m_i = floor + (1.0 - floor) * (reliability[i] * demand[i])  # Eq. 12
    if normalized:
        seen = wp.max(sums[0][0], wp.float64(1.0))
        mean = wp.float32((wp.float64(floor) * sums[0][0] + wp.float64(1.0 - floor) * sums[0][2]) / seen)
        m_i /= wp.max(mean, _TINY)
    m[i] = m_i


def route(e: Evidence, visible: Bool[Tensor, " N"], floor: float, normalize: bool) -> Float[Tensor, " N"]:
    m, sums = torch.empty_like(e.reliability), e.sums
    if sums is None:  # the evidence is not that of `evidence` above
        sums = torch.stack([x.sum(dtype=torch.float64) for x in (visible, e.reliability, e.weight)])
    launch(_route, [len(m)], (e.reliability, e.demand, sums[None], floor, normalize, m), block=LANES)
    return m


@wp.func
def norm(screen: wp.vec2) -> wp.float32:
    x, y = _UNIT * screen[0], _UNIT * screen[1]
    return wp.sqrt(x * x + y * y) / _UNIT


@wp.kernel
def _screens(
    lr: wp.array[wp.vec2],
    base: wp.array[wp.vec2],
    hf: wp.array[wp.vec2],
    half_width: wp.float32,
    half_height: wp.float32,
    lambda_hr: wp.float32,
    lambda_hf: wp.float32,
    changing: wp.array[wp.float32],
    screens: wp.array2d[wp.vec2],
    ordinary: wp.array[wp.float32],
) -> None:
    i = wp.tid()
    half, weights, total = wp.vec2(half_width, half_height), wp.vec2(lambda_hr, lambda_hf), wp.vec2(lr[i])
    if changing.shape[0] > 0:
        weights = wp.vec2(changing[0], changing[1])
    screen = wp.cw_mul(base[i], half)
    screens[0, i] = screen
    total += weights[0] * screen
    if hf.shape[0] > 0:
        screen = wp.cw_mul(hf[i], half)
        screens[1, i] = screen
        total += weights[1] * screen
    ordinary[i] = norm(total)


def screens(
    lr: Tensor, base: Tensor, hf: Tensor | None, size: tuple[int, int], weights: tuple[float, float] | Tensor
) -> tuple[Tensor, Tensor | None, Tensor]:
    found, ordinary = base.new_empty(1 if hf is None else 2, len(base), 2), base.new_empty(len(base))
    numbers, changing = ((0.0, 0.0), weights) if isinstance(weights, Tensor) else (weights, None)
    halves = [pixels / 2 for pixels in size]
    launch(_screens, [len(base)], (lr, base, hf, *halves, *numbers, changing, found, ordinary), block=LANES)
    return found[0], None if hf is None else found[1], ordinary


@wp.kernel
def _evidence_score(
    reliability: wp.array[wp.float32],
    demand: wp.array[wp.float32],
    hf: wp.array[wp.vec2],
    ordinary: wp.array[wp.float32],
    score: wp.array[wp.float32],
    parts: wp.array[wp.vec2d],
) -> None:
    block, lane = wp.tid()
    i = block * wp.block_dim() + lane
    share = wp.vec2d()
    if i < score.shape[0]:
        S = reliability[i] * demand[i] * norm(hf[i])  # Eq. 14
        score[i] = S
        share = wp.vec2d(wp.float64(ordinary[i]), wp.float64(S))
    wp.tile_store(parts, wp.tile_sum(wp.tile(share, preserve_type=True)), offset=(block,))


@wp.kernel
def _joined(ordinary: wp.array[wp.float32], sums: wp.array[wp.vec2d], score: wp.array[wp.float32]) -> None:
    i = wp.tid()
    n = wp.float64(ordinary.shape[0])
    share = wp.float32(sums[0][0] / n) / wp.max(wp.float32(sums[0][1] / n), _TINY)
    score[i] = ordinary[i] + score[i] * share


def evidence_score(
    e: Evidence, hf: Float[Tensor, "N 2"], ordinary: Float[Tensor, " N"], joined: bool
) -> Float[Tensor, " N"]:
    n = len(ordinary)
    score, parts = ordinary.new_empty(n), _parts(ordinary, 2)
    scored = e.reliability, e.demand, hf, ordinary, score, parts
    launch(_evidence_score, [len(parts)], scored, block=LANES, together=True)
    if joined:
        launch(_joined, [n], (ordinary, parts.sum(0)[None], score), block=LANES)
    return score


@wp.kernel
def _accumulate(
    visible: wp.array[wp.bool],
    score: wp.array[wp.float32],
    ordinary: wp.array[wp.float32],
    largest: wp.bool,
    total_score: wp.array[wp.float32],
    total_ordinary: wp.array[wp.float32],
    count: wp.array[wp.float32],
) -> None:
    i = wp.tid()
    if not visible[i]:
        return
    count[i] += 1.0
    if largest:
        total_score[i] = wp.max(total_score[i], score[i])
        total_ordinary[i] = wp.max(total_ordinary[i], ordinary[i])
    else:
        total_score[i] += score[i]
        total_ordinary[i] += ordinary[i]


def accumulate(
    visible: Bool[Tensor, " N"], score: Tensor, ordinary: Tensor, totals: tuple[Tensor, Tensor, Tensor], largest: bool
) -> None:
    launch(_accumulate, [len(visible)], (visible, score, ordinary, largest, *totals), block=LANES)


@wp.kernel
def _wander(
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec3],
    gate: wp.array[wp.float32],
    rows: wp.array[wp.int64],
    eta: wp.array[wp.vec3],
    typical: wp.array[wp.float32],
    strength: wp.float32,
    means: wp.array[wp.vec3],
) -> None:
    j = wp.tid()
    i = wp.int32(rows[j])
    q = quats[i]
    largest = wp.max(wp.abs(q))
    turn = wp.quat_identity()
    if largest > 0.0:  # of any length; the zero quaternion is the identity
        q = q / largest
        turn = wp.normalize(wp.quat(q[1], q[2], q[3], q[0]))
    s = log_scales[i]
    s = wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))
    along = wp.cw_mul(wp.cw_mul(s, s), wp.quat_rotate_inv(turn, eta[j]))  # S² Rᵀ η
    means[i] += strength / wp.exp(typical[0]) * gate[i] * wp.quat_rotate(turn, along)


def wander(
    means: Tensor, quats: Tensor, log_scales: Tensor, gate: Tensor, rows: Tensor, eta: Tensor, strength: float
) -> None:
    typical = log_scales.amax(-1).median().view(1)
    launch(_wander, [len(rows)], (quats, log_scales, gate, rows, eta, typical, strength, means), block=LANES)


def _parts(like: Tensor, width: int) -> Float[Tensor, "blocks width"]:
    """Memory for the sums of each block over the Gaussians of `like`."""
    return like.new_empty(-(-len(like) // lanes_on(like.device, LANES)), width, dtype=torch.float64)
