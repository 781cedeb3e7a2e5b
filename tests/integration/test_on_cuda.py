"""gsplat's kernels on CUDA in the example's loop: photos, cameras, points and splats on the device, strategies beside them."""

from __future__ import annotations

import pytest
import torch

from integration.views import view
from tests.helpers import toy

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


def test_cameras_of_a_host_on_cuda_are_on_the_cpu():
    photo = toy.scene(20).train[0].lr
    c = photo.camera
    K = torch.tensor([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]], device="cuda")
    made = view(
        "photo", photo.image.cuda(), c.world_to_camera.cuda(), K,
        lambda name, image, factor: image.repeat_interleave(4, 0).repeat_interleave(4, 1),
    )  # fmt: skip
    assert made.lr.image.is_cuda
    assert made.hr.image.is_cuda
    assert not made.lr.camera.world_to_camera.is_cuda


@pytest.mark.slow  # gsplat compiles its kernels
@pytest.mark.parametrize("strategies", [None, "gco", "p2g", "svs", "clear", "best"])
def test_gsplats_loop_trains_on_cuda(strategies):
    pytest.importorskip("gsplat")
    from integration.examples.gsplat_loop import main

    torch.manual_seed(0)
    assert main(100, strategies) > 18
