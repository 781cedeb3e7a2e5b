"""Floors: the bytes and the operations that a stage cannot do without, whoever computes it.

Counted by the method's definition, not by anyone's implementation. Bytes: each number that a stage is given and needs, and
each that it must leave, crosses the device's memory once, as float32; what fits between (lists, sorts, tiles read again)
is an implementation's own affair. Operations: each multiplication, addition, division, root, exponential and comparison of
the formulas is one, a fused multiply-add two. A Gaussian that is not visible is looked at by its centre alone, and gets
the zeros of its gradient.

So time over floor says how much is left to gain at most; no program reaches 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.bench.scenes import Workload
from rasterizers.geometry import rotation_matrix
from rasterizers.interface import Camera, Splats

FLOAT: Final = 4  # bytes

# Numbers of a Gaussian.
_SHAPE: Final = 3 + 4 + 3 + 1  # mean, quaternion, scales, opacity
_ELLIPSE: Final = 2 + 3 + 1 + 3  # centre, conic, opacity and colour on the screen
_SLOPE: Final = 9  # the colour's slope along the position, which stands for the spherical harmonics on the way back
_RGB: Final = 3
_PULLED: Final = _SHAPE + 2 + _RGB  # a cotangent's gradient: of the shape, of the centre on the screen, of the colour

# Operations a Gaussian: to the camera 18, rotation from a quaternion 36, axes times scales 9, onto the screen 48, covariance
# 15, kernel, determinants and compensation 12, conic 4, centre 6.
_PROJECT: Final = 18 + 36 + 9 + 48 + 15 + 12 + 4 + 6
_DIRECTION: Final = 12
_BAND: Final = 3 + 2 * 3  # a basis function, and its share of three colours

# Operations a contribution. Alpha: offset 2, quadratic form 7, exponential 1, times opacity 1, cap 1.
_ALPHA: Final = 2 + 7 + 1 + 1 + 1
_COMPOSITE: Final = 1 + 2 * 3 + 2  # weight; three colours; transmittance
_SHARED_BACK: Final = _ALPHA + 2 * 3 + 3  # the form's slopes in x and y, and its three products
# ... and for each cotangent: times the colour 5, slope in alpha 3, what lies behind 2, back through the exponential 1, and
# onto the sums of the centre 4, the conic 6, the opacity 2, the colour 6.
_COTANGENT_BACK: Final = 5 + 3 + 2 + 1 + 4 + 6 + 2 + 6

_WINDOW: Final = 2 * 11 * 2  # operations of a separable 11 x 11 mean, a pixel and channel
_ADAM: Final = 3 + 4 + 3 + 3  # first moment, second, denominator, step; a number


@dataclass(frozen=True, slots=True)
class Cost:
    """What a stage takes at least."""

    bytes: float
    flops: float

    def __add__(self, other: Cost) -> Cost:
        return Cost(self.bytes + other.bytes, self.flops + other.flops)


@dataclass(frozen=True, slots=True)
class Load:
    """A picture in numbers.

    Args:
        n, visible: Gaussians. bands: of spherical harmonics above the constant one.
        contributions: pairs of a pixel and a Gaussian that is blended there.
    """

    n: int
    visible: int
    bands: int
    pixels: int
    contributions: int


def forward(load: Load) -> Cost:
    """Project the visible and blend their contributions into an image and its alpha."""
    colours = _RGB * (1 + load.bands)
    numbers = load.visible * (_SHAPE + colours) + (load.n - load.visible) * 3 + load.pixels * (3 + 1)
    gaussian = _PROJECT + _DIRECTION + _BAND * (1 + load.bands)
    return Cost(FLOAT * numbers, load.visible * gaussian + load.contributions * (_ALPHA + _COMPOSITE))


def backward(load: Load, cotangents: int) -> Cost:
    """Pull cotangents of the image back to the Gaussians: dense gradients, the colour's as its rank-one factors."""
    slope = _SLOPE if load.bands else 0
    read = load.pixels * (3 * cotangents + 1) + load.visible * (_SHAPE + _ELLIPSE + slope)
    written = load.n * (_PULLED * cotangents + 1 + load.bands)
    a_contribution = _SHARED_BACK + _COTANGENT_BACK * cotangents
    a_gaussian = _PROJECT * (1 + 2 * cotangents)  # once more, and a product's transpose is two products
    return Cost(FLOAT * (read + written), load.contributions * a_contribution + load.visible * a_gaussian)


def ssim(values: int) -> Cost:
    """Two images of so many values in, a gradient out; five windowed means on the way there, three back."""
    products, a_pixel, gather = 3, 30, 4
    return Cost(3 * FLOAT * values, values * (8 * _WINDOW + products + a_pixel + gather))


def photometric(values: int) -> Cost:
    """L1 and SSIM in one pass."""
    return Cost(ssim(values).bytes, ssim(values).flops + 4 * values)


def haar(values: int) -> Cost:
    """One level: of each 2 x 2 block 4 differences, 8 sums and 4 halves to four bands, 6 for three sums, and back."""
    return Cost(3 * FLOAT * values, values * (4 + 12 + 6 + 12) / 4)


def adam(numbers: int) -> Cost:
    """Parameter, gradient and two moments in, all but the gradient out."""
    return Cost((4 + 3) * FLOAT * numbers, _ADAM * numbers)


def gaussian_pass(n: int, bands: int, gradients: int, *, anchored: bool) -> Cost:
    """Compare, correct, merge, anchor and step, of factored gradients: nothing dense crosses memory.

    Args:
        gradients: LR, base and HF: 3; LR alone: 1.
    """
    width = _SHAPE + _RGB * (1 + bands) + _RGB  # f_det, too
    factors = _SHAPE + _RGB
    numbers = width * (3 + 3 + anchored) + factors * gradients + 1 + bands + 1  # the filter
    compared = 3 * 2 * factors + 2 * factors if gradients > 1 else 0  # ⟨lr, lr⟩, ⟨lr, hr⟩, ⟨hr, hr⟩; correction
    merged = 2 * factors * (gradients - 1) + _RGB * (1 + bands)
    return Cost(FLOAT * n * numbers, n * (width * (_ADAM + 3 * anchored) + compared + merged))


def load_of(workload: Workload, rules: Mapping[str, Any]) -> Load:
    """The picture of a workload by some rules (`kernel`, `near`, `antialiased`, `alpha_min`, `transmittance_min` …)."""
    visible, contributions = contributions_of(workload.splats, workload.camera, rules)
    pixels = workload.camera.width * workload.camera.height
    return Load(len(workload.splats), visible, workload.splats.shN.shape[1], pixels, contributions)


def contributions_of(splats: Splats, camera: Camera, rules: Mapping[str, Any], tile: int = 16) -> tuple[int, int]:
    """Gaussians whose box touches the image, and pairs of a pixel and a Gaussian that is blended there."""
    centres, conics, opacities, half = _ellipses(splats, camera, rules)
    low, high = centres - half, centres + half
    touches = (high[:, 0] > 0) & (low[:, 0] < camera.width) & (high[:, 1] > 0) & (low[:, 1] < camera.height)
    centres, conics, opacities, low, high = (x[touches] for x in (centres, conics, opacities, low, high))
    offsets = torch.arange(tile, device=centres.device) + 0.5
    total = torch.zeros((), dtype=torch.int64, device=centres.device)
    for top in range(0, camera.height, tile):
        row = ((high[:, 1] > top) & (low[:, 1] < top + tile)).nonzero()[:, 0]
        for left in range(0, camera.width, tile):
            here = row[(high[row, 0] > left) & (low[row, 0] < left + tile)]
            x, y = left + offsets[: camera.width - left], top + offsets[: camera.height - top]
            dx = x[None, None, :] - centres[here, 0, None, None]
            dy = y[None, :, None] - centres[here, 1, None, None]
            a, b, c = conics[here, :, None, None].unbind(1)
            alpha = opacities[here, None, None] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = alpha.clamp_max(rules["alpha_max"]) * (alpha >= rules["alpha_min"])
            left_over = torch.cumprod(1 - alpha, 0)  # falls, so that a pixel which has ended stays so
            total += ((alpha > 0) & (left_over >= rules["transmittance_min"])).sum()
    return int(touches.sum()), int(total)


def _ellipses(
    splats: Splats, camera: Camera, rules: Mapping[str, Any]
) -> tuple[Float[Tensor, "V 2"], Float[Tensor, "V 3"], Float[Tensor, " V"], Float[Tensor, "V 2"]]:
    """Those in front of the camera that may be seen, front to back: centre, conic, opacity, half the box; float64."""
    pose = camera.world_to_camera.to(splats.means.device, torch.float64)
    points = splats.means.double() @ pose[:3, :3].T + pose[:3, 3]
    order = points[:, 2].argsort()
    order = order[points[order, 2] > rules["near"]]
    x, y, z = points[order].unbind(-1)
    zero = torch.zeros_like(z)
    onto = torch.stack((camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2), -1)
    axes = rotation_matrix(splats.quats[order].double()) * splats.scales[order, None].double()
    on_screen = onto.view(-1, 2, 3) @ pose[:3, :3] @ axes
    sharp = on_screen @ on_screen.mT
    covariance = sharp + rules["kernel"] * torch.eye(2, dtype=torch.float64, device=sharp.device)
    determinant = torch.linalg.det(covariance)
    opacity = splats.opacities[order].double()
    if rules["antialiased"]:
        opacity = opacity * (torch.linalg.det(sharp).clamp_min(0) / determinant).sqrt()
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    reach = 2 * torch.log(opacity.clamp_min(1e-30) / rules["alpha_min"])  # alpha_min is met within dᵀ Σ⁻¹ d <= reach
    seen = reach > 0
    conics = torch.stack((c, -b, a), -1) / determinant[:, None]
    half = (reach.clamp_min(0)[:, None] * torch.stack((a, c), -1)).sqrt()
    centres = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), -1)
    return centres[seen], conics[seen], opacity[seen], half[seen]
