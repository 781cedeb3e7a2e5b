"""The cameras and renderings of a 3DGS-style loop: which are training views, what is hidden in them, and what is refused."""

from __future__ import annotations

import copy

import pytest
import torch

from clear_strategies import GCO, Conductor, DataError
from clear_strategies.errors import SettingError
from clear_strategies.geometry import projection
from integration import HostError
from integration.inria import attach
from integration.inria.cameras import intrinsics
from tests.helpers import toy
from tests.helpers.inria import HR_FROM_START, WITHOUT_HR, N, options


def test_a_training_camera_is_recognised_as_an_object_or_as_a_copy_but_not_by_its_name_alone(inria_attached):
    clear, _, scene = inria_attached(GCO())
    camera, copied = scene.cameras[1], copy.copy(scene.cameras[1])
    assert clear.views.find(camera) is clear.views.find(copied)
    copied.world_view_transform = (
        copied.world_view_transform + 0.1
    )  # Blender's test photos have the names of training photos
    assert clear.views.find(copied) is None


def test_a_dropout_inside_the_hosts_render_drops_the_same_at_both_scales(inria_host, inria_attached):
    clear, gaussians, scene = inria_attached()
    packages = []

    def render(*args):
        packages.append(inria_host.render(*args, dropout=0.5))
        return packages[-1]

    torch.manual_seed(3)
    clear.wrap(render)(scene.cameras[1], gaussians, None, None)
    hr, lr = (package["render"] for package in packages)
    drawn = [
        torch.autograd.grad(image.sum(), gaussians._opacity, retain_graph=True)[0][:, 0] != 0 for image in (hr, lr)
    ]
    assert torch.equal(*drawn)
    after = torch.rand(1)
    torch.manual_seed(3)
    inria_host.render(scene.cameras[1], gaussians, None, None, dropout=0.5)
    assert torch.equal(after, torch.rand(1))  # the host's random numbers are those without CLEAR


def test_a_pixel_that_the_hosts_mask_hides_is_hidden_at_both_scales(inria_host, inria_capture):
    """3DGS's --train_test_exp hides half of each test photo by alpha_mask; the SR image would supervise that half."""
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    for camera in scene.cameras:
        camera.alpha_mask = torch.ones(1, 16, 24)
        camera.alpha_mask[..., 12:] = 0
    clear = attach(gaussians, scene.cameras, Conductor(GCO(), objective=HR_FROM_START), sr=inria_capture / "sr")
    camera, gradients = scene.cameras[1], []
    assert bool((clear.views.find(camera).hr.image[:, 48:] == 0).all())

    def render(viewpoint_camera, *args):
        package = inria_host.render(viewpoint_camera, *args)
        if viewpoint_camera is not camera:
            package["render"].register_hook(gradients.append)
        return package

    clear.wrap(render)(camera, gaussians, None, None)
    assert gradients[0].shape == (3, 64, 96)
    for gradient in gradients:
        assert float(gradient[..., 48:].abs().max()) == 0
        assert float(gradient[..., :48].abs().max()) > 0


def test_a_step_that_follows_no_recognised_rendering_is_an_error(inria_host, inria_capture, inria_attached):
    clear, gaussians, scene = inria_attached(GCO())
    opt = options(inria_host, inria_capture)
    with pytest.raises(HostError, match="none of its renderings was recognised"):
        inria_host.loop(opt, gaussians, scene)  # `render` was not replaced
    clear.remove()
    inria_host.loop(opt, gaussians, scene)


def test_unsupported_calls_are_refused(inria_host, inria_capture, inria_attached):
    clear, gaussians, scene = inria_attached(GCO(), objective=WITHOUT_HR)
    render, camera = clear.wrap(inria_host.render), scene.cameras[1]
    with pytest.raises(HostError, match="jittered"):
        render(camera, gaussians, None, None, subpixel_offset=torch.zeros(1))
    with pytest.raises(HostError, match="render must return a dict"):
        clear.wrap(lambda *_: (1, 2))(camera, gaussians, None, None)
    camera.image_width *= 2
    with pytest.raises(HostError, match=r"an image of 24x16 pixels, got shape \(3, 16, 48\)"):
        render(camera, gaussians, None, None)
    with pytest.raises(HostError, match="attached already"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=inria_capture / "sr")
    gaussians.optimizer = None
    clear.remove()
    with pytest.raises(HostError, match="has no optimizer"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=inria_capture / "sr")


def test_views_need_unique_names_and_sr_images_of_the_right_size(inria_host, inria_capture):
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    with pytest.raises(SettingError, match="at least one training camera"):
        attach(gaussians, [], Conductor(), sr=inria_capture / "sr")
    with pytest.raises(DataError, match="view0: training cameras: two have this name"):
        attach(gaussians, [scene.cameras[0]] * 2, Conductor(), sr=inria_capture / "sr")
    with pytest.raises(DataError, match="2 times the LR image is 48x32"):
        attach(gaussians, scene.cameras, Conductor(), sr=inria_capture / "sr", factor=2)


def test_intrinsics_are_read_from_the_projection(inria_host, inria_capture):
    _, scene = inria_host.setup(options(inria_host, inria_capture))
    expected = projection.intrinsics(toy.scene(N).train[0].lr.camera)
    assert torch.allclose(intrinsics(scene.cameras[0]), expected, atol=1e-4)
