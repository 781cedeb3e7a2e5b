"""What the densifier of a 3DGS-style loop reads, and what Mip-Splatting limits its Gaussians by."""

from __future__ import annotations

import importlib

import pytest
import torch

from clear_strategies import GCO, P2G, Conductor
from integration.inria import attach
from tests.helpers.inria import HR_FROM_START, WITHOUT_HR, N, options


def screen_gradient(host, render, camera, gaussians, **settings):
    """What the densifier reads after a step's backward pass."""
    package = render(camera, gaussians, None, None, **settings)
    host.photometric(package["render"], camera.original_image).backward()
    return package["viewspace_points"].grad


@pytest.mark.parametrize("strategies", [(), (GCO(),)], ids=["baseline", "gco"])
def test_without_a_score_the_densifier_reads_its_own_statistic(strategies, inria_host, inria_attached):
    """Its threshold is meant for the gradient of the photo; with HR's gradient added, every host would grow more."""
    clear, gaussians, scene = inria_attached(*strategies)
    renders = inria_host.render, clear.wrap(inria_host.render)
    read = [screen_gradient(inria_host, render, scene.cameras[0], gaussians) for render in renders]
    assert clear.attachment.counts["HR renders"] == 1
    assert torch.equal(*read)


def test_with_a_score_as_many_gaussians_pass_the_threshold_as_by_the_hosts_statistic(inria_host, inria_capture):
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    own = screen_gradient(inria_host, inria_host.render, scene.cameras[0], gaussians)[:, :2].norm(dim=1)
    threshold = float(own.sort(descending=True).values[6:8].mean())  # 7 of 24 pass
    clear = attach(
        gaussians, scene.cameras, Conductor(P2G(patch=4), objective=HR_FROM_START), sr=inria_capture / "sr",
        threshold=threshold,
    )  # fmt: skip
    written = screen_gradient(inria_host, clear.wrap(inria_host.render), scene.cameras[0], gaussians)[:, :2].norm(dim=1)
    assert int((written >= threshold).sum()) == int((own >= threshold).sum()) == 7
    assert not torch.allclose(written, own)


def test_mip_splattings_third_column_holds_the_score_too(inria_host, inria_attached, monkeypatch):
    """It splits as many Gaussians by the largest absolute gradients as by the gradient, so it must rank by the score."""
    monkeypatch.setattr(importlib.import_module("gaussian_renderer"), "ABSOLUTE", True)
    clear, gaussians, scene = inria_attached(P2G(patch=4))
    gaussians.xyz_gradient_accum_abs = torch.zeros(N, 1)
    gradient = screen_gradient(inria_host, clear.wrap(inria_host.render), scene.cameras[0], gaussians)
    assert torch.equal(gradient[:, 2], gradient[:, 0])
    assert float(gradient[:, 2].max()) > 0


def test_mip_splattings_filter_is_that_of_the_hr_cameras(inria_host, inria_capture, monkeypatch):
    """With that of the LR cameras, no Gaussian could be as thin as what the SR images show."""
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    widths = []
    compute = lambda model, cameras: widths.append([camera.image_width for camera in cameras])  # noqa: E731
    monkeypatch.setattr(type(gaussians), "compute_3D_filter", compute, raising=False)
    clear = attach(gaussians, scene.cameras, Conductor(objective=HR_FROM_START), sr=inria_capture / "sr")
    gaussians.compute_3D_filter(cameras=scene.cameras)
    clear.remove()
    gaussians.compute_3D_filter(scene.cameras)
    attach(gaussians, scene.cameras, Conductor(objective=WITHOUT_HR))
    gaussians.compute_3D_filter(scene.cameras)
    assert widths == [[96] * 3, [24] * 3, [24] * 3]
    assert scene.cameras[0].image_width == 24


def test_absolute_gradients_stay_the_hosts_own(inria_host, caplog, inria_attached):
    clear, gaussians, scene = inria_attached(P2G(patch=4))
    renders = inria_host.render, clear.wrap(inria_host.render)
    grads = [screen_gradient(inria_host, render, scene.cameras[0], gaussians, columns=4) for render in renders]
    assert torch.equal(grads[0][:, 2:], grads[1][:, 2:])
    assert not torch.equal(grads[0][:, :2], grads[1][:, :2])
    assert "4 columns" in caplog.text
