"""The backends that are judged against float64, each at the widest precision that it has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import pytest
import torch

import rasterizers
from rasterizers import Camera, Rasterizer, Rendering, Splats
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import gradient_of, scene, to

ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN", "rgb_offset", "screen")
CLEAN = {"alpha_min": 1e-7, "transmittance_min": 1e-9}  # cut-offs far below what float32 resolves: no flips


@dataclass(frozen=True, eq=False)
class Backend:
    """A rasterizer by name.

    Args:
        edges: the tiles it can be asked for, px.
        cases: how many pictures of one Gaussian a test may ask for.
    """

    name: str
    edges: tuple[int, ...]
    cases: int
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, **settings: Any) -> Rasterizer:
        return rasterizers.load(self.name, **self.settings, **settings)

    @property
    def widest(self) -> torch.dtype:
        return torch.float64 if torch.float64 in self().traits.dtypes else torch.float32


BACKENDS = (
    Backend("cpp", (4, 8, 16, 32, 64), 400),
    Backend("warp", (8, 16, 32, 64), 100, {"device": "cpu"}),
)


@cache
def why_not(name: str) -> str | None:
    """Why a backend does not run here."""
    return rasterizers.available()[name]


def backends(*, dtype: torch.dtype | None = None) -> pytest.MarkDecorator:
    """Run a test for every backend, skipped with the reason where it does not run."""
    params = [
        pytest.param(backend, id=backend.name, marks=pytest.mark.skipif(bool(reason), reason=str(reason)))
        for backend in BACKENDS
        for reason in [why_not(backend.name)]
        if dtype is None or reason is not None or dtype in backend().traits.dtypes
    ]
    return pytest.mark.parametrize("backend", params)


def exact(splats: Splats, camera: Camera, **settings: Any) -> Rendering:
    """The truth: float64, compiled where that can be."""
    oracle = ReferenceRasterizer(**settings) if why_not("cpp") else rasterizers.load("cpp", **settings)
    return oracle(to(splats, torch.float64), camera)


def camera(width=65, height=47) -> Camera:
    return Camera(torch.eye(4), 0.9 * width, 0.9 * width, 0.52 * width, 0.47 * height, width, height)


def cotangents(k, height, width, seed=0) -> torch.Tensor:
    return torch.randn(k, height, width, 3, generator=torch.Generator().manual_seed(seed))


def everything(rendering, v):
    g = rendering.vjp(v)
    picture = (rendering.image, rendering.alpha, rendering.means2d, rendering.visible)
    return (*picture, *(gradient_of(g, name) for name in ATTRIBUTES), g.basis)


def dense_scene(n=3000):
    """Deep enough that pixels end: some hundred Gaussians over each."""
    splats = scene(n, bands=15, seed=4)
    return replace(splats, scales=splats.scales * 0.35), camera(130, 97)
