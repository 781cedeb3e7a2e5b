"""The backends that are compared with float64."""

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

import rasterizers
from rasterizers import BackendUnavailable, Camera, Rasterizer, Rendering, SplatGradients, Splats
from rasterizers.geometry import SH_C0
from rasterizers.interface import summed_vjp
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import gradient_of, pixels_of, scene

ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN", "rgb_offset", "screen")
CLEAN = {"alpha_min": 1e-7, "transmittance_min": 1e-9}  # cut-offs far below what float32 resolves: no flips


@dataclass(frozen=True, eq=False)
class Backend:
    """A rasterizer by name.

    Args:
        device: where it draws; tensors are copied there and results back, so that tests work on the CPU.
        isa: the instruction set of compiled kernels in float32; None: the fastest here.
    """

    name: str
    device: str = "cpu"
    isa: str | None = None

    def __call__(self, **settings: Any) -> Rasterizer:
        if self.isa:
            settings = {"isa": self.isa, **settings}
        if self.name != "warp":
            return rasterizers.load(self.name, **settings)
        rasterizer = rasterizers.load(self.name, device=self.device, **settings)
        return rasterizer if self.device == "cpu" else OnDevice(rasterizer, self.device)

    @property
    def widest(self) -> torch.dtype:
        return torch.float64 if torch.float64 in self().traits.dtypes else torch.float32


class OnDevice:
    """A rasterizer on another device, for tests whose tensors are on the CPU."""

    def __init__(self, rasterizer: Rasterizer, device: str) -> None:
        self.rasterizer, self.device = rasterizer, device
        self.traits = rasterizer.traits

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return CopiedBack(self.rasterizer(moved(splats, self.device), camera, depth=depth))

    def render_scales(self, jobs, *, depth=None) -> list[Rendering]:
        copies: dict[int, torch.Tensor] = {}  # the same tensor stays the same tensor
        jobs = [(moved(splats, self.device, copies), camera) for splats, camera in jobs]
        return [CopiedBack(rendering) for rendering in self.rasterizer.render_scales(jobs, depth=depth)]


class CopiedBack:
    """A rendering of another device, copied to the CPU."""

    def __init__(self, rendering: Rendering) -> None:
        self.rendering = rendering
        self.image, self.alpha = rendering.image.cpu(), rendering.alpha.cpu()
        self.depth = None if rendering.depth is None else rendering.depth.cpu()
        self.means2d, self.visible = rendering.means2d.cpu(), rendering.visible.cpu()

    def vjp(self, cotangents: torch.Tensor) -> SplatGradients:
        return moved(self.rendering.vjp(cotangents), "cpu")


def moved(tensors, device: str, copies: dict[int, torch.Tensor] | None = None):
    """Splats or gradients on another device, wrong tensors included; `copies` holds the earlier copies by tensor."""
    copies, result = {} if copies is None else copies, copy(tensors)
    for field in fields(tensors):
        x = getattr(tensors, field.name)
        if x is not None and not x.is_meta:
            object.__setattr__(result, field.name, copies.setdefault(id(x), x.to(device)))
    return result


BACKENDS = {
    "cpp": Backend("cpp"),
    "cpp-avx2": Backend("cpp", isa="avx2"),
    "cpp-baseline": Backend("cpp", isa="baseline"),
    "warp": Backend("warp"),
    "warp-cuda": Backend("warp", "cuda"),
}
EVERY: dict[str, Callable[..., Rasterizer]] = {"torch": ReferenceRasterizer, **BACKENDS}
"""Those, and the reference that they are compared with."""


@cache
def why_not(name: str) -> str | None:
    """Why a backend does not run on this machine; None: it does."""
    try:
        EVERY[name]()
    except BackendUnavailable as reason:
        return str(reason)
    return None


def needs(name: str) -> pytest.MarkDecorator:
    """Skips a test where the backend does not run, with the reason."""
    return pytest.mark.skipif(bool(why_not(name)), reason=str(why_not(name)))


def backends(*, dtype: torch.dtype | None = None) -> pytest.MarkDecorator:
    """Run a test for every backend, in float32 for every instruction set; skip those that do not run, with the reason."""
    params = [
        pytest.param(backend, id=name, marks=needs(name))
        for name, backend in BACKENDS.items()
        if (not backend.isa or dtype == torch.float32)
        and (dtype is None or why_not(name) or dtype in backend().traits.dtypes)
    ]
    return pytest.mark.parametrize("backend", params)


def exact(splats: Splats, camera: Camera, *, depth: bool = False, **settings: Any) -> Rendering:
    """The rendering in float64, by "cpp" where it was compiled."""
    rasterizer = rasterizers.load("torch" if why_not("cpp") else "cpp", **settings)
    return rasterizer(splats.to(torch.float64), camera, depth=depth)


def balls(*depths: float, opacity=0.6, scale=0.4, color=0.5, dtype=torch.float64) -> Splats:
    """Grey balls straight ahead, one behind the other, all as large in the image: with a radius of `scale` at depth 1."""
    n, z = len(depths), torch.tensor(depths, dtype=dtype)
    return Splats(
        means=torch.stack((0 * z, 0 * z, z), 1), quats=torch.tensor([[1.0, 0, 0, 0]], dtype=dtype).repeat(n, 1),
        scales=(scale * z)[:, None].repeat(1, 3), opacities=torch.full((n,), opacity, dtype=dtype),
        sh0=torch.full((n, 1, 3), (color - 0.5) / SH_C0, dtype=dtype), shN=torch.zeros(n, 0, 3, dtype=dtype),
    )  # fmt: skip


def camera(width=65, height=47) -> Camera:
    return Camera(torch.eye(4), 0.9 * width, 0.9 * width, 0.52 * width, 0.47 * height, width, height)


def cotangents(k, height, width) -> torch.Tensor:
    return torch.randn(k, height, width, 3, generator=torch.Generator().manual_seed(0))


def everything(rendering, v):
    g = rendering.vjp(v)
    pixels = (pixels_of(rendering), rendering.alpha, rendering.means2d, rendering.visible)
    summed = []
    if len(v) > 1:
        s = summed_vjp(rendering, v, torch.linspace(0, 2, len(g.rgb[0])).to(v))
        summed = [s.means, s.quats, s.scales, s.opacities, s.screen, s.rgb]
    return (*pixels, *(gradient_of(g, name) for name in ATTRIBUTES), *summed, g.basis)


def dense_scene(n=3000):
    """A scene with about a hundred Gaussians over each pixel, so that pixels end."""
    splats = scene(n, bands=15, seed=4)
    return replace(splats, scales=splats.scales * 0.35), camera(130, 97)


INTERIOR = 5e-6  # the error of image values without flips
INTERIOR_SHARE = 0.9998  # the share of values without flips
FLIP = 8e-3  # the error of a value where rounding flips a cut-off


def require_image(found: Tensor, exact: Tensor) -> None:
    """Nearly all values agree to rounding; the others, where a cut-off flips, are bounded."""
    error = (found.double() - exact.double()).abs()
    inside = float((error <= INTERIOR).double().mean())
    assert inside >= INTERIOR_SHARE, f"only {inside:.5%} of the values agree to {INTERIOR:g}"
    assert float(error.max()) <= FLIP, f"a value is off by {float(error.max()):.2g}"


def require_gradient(name: str, found: Tensor, exact: Tensor) -> None:
    """Gradients agree over all Gaussians and one by one: norm, direction, bias, and none is missing."""
    a, b = (x.double().reshape(len(x), -1) for x in (found, exact))
    assert bool(a.isfinite().all()), f"{name}: not finite"
    size = torch.linalg.vector_norm(b)
    off = float(torch.linalg.vector_norm(a - b) / size)
    assert off <= 5e-5, f"{name}: relative error {off:.2g}"
    cosine = float((a * b).sum() / (torch.linalg.vector_norm(a) * size))
    assert cosine >= 1 - 1e-8, f"{name}: cosine 1 - {1 - cosine:.2g}"
    bias = float(((a - b) * b.sign()).sum() / b.abs().sum())
    assert abs(bias) <= 1e-5, f"{name}: biased by {bias:.2g}"
    rows = torch.linalg.vector_norm(b, dim=1)
    large = rows >= rows[rows > 0].median() / 100
    each = torch.linalg.vector_norm(a - b, dim=1)[large] / rows[large]
    assert float((each <= 1e-3).double().mean()) >= 0.99, f"{name}: many Gaussians are off by more than 1e-3"
    missing = (torch.linalg.vector_norm(a, dim=1) == 0) & large
    assert not bool(missing.any()), f"{name}: {int(missing.sum())} Gaussians have lost their gradient"


def require_same_bits(found: Iterable[Tensor], expected: Iterable[Tensor]) -> None:
    for a, b in zip(found, expected, strict=True):
        assert torch.equal(a, b)
