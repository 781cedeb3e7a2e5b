"""What the benchmark draws."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

import rasterizers
from clear_strategies.bench import iteration, scenes
from clear_strategies.errors import DataError
from clear_strategies.outputs.formats import export_ply
from tests.helpers import toy


def test_a_generated_scene_is_the_same_every_time():
    one, other = scenes.load("tiny"), scenes.load("tiny")
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.equal(getattr(one.splats, name), getattr(other.splats, name)), name


def test_a_generated_scene_has_its_stated_statistics():
    scene = scenes.surfaces("s", 20_000, 1008, 756, radius=5.5)
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


def test_the_lr_scene_holds_the_same_gaussians():
    hr, lr = scenes.load("s100k"), scenes.load("s100k-lr")
    assert torch.equal(lr.splats.means, hr.splats.means)
    assert (lr.camera.width, lr.camera.height) == (252, 189)


def test_the_garden_is_made_of_its_points(tmp_path):
    g = np.random.default_rng(0)
    file = tmp_path / "test_garden.npz"
    np.savez(
        file, means3d=g.normal(size=(50, 3)).astype(np.float32), colors=g.integers(0, 255, (50, 3), np.uint8),
        viewmats=np.eye(4, dtype=np.float32)[None], Ks=np.eye(3, dtype=np.float32)[None] * 20, width=64, height=48,
    )  # fmt: skip
    found = scenes.load("garden", file)
    assert (len(found.splats), found.camera.width) == (50, 64)
    file.write_bytes(b"not an archive")
    with pytest.raises(DataError, match="is not the garden"):
        scenes.load("garden", file)
    with pytest.raises(DataError, match="--data"):
        scenes.load("garden")


def test_an_exported_field_is_drawn_as_the_field_draws_itself(tmp_path):
    field = iteration.field_of(toy.splats(30))
    export_ply(tmp_path / "field.ply", field)
    workload = scenes.load(str(tmp_path / "field.ply"))
    rasterizer = rasterizers.load("torch", preset="exact", **scenes.SETTINGS)
    found = rasterizer(workload.splats, workload.camera)
    torch.testing.assert_close(found.image, field.render(rasterizer, workload.camera), atol=1e-4, rtol=0)
    assert float(found.visible.float().mean()) > 0.7
