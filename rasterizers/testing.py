"""Checks of the `Rasterizer` interface for any implementation, this package's or a third party's.

    from rasterizers.testing import check_rasterizer
    check_rasterizer(MyRasterizer)

`check_rasterizer` builds it with fields of `RasterSettings` by keyword, as `_target_` does. Each check raises
`ContractError` with the expected and the found value.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final, cast

import torch
from torch import Tensor

from rasterizers.interface import Camera, Rasterizer, Rendering, SplatGradients, Splats, summed_vjp, with_depth
from rasterizers.reference import ReferenceRasterizer

Make = Callable[..., Rasterizer]
Check = Callable[[Make], None]

_log = logging.getLogger(__name__)

_ATTRIBUTES: Final = ("means", "quats", "scales", "opacities", "sh0", "shN", "rgb_offset")
# Finite differences need an image without cut-offs, which are discontinuous.
_SMOOTH: Final = {"alpha_min": 1e-9, "transmittance_min": 0.0, "alpha_max": 1 - 1e-6}


class ContractError(AssertionError):
    """An implementation violates the interface."""


def check_rasterizer(make: Make, *, reference: bool = True) -> None:
    """Run every check, with depth if the rasterizer draws it.

    Args:
        make: the class, or a function that builds the rasterizer from fields of `RasterSettings`.
        reference: compare images and gradients with the reference implementation; False: the rasterizer draws other images, e.g.
            those of 2D Gaussians, or sums that need no order.

    Raises:
        ContractError: from the first check that fails.
    """
    members, rasterizer = ("traits", "__call__", "render_scales"), make()
    missing = [name for name in members if not hasattr(rasterizer, name)]
    remedy = "Derive it from rasterizers.backend.Backend, and implement traits and draw"
    require(not missing, f"a rasterizer has {', '.join(members)}, but this one has no {', '.join(missing)}. {remedy}")
    for check in CHECKS:
        if reference or check is not check_agrees_with_the_reference:
            check(make)


def _also_of_depth(check: Callable[..., None]) -> Check:
    """The check of an image without depth, and with depth if the rasterizer draws it."""

    @functools.wraps(check)
    def both(make: Make) -> None:
        check(make, depth=False)
        if make().traits.depth:
            check(make, depth=True)
        else:
            _log.info("%s: depth is not checked, the rasterizer's traits.depth is False.", check.__name__)

    return both


@torch.no_grad()
def check_gradients_are_finite_differences(make: Make) -> None:
    """The VJP agrees with finite differences along random directions, for every attribute.

    With the trait `depth_gradient` the loss is one of alpha and depth, too. Autograd is off, as where `autograd.draw` draws.
    """
    rasterizer = make(background=(0.2, 0.5, 0.9), **_SMOOTH)
    dtype = _widest(rasterizer)
    splats, camera = scene(24, dtype=dtype, seed=1), _camera(40, 30)
    g = torch.Generator().manual_seed(2)
    whole = rasterizer.traits.depth_gradient
    draw = with_depth(rasterizer, whole)
    rendering = draw(splats, camera)
    v = _cotangents(rendering, 1, g)
    # Where little is drawn, depth is far from linear.
    besides = {name: v[..., c] * rendering.alpha for c, name in enumerate(("alpha", "depth")) if whole}
    gradients = cast(Any, rendering).vjp(v, **besides)
    step, tolerance = (1e-6, 1e-4) if dtype == torch.float64 else (1e-2, 2e-2)
    for name in _ATTRIBUTES:
        value, gradient = getattr(splats, name), gradient_of(gradients, name)[0]
        for _ in range(3):
            direction = torch.randn(value.shape, generator=g).to(dtype)
            if name in ("opacities", "scales"):
                direction = direction * value * 0.3
            direction = direction / torch.linalg.vector_norm(direction)
            moved = [replace(splats, **{name: value + s * step * direction}) for s in (1, -1)]
            ends = [draw(m, camera) for m in moved]
            change = sum(
                float(((getattr(ends[0], of) - getattr(ends[1], of)) * w[0]).sum())
                for of, w in {"image": v, **besides}.items()
            )
            numeric = change / (2 * step)
            analytic = float((gradient * direction).sum())
            scale = max(abs(numeric), float(gradient.abs().max()) * 1e-2, 1e-9)
            require(
                abs(numeric - analytic) <= tolerance * scale, f"∂/∂{name}: {analytic:.8g}, by differences {numeric:.8g}"
            )


def check_cotangents_together_equal_one_by_one(make: Make) -> None:
    """One call with K cotangents equals K calls with one."""
    rasterizer = make()
    splats, camera = scene(60, dtype=_widest(rasterizer)), _camera(48, 33)
    rendering = rasterizer(splats, camera)
    v = _cotangents(rendering, 3, torch.Generator().manual_seed(3))
    together = rendering.vjp(v)
    for k in range(3):
        alone = rendering.vjp(v[k : k + 1])
        for name in (*_ATTRIBUTES, "screen"):
            _close(gradient_of(together, name)[k], gradient_of(alone, name)[0], 1e-5, f"cotangent {k} of {name}")


def check_sum_equals_sum_of_gradients(make: Make) -> None:
    """Two cotangents that count as one, the second by a weight of each Gaussian: `summed_vjp` is the sum of their gradients."""
    rasterizer = make()
    dtype = min(rasterizer.traits.dtypes, key=lambda dtype: dtype.itemsize)  # in which it may sum by itself
    splats, camera = scene(60, dtype=dtype), _camera(48, 33)
    rendering = rasterizer(splats, camera)
    g = torch.Generator().manual_seed(4)
    v, weight = _cotangents(rendering, 3, g), torch.rand(60, generator=g).to(splats.means)
    weight[::5] = 0
    found, expected = summed_vjp(rendering, v, weight), rendering.vjp(v).summed(weight)
    for name in ("means", "quats", "scales", "opacities", "screen", "rgb"):
        _close(getattr(found, name), getattr(expected, name), 1e-5, f"the sum's {name}")


@_also_of_depth
def check_dropped_equals_absent(make: Make, *, depth: bool) -> None:
    """A Gaussian with opacity 0 is invisible and has no gradient, and the image is as without it."""
    rasterizer = make()
    dtype = _widest(rasterizer)
    splats, camera = scene(50, dtype=dtype), _camera(48, 33)
    kept = torch.arange(50) % 3 != 0
    gated = replace(splats, opacities=splats.opacities * kept)
    draw = with_depth(rasterizer, depth)
    rendering, without = draw(gated, camera), draw(select(splats, kept), camera)
    _close(pixels_of(rendering), pixels_of(without), 1e-6, "the image")
    require(not bool(rendering.visible[~kept].any()), "a dropped Gaussian counts as visible")
    v = torch.ones_like(rendering.image)[None]
    gradients, expected = rendering.vjp(v), without.vjp(v)
    for name in _ATTRIBUTES:
        rows = gradient_of(gradients, name)[0]
        require(float(rows[~kept].abs().max()) == 0, f"a dropped Gaussian has a gradient of {name}")
        _close(rows[kept], gradient_of(expected, name)[0], 1e-5, f"the others' {name}")


@_also_of_depth
def check_nothing_to_draw(make: Make, *, depth: bool) -> None:
    """With no Gaussian, or none in view: the background, alpha and depth 0, and zero gradients of the right shape."""
    background = (0.1, 0.6, 0.3)
    rasterizer = make(background=background)
    dtype, camera = _widest(rasterizer), _camera(19, 11)
    behind = scene(5, dtype=dtype)
    behind = replace(behind, means=behind.means - torch.tensor([0, 0, 100.0], dtype=dtype))
    for splats in (select(behind, torch.zeros(5, dtype=torch.bool)), behind):
        rendering = with_depth(rasterizer, depth)(splats, camera)
        _close(rendering.image, torch.tensor(background, dtype=dtype).expand(11, 19, 3), 1e-7, "the background")
        require(float(rendering.alpha.abs().max()) == 0, "alpha is not 0 where nothing is")
        require(rendering.depth is None or not bool(rendering.depth.any()), "depth is not 0 where nothing is")
        gradients = rendering.vjp(torch.ones_like(rendering.image).expand(2, -1, -1, -1))
        for name in _ATTRIBUTES:
            found = gradient_of(gradients, name)
            require(found.shape[:2] == (2, len(splats)), f"the gradient of {name} has shape {tuple(found.shape)}")
            require(found.numel() == 0 or float(found.abs().max()) == 0, f"the gradient of {name} is not 0")


@_also_of_depth
def check_scales_together_equal_one_by_one(make: Make, *, depth: bool) -> None:
    """`render_scales` draws each job as if alone, with depth one of two."""
    rasterizer = make()
    splats, camera = scene(60, dtype=_widest(rasterizer)), _camera(48, 33)
    jobs = [(splats, camera.scaled(1 / 3)), (splats, camera)]
    low, high = rasterizer.render_scales(jobs, depth=[False, True]) if depth else rasterizer.render_scales(jobs)
    require(low.depth is None, "an image has a depth without depth=True")
    _close(low.image, rasterizer(*jobs[0]).image, 1e-6, "an image drawn together with a larger one")
    _close(
        pixels_of(high),
        pixels_of(with_depth(rasterizer, depth)(*jobs[1])),
        1e-6,
        "an image drawn together with a smaller one",
    )


def check_equal_depths_have_an_order(make: Make) -> None:
    """Two renderings of Gaussians at one depth have the same bits."""
    rasterizer = make()
    dtype = _widest(rasterizer)
    splats = scene(40, dtype=dtype)
    splats = replace(splats, means=torch.cat((splats.means[:, :2], torch.full((40, 1), 5.0, dtype=dtype)), 1))
    first, second = (rasterizer(splats, _camera(32, 32)).image for _ in range(2))
    require(bool((first == second).all()), "two renderings of one scene differ")


@_also_of_depth
def check_agrees_with_the_reference(make: Make, *, depth: bool) -> None:
    """Image, alpha, projected centres and gradients agree with the reference in float64, at the default cut-offs, for SH degrees
    0 to 3.
    """
    rasterizer = make()
    for bands in (0, 3, 8, 15):
        splats, camera = scene(300, bands=bands), _camera(65, 47)
        exact = ReferenceRasterizer()(splats.to(torch.float64), camera, depth=depth)
        dtype = torch.float32 if torch.float32 in rasterizer.traits.dtypes else torch.float64
        found = with_depth(rasterizer, depth)(splats.to(dtype), camera)
        error = (pixels_of(found).double() - pixels_of(exact)).abs() / magnitude(exact)
        require(float((error <= 5e-6).double().mean()) >= 0.999, f"{bands} bands: more than 0.1 % of values are off")
        require(float(error.max()) <= 8e-3, f"{bands} bands: a value is off by {float(error.max()):.2g}")
        off = float((found.alpha.double() - exact.alpha).abs().max())
        require(off <= 8e-3, f"{bands} bands: alpha is off by {off:.2g}")
        seen = found.visible & exact.visible
        require(
            int(seen.sum()) >= 0.9 * int(exact.visible.sum()),
            f"{bands} bands: Gaussians that are drawn are not visible",
        )
        off = float((found.means2d.double() - exact.means2d)[seen].abs().max())
        require(off <= 1e-2, f"{bands} bands: a projected centre, means2d, is off by {off:.2g} pixels")
        v = _cotangents(exact, 1, torch.Generator().manual_seed(6))
        gradients, expected = found.vjp(v.to(dtype)), exact.vjp(v)
        for name in (*_ATTRIBUTES, "screen"):
            a, b = gradient_of(gradients, name).double(), gradient_of(expected, name)
            _close(a, b, 1e-3, f"{bands} bands: gradient of {name}")


CHECKS: Final[Sequence[Check]] = (
    check_gradients_are_finite_differences,
    check_cotangents_together_equal_one_by_one,
    check_sum_equals_sum_of_gradients,
    check_dropped_equals_absent,
    check_nothing_to_draw,
    check_scales_together_equal_one_by_one,
    check_agrees_with_the_reference,
    check_equal_depths_have_an_order,
)


def scene(n: int, *, seed: int = 0, bands: int = 3, dtype: torch.dtype = torch.float32) -> Splats:
    """Anisotropic Gaussians of mixed size and opacity in front of `_camera`, some outside its image."""
    g = torch.Generator().manual_seed(seed)
    z = 2 + 4 * torch.rand(n, 1, generator=g)
    means = torch.cat(((torch.rand(n, 2, generator=g) - 0.5) * 1.6 * z, z), dim=1)
    return Splats(
        means=means,
        quats=torch.randn(n, 4, generator=g),
        scales=torch.exp(torch.randn(n, 3, generator=g) * 0.6 - 2.2) * z / 3,
        opacities=torch.sigmoid(torch.randn(n, generator=g) * 1.5 + 0.5),
        sh0=torch.randn(n, 1, 3, generator=g),
        shN=torch.randn(n, bands, 3, generator=g) * 0.2,
        rgb_offset=torch.randn(n, 3, generator=g) * 0.1,
    ).to(dtype)


def select(splats: Splats, rows: Tensor) -> Splats:
    """Some of the splats."""
    tensors = {name: getattr(splats, name) for name in _ATTRIBUTES}
    return Splats(**{name: x[rows] for name, x in tensors.items() if x is not None})


def gradient_of(gradients: SplatGradients, name: str) -> Tensor:
    """The gradient of an attribute by name; that of `rgb_offset` is the colour's."""
    gradient: Tensor = getattr(gradients, "rgb" if name == "rgb_offset" else name)
    return gradient


def pixels_of(rendering: Rendering) -> Tensor:
    """The image [H, W, 3], or with depth as a fourth channel if it was drawn."""
    return rendering.image if rendering.depth is None else torch.cat((rendering.image, rendering.depth[..., None]), -1)


def magnitude(exact: Rendering) -> Tensor:
    """The scale of errors of `pixels_of`: 1 for colours, and E / alpha for depth.

    A wrong weight moves E by its share of alpha. Where little is drawn E may flip between two faint Gaussians.
    """
    if exact.depth is None:
        return torch.ones_like(exact.image)
    depths = (exact.depth / exact.alpha).where(exact.alpha > 0, math.inf)
    return torch.cat((torch.ones_like(exact.image), depths[..., None]), -1)


def _cotangents(like: Rendering, k: int, generator: torch.Generator) -> Tensor:
    return torch.randn(k, *like.image.shape, generator=generator).to(like.image)


def _camera(width: int, height: int) -> Camera:
    return Camera(torch.eye(4), 0.9 * width, 0.9 * width, 0.52 * width, 0.47 * height, width, height)


def _widest(rasterizer: Rasterizer) -> torch.dtype:
    return torch.float64 if torch.float64 in rasterizer.traits.dtypes else torch.float32


def _close(found: Tensor, expected: Tensor, tolerance: float, what: str) -> None:
    """Compare relative to the L2 norm, so that the rounding of tiny entries does not count."""
    scale = float(torch.linalg.vector_norm(expected)) or 1.0
    error = float(torch.linalg.vector_norm(found - expected)) / scale
    require(math.isfinite(error) and error <= tolerance, f"{what}: relative error {error:.3g}, allowed {tolerance:g}")


def require(holds: bool, otherwise: str) -> None:
    """Raise a ContractError unless it holds."""
    if not holds:
        raise ContractError(otherwise)
