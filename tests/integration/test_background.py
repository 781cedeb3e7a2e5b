"""The background that a strategy chooses, in loops that leave it to the strategies and in those that do not."""

from __future__ import annotations

import pytest
import torch

from clear_strategies import Conductor, RandomBackground
from integration.gsplat import attach
from tests.helpers import gsplat_host, inria, toy
from tests.helpers.gsplat_host import Host


@pytest.fixture
def asked(monkeypatch):
    """The `backgrounds` of every call of rasterization."""
    seen, rasterization = [], gsplat_host.rasterization

    def recorded(*args, backgrounds=None, **kwargs):
        seen.append(None if backgrounds is None else tuple(backgrounds[0].tolist()))
        return rasterization(*args, backgrounds=backgrounds, **kwargs)

    def named(means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=None, **kwargs):
        return recorded(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, backgrounds=backgrounds, **kwargs
        )

    monkeypatch.setattr(gsplat_host, "rasterization", named)
    return seen


@pytest.mark.parametrize("own_background", [False, True])
def test_a_gsplat_loop_renders_both_scales_and_extra_views_over_it_unless_it_has_its_own(asked, own_background):
    scene = toy.scene(20)
    host = Host(scene)
    conductor = Conductor(RandomBackground(), toy.ShowsDark(), objective=inria.HR_FROM_START)
    clear = attach(host.splats, host.optimizers, scene.train, conductor, own_background=own_background)
    clear.replace_everywhere(gsplat_host.rasterization)
    try:
        host.train([scene.train[0].name])
    finally:
        clear.remove()
    assert conductor.background(1) is not None
    color = None if own_background else tuple(torch.tensor(conductor.background(1)).tolist())
    assert asked == [color] * 3


def test_a_host_with_its_own_background_is_told(caplog):
    scene = toy.scene(20)
    host = Host(scene)
    caplog.set_level("INFO")
    attach(host.splats, host.optimizers, scene.train, Conductor(RandomBackground()), own_background=True).remove()
    assert "RandomBackground has no effect here" in caplog.text
