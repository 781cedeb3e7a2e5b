"""A host whose tensors are on another device than the CPU, with the strategies: no operation finds tensors of both."""

import pytest
import torch
from torch.utils import backend_registration

from tests.helpers.command_line import run

STRATEGIES = ["best", "splatsure"]  # together all strategies
pytestmark = pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason=f"torch {torch.__version__} has no devices written in Python",
)


def test_public_functions_take_photos_of_another_device_and_cameras_stay_on_the_cpu(tmp_path):
    code = """
import torch
from clear_strategies import PseudoViews, View
from clear_strategies.compose import conductor
from clear_strategies.geometry import depth_maps, exposure_gains
from integration.examples.demo import load_demo
from integration.views import view
from tests.helpers.elsewhere import NAME, Elsewhere

with Elsewhere():
    demo = load_demo(64, 48, device=NAME)
    best = conductor("best", iterations=10)

    def enlarged(name, image, factor):  # a network that answers from where it runs
        return image.to(NAME).repeat_interleave(factor, 0).repeat_interleave(factor, 1)

    one = next(zip(demo.images, demo.viewmats, demo.Ks))
    made = view("one", *one, sr=best.prior(enlarged), mask=torch.ones(12, 16))
    print(made.lr.image.device, made.hr.image.device, made.lr.camera.world_to_camera.device)
    print(best.prior(demo.prior)(demo.names[0], demo.images[0], 4).device)
    photos = [view(name, *photo, sr=enlarged).lr for name, *photo in zip(demo.names, demo.images, demo.viewmats, demo.Ks)]
    maps = depth_maps(photos, torch.rand(5, 3, device=NAME) + 2)
    print(exposure_gains(photos, maps).device)

    def pseudo_views(device):
        made = PseudoViews(count=3, reach=0.1)
        made.on_fit_start(3, 0)
        made.to(device)
        made.on_views([View(str(i), photo.to(device), photo.to(device)) for i, photo in enumerate(photos)])
        return [made.extra_views(t)[0] for t in range(2, 20, 2)]

    for here, there in zip(pseudo_views("cpu"), pseudo_views(NAME), strict=True):
        assert torch.equal(here.photo.image, there.photo.image.cpu()) and torch.equal(here.weight, there.weight.cpu())
    print(there.photo.image.device)
"""
    ran = run(cwd=tmp_path, code=code)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split() == ["elsewhere:0", "elsewhere:0", "cpu", "elsewhere:0", "elsewhere:0", "elsewhere:0"]


@pytest.mark.slow
def test_strategies_train_in_a_gsplat_loop_elsewhere(tmp_path):
    pytest.importorskip("gsplat")
    code = """
import sys
from dataclasses import replace
from functools import partial

import torch
import torch.distributed.tensor  # torch's own imports would not know the generator below

import rasterizers.reference
from integration.examples import gsplat_loop
from integration.examples.demo import load_demo
from rasterizers.autograd import rasterization
from tests.helpers.elsewhere import NAME, Elsewhere

stereo, generator = gsplat_loop.stereo, torch.Generator

def few(*photos):
    points = stereo(*photos)
    return replace(points, means=points.means[:60], colors=points.colors[:60])

reference = rasterizers.reference.ReferenceRasterizer
reference.traits = replace(reference.traits, devices=frozenset({"cpu", NAME}))
torch.Generator = lambda _="cpu": generator()  # there are none for the other device
gsplat_loop.stereo = few
gsplat_loop.load_demo = lambda device: load_demo(64, 48, device=NAME)
gsplat_loop.cpu_rasterization = partial(rasterization, backend="torch")
with Elsewhere():
    for name in sys.argv[1:]:
        print(name, gsplat_loop.main(4, name))
"""
    ran = run(*STRATEGIES, cwd=tmp_path, code=code)
    assert ran.returncode == 0, ran.stderr
    assert [line.split()[0] for line in ran.stdout.splitlines()] == STRATEGIES


@pytest.mark.slow  # gsplat compiles its kernels
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("strategies", [None, "gco", "p2g", "svs", "clear", "best"])
def test_gsplats_loop_trains_on_cuda(strategies):
    pytest.importorskip("gsplat")
    from integration.examples.gsplat_loop import main

    torch.manual_seed(0)
    assert main(100, strategies) > 18
