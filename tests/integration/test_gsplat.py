"""CLEAR in an unmodified gsplat loop: it equals our own trainer, and each strategy changes only what it should."""

import functools
import gc
from dataclasses import replace

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, Objective, StrategyConflict
from clear_strategies.compose import conductor as composed_conductor
from clear_strategies.data.priors.interface import Bicubic
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.schedules import scaled
from clear_strategies.training.loop import iterate, view_at
from clear_strategies.training.optim import LearningRates
from integration import HostError
from integration.autograd_shot import HostOutput
from integration.gsplat import attach
from integration.pending import BackwardPass
from integration.views import view
from rasterizers import autograd
from tests.helpers import gsplat_host, toy
from tests.helpers.gsplat_host import RASTERIZER, Host, attached, drawn, rasterization, started, trained
from tests.helpers.host_parts import HR_FROM_START

STEPS = 20
EPS = 1e-10


def all_three():
    """New objects at every call, since strategies have state."""
    anchored = SVS(anchor_strength=0.01, anchor_weights={"means": 1e-4, "scales": 1e-4, "detail": 1e-6})
    return GCO(), P2G(patch=4), scaled(anchored, STEPS / 10_000)


def conductor():
    return Conductor(*all_three(), objective=scaled(Objective(), STEPS / 10_000), statistics_from=1)


def test_its_steps_equal_those_of_our_own_trainer():
    """With a larger ε than that of training, also because of rounding errors. What fails with one strategy fails with all."""
    scene = toy.scene(40)
    scene = replace(scene, train=tuple(map(gsplat_host.doubled, scene.train)))
    own = gsplat_host.in_double(scene, conductor(), STEPS, EPS)
    host = Host(scene, extent=own.optimizer.extent, eps=EPS)
    for p in host.splats.values():
        p.data = p.data.double()
    clear = attached(host, scene, conductor())
    host.optimizers["detail"].param_groups[0]["eps"] = EPS
    views = []
    for _ in range(STEPS):
        views.append(view_at(own).name)
        iterate(own, RASTERIZER)
    host.train(views)

    for attribute, p in own.field.raw().items():
        difference = float((p - host.splats[attribute].detach()).norm() / p.norm().clamp_min(1e-12))
        assert difference < 1e-4, attribute
    assert clear.attachment.t == STEPS + 1  # the next
    assert clear.attachment.counts["merges"] == STEPS
    assert clear.attachment.counts["HR renders"] == STEPS - 1  # lambda_HR is 0 until t = 1


def test_torchs_default_device_plays_no_part():
    """As of a loop that begins with `torch.set_default_device("cuda")`."""
    scene, trained = toy.scene(30), []
    photos = [(v.name, v.lr.image, v.lr.camera.world_to_camera, intrinsics(v.lr.camera)) for v in scene.train]
    for device in ("cpu", "meta"):
        host, clear = Host(scene), composed_conductor("best", iterations=6)
        with torch.device(device):
            views = [view(*photo, sr=clear.prior(Bicubic())) for photo in photos]
            attached(host, replace(scene, train=tuple(views)), clear)
            host.train([views[i % 3].name for i in range(6)])
        trained.append(host.splats)
    cpu, meta = trained
    assert [name for name, p in cpu.items() if not torch.equal(p, meta[name])] == []


def test_renderings_of_no_photo_train_nothing_and_look_the_same_once_the_detail_feature_is_folded():
    host, clear, _ = started()
    host.splats["detail"].data += 0.2
    shown = host.render(toy.camera(1.2).scaled(0.25))[0]
    shown.sum().backward()
    assert host.splats["detail"].grad is None
    clear.fold_detail()
    assert torch.allclose(host.render(toy.camera(1.2).scaled(0.25))[0], shown, atol=1e-6)
    assert not host.splats["detail"].any()
    assert clear.attachment.counts["LR renders"] == 0


@pytest.mark.parametrize(("iterations", "share"), [(300, 0.2), (30_000, 1)])
def test_f_det_learns_at_a_lower_rate_in_a_short_run(iterations, share):
    host, *_ = started(conductor=composed_conductor("baseline", iterations=iterations))
    assert host.optimizers["detail"].param_groups[0]["lr"] == pytest.approx(LearningRates().detail * share)


def test_remove_restores_the_loop():
    host, clear, _ = started(GCO(), detail=False)
    clear.remove()
    scene = toy.scene(20)
    alone = Host(scene)
    for each in (alone, host):
        each.train([v.name for v in scene.train])
    for name, p in alone.splats.items():
        assert torch.equal(p, host.splats[name])


def test_splats_are_attached_once_at_a_time():
    """A second attachment would step and number the same Gaussians; a cell of a notebook may be run twice."""
    host, clear, render = started(GCO())
    with pytest.raises(HostError, match=r"attached already; first remove\(\) the attachment"):
        attach(host.splats, host.optimizers, toy.scene(20).train, Conductor())
    render().mean().backward()
    host.optimizers["means"].step()
    clear.remove()
    _, again, render = started(GCO(), host=host)
    render().mean().backward()
    host.optimizers["means"].step()
    assert clear.attachment.counts["merges"] == again.attachment.counts["merges"] == 1


@pytest.mark.parametrize("another", [lambda c: c, lambda c: Conductor(*c.strategies, objective=c.objective)])
def test_a_strategy_trains_one_loop_at_a_time(another):
    """It would mix what it knows of two scenes, whose photos may have the same names."""
    scene, first, second = toy.scene(20), Host(), Host()
    conductor = Conductor(P2G(patch=4), objective=HR_FROM_START)
    clear, _ = attached(first, scene, conductor), attached(second, scene, goes_on := another(conductor))
    camera = scene.train[0].lr.camera
    second.render(camera)[0].mean().backward()
    with pytest.raises(StrategyConflict, match=r"begun anew for another one since.*Make a conductor for each loop"):
        first.render(camera)
    clear.remove()
    assert first.render(camera)[0].isfinite().all()
    assert goes_on.views


def first_gradient(degree=0, **settings):
    """Of a step with all strategies."""
    scene = toy.scene(30)
    host = Host(scene, **settings)
    host.degree = lambda _: degree
    trained(host, scene, Conductor(*all_three(), objective=HR_FROM_START), [scene.train[0].name])
    return host.grads


def with_info(change):
    """`rasterization` with other entries in its `info`."""

    @functools.wraps(autograd.rasterization)
    def changed(*args, **kwargs):
        renders, alphas, info = rasterization(*args, **kwargs)
        return renders, alphas, info | change(info)

    return changed


def test_a_renderer_without_projected_centres_and_radii_of_gsplat_1_4_are_supported():
    """The renderer of gsplat's 3DGUT (with_ut, with_eval3d) has no gradient of the projected centres."""
    host = Host(rasterization=with_info(lambda info: {"means2d": info["means2d"].detach()}))
    conductor = Conductor(*all_three(), objective=HR_FROM_START)
    clear = trained(host, host.scene, conductor, [v.name for v in host.scene.train])
    assert clear.attachment.counts["merges"] == 3
    assert float(host.splats["detail"].abs().max()) > 0
    of_1_4 = with_info(lambda info: {"radii": info["radii"][..., 0]})
    new, old = (first_gradient(rasterization=function) for function in (rasterization, of_1_4))
    for name, g in new.items():
        assert torch.equal(old[name], g), name


def gsplats(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **call):
    """A function of gsplat's signature, without `rgb_offset`."""
    return rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **call)


@pytest.mark.parametrize("function", [rasterization, gsplats], ids=["ours", "gsplat's"])
def test_colours_in_float16_have_the_gradients_of_float32(function):
    """`sh_fp16` of gsplat 1.6 casts what is drawn; the parameters stay float32."""
    full, halved = (first_gradient(3, rasterization=function, sh_fp16=half) for half in (False, True))
    for name in ("means", "scales", "opacities", "sh0", "shN", "detail"):  # round Gaussians have none of their quats
        g, in_half = full[name], halved[name]
        assert float((in_half - g).norm()) < 0.01 * float(g.norm()), name


def test_what_cannot_be_attached_or_drawn_is_refused():
    host, clear, render = started()
    scene = toy.scene(20)
    with pytest.raises(HostError, match=r"rendered at 96x64, but its photo has 24x16"):
        host.render(scene.train[0].hr.camera)
    with pytest.raises(HostError, match="wrapped already"):
        clear.wrap(host.rasterization)
    with pytest.raises(HostError, match="has no parameter Ks"):
        clear.wrap(lambda means, opacities, colors, viewmats, width, height: None)
    host.rasterization = functools.wraps(rasterization)(lambda *args, **call: (*rasterization(*args, **call), None))
    host.rasterization = clear.wrap(host.rasterization)
    with pytest.raises(HostError, match="returns 4 values, gsplat's rasterization returns 3"):
        render()
    with pytest.raises(ValueError, match="at least one view"):
        attach(host.splats, host.optimizers, (), Conductor())
    with pytest.raises(HostError, match=r"in torch\.inference_mode\(\) cannot be trained"), torch.inference_mode():
        attach(host.splats, host.optimizers, scene.train, Conductor())
    with pytest.raises(HostError, match=r"must be a dict or a torch\.nn.ParameterDict.*got list"):
        attach([*host.splats.values()], host.optimizers, scene.train, Conductor())
    del host.splats["sh0"]
    with pytest.raises(ValueError, match="sh0 is missing"):
        attach(host.splats, host.optimizers, scene.train, Conductor())
    host.splats["features"] = host.splats.pop("shN")
    with pytest.raises(HostError, match=r"harmonic textures.* train with simple_trainer\.py"):
        attach(host.splats, host.optimizers, scene.train, Conductor())


def test_parameters_that_are_computed_from_others_are_refused():
    """Their gradient would be lost: torch gives it to the leaves."""
    host = Host()
    colors = torch.nn.Parameter(torch.cat((host.splats["sh0"], host.splats["shN"]), 1).detach())
    slices = {**host.splats, "sh0": colors[:, :1], "shN": colors[:, 1:]}
    with pytest.raises(HostError, match=r"sh0 must be a leaf.*a Parameter of its own"):
        attach(slices, host.optimizers, host.scene.train, Conductor())
    model = torch.nn.Module()
    model.splats = torch.nn.ParameterDict(host.splats)
    clear = attach(model.splats, host.optimizers, host.scene.train, Conductor())
    host.rasterization = clear.wrap(host.rasterization)
    model.forward = lambda camera: drawn(host.rasterization, model.splats, camera)[0].mean()
    camera = (host.scene.train[0].lr.camera,)
    torch.func.functional_call(model, dict(model.named_parameters()), camera).backward()
    assert clear.attachment.counts["merges"] == 1
    with pytest.raises(HostError, match="means must be a leaf"):
        torch.func.functional_call(model, {name: p * 2 for name, p in model.named_parameters()}, camera)


@pytest.mark.parametrize("last_one_has_backward", [True, False])
def test_renderings_are_freed_after_their_step_and_with_the_loop(last_one_has_backward):
    def kept(kind=HostOutput):
        gc.collect()
        return sum(isinstance(thing, kind) for thing in gc.get_objects())

    def fail(_):
        raise RuntimeError("out of memory")

    before = kept()
    host, clear, render = started()
    render(2)  # without a backward pass: forgotten
    for i in (0, 1, 0):
        render(i).mean().backward()
    assert clear.attachment.counts["merges"] == 3
    loss = render(0).mean()
    failing = host.splats["means"].register_hook(fail)
    with pytest.raises(RuntimeError, match="out of memory"):  # torch calls nothing at the end of such a pass
        loss.backward()
    del loss
    assert kept(BackwardPass) == 0
    failing.remove()
    render(0).mean().backward()
    assert clear.attachment.counts["merges"] == 4
    if not last_one_has_backward:
        render(0)
        del host, clear, render
    assert kept() == before


def test_the_detail_feature_of_a_checkpoint_is_trained():
    host = Host()
    host.splats["detail"] = torch.nn.Parameter(torch.zeros(20, 3))  # as a checkpoint of the host holds it
    trained(host, host.scene, Conductor(P2G(), objective=HR_FROM_START), [v.name for v in host.scene.train])
    assert float(host.splats["detail"].abs().max()) > 0
