"""What the benchmark draws."""

from __future__ import annotations

import math

import pytest
import torch

import rasterizers
from clear_strategies.bench import iteration, scenes
from clear_strategies.bench.rasterizers import ATTRIBUTES
from clear_strategies.outputs.export import export_ply
from tests.helpers import toy


def test_a_generated_scene_is_the_same_every_time_and_has_its_stated_statistics():
    scene, again = (scenes.surfaces("s", 20_000, 1008, 756, radius=5.5) for _ in range(2))
    for name in ATTRIBUTES:
        assert torch.equal(getattr(scene.splats, name), getattr(again.splats, name)), name
    splats, camera = scene.splats, scene.camera
    pose = camera.world_to_camera
    x, y, z = (splats.means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (u > 0) & (u < camera.width) & (v > 0) & (v < camera.height) & (z > 0)
    radius = 3 * splats.scales.amax(-1) * camera.fx / z
    spread = float(radius[inside].quantile(0.9) / radius[inside].median())
    assert 0.78 < float(inside.float().mean()) < 0.88
    assert float(radius[inside].median()) == pytest.approx(5.5, rel=0.05)
    assert spread == pytest.approx(math.exp(0.8 * 1.2816), rel=0.05)  # lognormal, σ = 0.8
    assert float(splats.opacities.median()) == pytest.approx(1 / (1 + math.exp(-0.8)), abs=0.02)
    assert splats.shN.shape == (20_000, 15, 3)


def test_an_exported_field_is_drawn_as_the_field_draws_itself(tmp_path):
    field = iteration.field_of(toy.splats(30))
    export_ply(tmp_path / "field.ply", field)
    workload = scenes.load(str(tmp_path / "field.ply"))
    rasterizer = rasterizers.load("torch", preset="exact", **scenes.SETTINGS)
    found = rasterizer(workload.splats, workload.camera)
    torch.testing.assert_close(found.image, field.render(rasterizer, workload.camera), atol=1e-4, rtol=0)
    assert float(found.visible.float().mean()) > 0.7
