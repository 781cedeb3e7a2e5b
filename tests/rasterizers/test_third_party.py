"""Rasterizers by path: a third party's class, and this package's classes, are built by `_target_` from the same settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import pytest
import torch
from hydra.utils import instantiate

import rasterizers
from rasterizers import Camera, Rasterizer, RasterSettings, Rendering, Splats, Traits, autograd
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import check_rasterizer, scene


@dataclass(frozen=True, slots=True)
class ThirdParty(RasterSettings):
    """Has a setting of its own, and draws with the reference rasterizer."""

    lanes_per_pass: int = 1 << 18

    @property
    def inner(self) -> ReferenceRasterizer:
        return ReferenceRasterizer(
            lanes=self.lanes_per_pass, **{f.name: getattr(self, f.name) for f in fields(RasterSettings)}
        )

    @property
    def traits(self) -> Traits:
        return self.inner.traits

    def __call__(self, splats: Splats, camera: Camera, *, depth: bool = False) -> Rendering:
        return self.inner(splats, camera, depth=depth)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], *, depth: Sequence[bool] | None = None
    ) -> list[Rendering]:
        return self.inner.render_scales(jobs, depth=depth)


class Flat:
    """Draws no depth, and has no argument for it."""

    def __init__(self, **settings) -> None:
        self.inner = rasterizers.load("torch", **settings)

    @property
    def traits(self) -> Traits:
        return replace(self.inner.traits, depth=False)

    def __call__(self, splats, camera):
        return self.inner(splats, camera)

    def render_scales(self, jobs):
        return self.inner.render_scales(jobs)


def test_a_third_partys_rasterizer_passes_the_checks_and_is_built_by_its_path():
    check_rasterizer(ThirdParty)
    target = f"{__name__}.ThirdParty"
    found = instantiate({"_target_": target, "near": 0.01, "background": [1, 1, 1], "lanes_per_pass": 4096})
    assert isinstance(found, Rasterizer)
    assert found == ThirdParty(near=0.01, background=(1.0, 1.0, 1.0), lanes_per_pass=4096)


def test_a_rasterizer_without_depth_passes_the_checks_and_is_refused_by_name_where_depth_is_asked(caplog):
    with caplog.at_level("INFO", "rasterizers"):
        check_rasterizer(Flat)
    assert "check_nothing_to_draw_of_depth: not checked, the rasterizer's traits.depth is False" in caplog.text
    splats, camera = scene(5), Camera(torch.eye(4), 40.0, 40.0, 20.0, 15.0, 40, 30)
    assert autograd.draw(Flat(), splats, camera).depth is None
    with pytest.raises(ValueError, match=r"Flat draws no depth \(its traits\.depth is False\)"):
        autograd.draw(Flat(), splats, camera, depth=True)
