"""Rasterizers by path: a third party's class, and this package's classes, are built by `_target_` from the same settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pytest
from hydra.utils import instantiate
from torch import Tensor

import rasterizers
from rasterizers import Camera, Rasterizer, RasterSettings, Rendering, Splats, Traits
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import check_rasterizer
from tests.helpers.backends import BACKENDS, why_not


@dataclass(frozen=True, slots=True)
class ThirdParty(RasterSettings):
    """Has a setting of its own, and draws with the reference rasterizer."""

    lanes_per_pass: int = 1 << 18

    @property
    def inner(self) -> ReferenceRasterizer:
        return ReferenceRasterizer(
            kernel=self.kernel, near=self.near, alpha_min=self.alpha_min, alpha_max=self.alpha_max, tile=self.tile,
            transmittance_min=self.transmittance_min, background=self.background, antialiased=self.antialiased,
            lanes=self.lanes_per_pass,
        )  # fmt: skip

    @property
    def traits(self) -> Traits:
        return self.inner.traits

    def __call__(self, splats: Splats, camera: Camera, tiles: Tensor | None = None) -> Rendering:
        return self.inner(splats, camera, tiles)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], tiles: Sequence[Tensor | None] | None = None
    ) -> list[Rendering]:
        return self.inner.render_scales(jobs, tiles)


def test_a_third_partys_rasterizer_passes_the_checks_and_is_built_by_its_path():
    check_rasterizer(ThirdParty)
    target = f"{__name__}.ThirdParty"
    found = instantiate({"_target_": target, "near": 0.01, "background": [1, 1, 1], "lanes_per_pass": 4096})
    assert isinstance(found, Rasterizer)
    assert found == ThirdParty(near=0.01, background=(1.0, 1.0, 1.0), lanes_per_pass=4096)


@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("torch", "rasterizers.reference.ReferenceRasterizer"),
        ("cpp", "rasterizers.cpp.CppRasterizer"),
        ("warp", "rasterizers.warp_backend.WarpRasterizer"),
    ],
)
def test_the_backends_are_built_by_their_paths(name, path):
    if name in BACKENDS and why_not(name):
        pytest.skip(str(why_not(name)))
    settings = {"near": 0.01, "kernel": 0.3, "tile": 16, "antialiased": False}
    assert instantiate({"_target_": path, **settings}) == rasterizers.load(name, **settings)
