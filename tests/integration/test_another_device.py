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


@pytest.mark.slow
def test_public_functions_take_photos_of_another_device_and_strategies_train_there_in_a_gsplat_loop(tmp_path):
    """Cameras stay on the CPU. Stereo, which takes longest, is computed once."""
    pytest.importorskip("gsplat")
    code = """
import sys
from dataclasses import replace
from functools import partial

import torch
import torch.distributed.tensor  # torch's own imports would not know the generator below

import rasterizers.reference
from clear_strategies import PseudoViews, View
from clear_strategies.compose import conductor
from clear_strategies.geometry import exposure_gains
from integration.examples import gsplat_loop
from integration.examples.demo import load_demo
from integration.views import view
from rasterizers.autograd import rasterization
from tests.helpers.elsewhere import NAME, Elsewhere

def enlarged(name, image, factor):  # a network that answers from where it runs
    return image.to(NAME).repeat_interleave(factor, 0).repeat_interleave(factor, 1)

def pseudo_views(device):
    made = PseudoViews(count=3, reach=0.1)
    made.on_fit_start(3, 0)
    made.to(device)
    made.on_views([View(str(i), photo.to(device), photo.to(device)) for i, photo in enumerate(photos)])
    return [made.extra_views(t)[0] for t in (2, 4, 6)]

with Elsewhere():
    demo = load_demo(64, 48, device=NAME)
    best, names = conductor("best", iterations=10), demo.names
    one, *_ = photos_and_cameras = [*zip(demo.images, demo.viewmats, demo.Ks)]
    made = view("one", *one, sr=best.prior(enlarged), mask=torch.ones(12, 16))
    print(made.lr.image.device, made.hr.image.device, made.lr.camera.world_to_camera.device)
    print(best.prior(demo.prior)(names[0], one[0], 4).device)
    photos = [view(name, *photo, sr=enlarged).lr for name, photo in zip(names, photos_and_cameras)]
    found = gsplat_loop.stereo(demo.images, demo.viewmats, demo.Ks)
    print(found.means.device, exposure_gains(photos, found.depths).device)
    for here, there in zip(pseudo_views("cpu"), pseudo_views(NAME), strict=True):
        assert torch.equal(here.photo.image, there.photo.image.cpu()) and torch.equal(here.weight, there.weight.cpu())
    print(there.photo.image.device)

    reference, generator = rasterizers.reference.ReferenceRasterizer, torch.Generator
    reference.traits = replace(reference.traits, devices=frozenset({"cpu", NAME}))
    torch.Generator = lambda _="cpu": generator()  # there are none for the other device
    gsplat_loop.stereo = lambda *_: replace(found, means=found.means[:60], colors=found.colors[:60])
    gsplat_loop.load_demo = lambda device: demo
    gsplat_loop.cpu_rasterization = partial(rasterization, backend="torch")
    for name in sys.argv[1:]:
        gsplat_loop.train(4, name)
        print(name)
"""
    ran = run(*STRATEGIES, cwd=tmp_path, code=code)
    assert ran.returncode == 0, ran.stderr
    there = "elsewhere:0"
    assert ran.stdout.split() == [there, there, "cpu", *[there] * 4, *STRATEGIES]


@pytest.mark.slow  # gsplat compiles its kernels
@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("strategies", [None, "gco", "p2g", "svs", "clear", "best"])
def test_gsplats_loop_trains_on_cuda(strategies):
    pytest.importorskip("gsplat")
    from integration.examples.gsplat_loop import main

    torch.manual_seed(0)
    assert main(100, strategies) > 18
