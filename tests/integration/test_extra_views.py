"""Extra views in other trainers: drawn by the host's own renderer, and learned from in a step of the host's own optimizer."""

import copy
import functools

import pytest
import torch

import rasterizers
from clear_strategies import Conductor
from clear_strategies.errors import HostError
from integration.inria.attached import _ATTRIBUTES
from rasterizers import Splats
from tests.helpers import gsplat_host, host_parts, toy
from tests.helpers.gsplat_host import Host, started
from tests.integration.test_inria import trained as trained_inria


@pytest.fixture
def drawn(monkeypatch):
    """Every render of an extra view that a conductor gets a loss of."""
    seen, loss = [], Conductor.extra_loss

    def extra_loss(self, image, extra, t):
        seen.append((image.detach().clone(), extra.photo.camera))
        return loss(self, image, extra, t)

    monkeypatch.setattr(Conductor, "extra_loss", extra_loss)
    return seen


def reference(params, camera, degree, **settings):
    """The same Gaussians by the float64 rasterizer; f_det takes no part."""
    p = {name: value.detach().double() for name, value in params.items()}
    bands = (degree + 1) ** 2 - 1
    splats = Splats(
        p["means"], p["quats"], p["scales"].exp(), p["opacities"].reshape(-1).sigmoid(), p["sh0"].reshape(-1, 1, 3),
        p["shN"][:, :bands],
    )  # fmt: skip
    return rasterizers.load("torch", near=0.01, kernel=0.3, antialiased=False, **settings)(splats, camera).image


def dark():
    return Conductor(toy.ShowsDark(), objective=host_parts.HR_FROM_START)


def test_gsplat_draws_it_and_steps_once_more_on_its_gradient(drawn):
    scene = toy.scene(20)
    with_extra, alone = Host(scene), Host(scene)
    for each in (with_extra, alone):
        each.splats["scales"].data += torch.tensor([0.0, 0.3, 0.6])
    start = {name: p.detach().clone() for name, p in with_extra.splats.items()}
    clear = gsplat_host.trained(with_extra, scene, dark(), [scene.train[0].name])
    image, camera = drawn[0]
    assert torch.allclose(image.double(), reference(start, camera, 0), atol=1e-5)
    assert clear.attachment.counts["extra views"] == 1

    gradient = extra_gradient(alone, camera)
    gsplat_host.trained(alone, scene, Conductor(objective=host_parts.HR_FROM_START), [scene.train[0].name])
    for name, optimizer in alone.optimizers.items():
        if name in gradient:
            alone.splats[name].grad = gradient[name]
            optimizer.step()
    for name, p in alone.splats.items():
        assert torch.allclose(with_extra.splats[name], p, rtol=1e-5, atol=1e-7), name


def extra_gradient(a_host, camera):
    """Of the LR loss of a black picture, at the host's parameters of now."""
    view = toy.ShowsDark()
    view.on_views(toy.scene(20).train)
    conductor, extra = dark(), view.extra_views(1)[0]
    p = a_host.splats
    renders, _, _ = a_host.render(camera, 0)
    cotangent = conductor.extra_loss(renders[0], extra, 1).cotangents[0]
    names = [name for name in p if name in _ATTRIBUTES]
    found = torch.autograd.grad(
        renders[0], [p[name] for name in names], cotangent, allow_unused=True, materialize_grads=True
    )
    return dict(zip(names, found, strict=True))


def test_accumulated_passes_are_one_step_with_one_extra_step(drawn):
    scene = toy.scene(20)
    a_host = Host(scene, accumulation=2)
    names = [view.name for view in scene.train] * 2
    clear = gsplat_host.trained(a_host, scene, dark(), names, accumulation=2)
    assert len(drawn) == clear.attachment.counts["extra views"] == 3
    assert clear.attachment.counts["steps of the host alone"] == 0


def stepped(make, scaler=None):
    """The parameters after a step by the optimizers that `make` gives for them, and how many extra steps were counted."""
    trainer = Host()
    trainer.optimizers = make(trainer.splats)
    loss_scale = None if scaler is None else scaler.get_scale
    _, clear, render = started(toy.ShowsDark(), host=trainer, detail=False, loss_scale=loss_scale)
    (render().mean() if scaler is None else scaler.scale(render().mean())).backward()
    for optimizer in dict.fromkeys(trainer.optimizers.values()):
        optimizer.step() if scaler is None else scaler.step(optimizer)
    return trainer.splats, clear.attachment.counts["extra views"]


def test_an_adam_of_all_parameters_makes_one_extra_step_which_a_scaler_of_losses_leaves_as_it_is():
    one = stepped(lambda splats: dict.fromkeys(splats, torch.optim.Adam(list(splats.values()))))
    each = stepped(lambda splats: {name: torch.optim.Adam([p]) for name, p in splats.items()})
    assert one[1] == each[1] == 1
    assert all(torch.equal(p, one[0][name]) for name, p in each[0].items())

    def fused(splats):
        return {name: torch.optim.Adam([p], eps=1e-15, fused=True) for name, p in splats.items()}

    scaled, plain = stepped(fused, torch.amp.GradScaler("cpu", init_scale=1024.0)), stepped(fused)
    for name, p in plain[0].items():
        assert torch.allclose(p, scaled[0][name], rtol=0, atol=1e-6), name


def test_a_step_on_an_extra_view_moves_the_gaussians_alone_and_leaves_gradients_to_the_loop():
    trainer, exposure = Host(), torch.nn.Parameter(torch.ones(1))
    one = torch.optim.SGD([*trainer.splats.values(), exposure], lr=0.5)
    trainer.optimizers = {"all": one}
    _, clear, render = started(toy.ShowsDark(), host=trainer)
    (render().mean() + exposure.sum()).backward()
    before = {name: p.grad.clone() for name, p in trainer.splats.items() if p.grad is not None}
    one.step()
    assert clear.attachment.counts["extra views"] == 1
    assert float(exposure) == 0.5
    assert float(before["detail"].abs().max()) > 0
    assert torch.allclose(trainer.splats["detail"], -one.param_groups[-1]["lr"] * before["detail"], rtol=1e-5, atol=0)
    assert all(torch.equal(trainer.splats[name].grad, g) for name, g in before.items())


def test_gaussians_that_were_replaced_since_make_no_step_on_an_extra_view():
    """3DGS densifies before it steps."""
    trainer, clear, render = started(toy.ShowsDark())
    render().mean().backward()
    for name, optimizer in trainer.optimizers.items():
        trainer.splats[name] = torch.nn.Parameter(trainer.splats[name].detach().clone())
        optimizer.param_groups[0]["params"] = [trainer.splats[name]]
        optimizer.step()
    assert clear.attachment.counts["merges"] == 1
    assert clear.attachment.counts["extra views"] == 0


def test_an_inria_style_host_draws_any_camera(inria_host, inria_capture, drawn):
    opt = host_parts.options(inria_host, inria_capture, iterations=1)
    _, clear, _ = trained_inria(inria_host, inria_capture, [toy.ShowsDark()], iterations=1)
    image, camera = drawn[0]
    assert image.shape == (camera.height, camera.width, 3)
    start, _ = inria_host.setup(opt)
    before = copy.copy(clear.params())
    before |= {name: getattr(start, attribute) for name, attribute in _ATTRIBUTES.items()}
    assert torch.allclose(image.double(), reference(before, camera, 0), atol=1e-4)


def test_an_inria_style_host_steps_on_it_with_each_of_its_optimizers(inria_host, inria_capture, monkeypatch):
    """Taming-3DGS and FastGS have one more, of the higher SH bands."""

    def set_up(model, opt):
        setup(model, opt)
        groups = model.optimizer.param_groups
        (sh,) = (i for i, group in enumerate(groups) if group["name"] == "f_rest")
        model.shoptimizer = torch.optim.Adam([groups.pop(sh)], lr=0.0, eps=1e-15)

    def step(model, _):
        if hasattr(model, "shoptimizer"):
            model.shoptimizer.step()
            model.shoptimizer.zero_grad()

    setup, done = inria_host.GaussianModel.training_setup, []
    for both in (setup, set_up):
        monkeypatch.setattr(inria_host.GaussianModel, "training_setup", both)
        done.append(
            trained_inria(inria_host, inria_capture, [toy.ShowsDark()], also=step, iterations=12, densify_until_iter=0)
        )
    (one, clear, _), (two, *_) = done
    assert clear.attachment.counts["extra views"] == 12
    assert bool(one._features_rest.any())
    assert all(torch.equal(getattr(one, name), getattr(two, name)) for name in _ATTRIBUTES.values())


@pytest.mark.parametrize(
    "step", [lambda self, visibility: None, lambda self, visibility, N: None], ids=["gsplat", "3dgs"]
)
def test_an_adam_of_visible_gaussians_steps_all_of_them_on_an_extra_view(step):
    calls = []

    @functools.wraps(step)
    def recorded(self, *args, **kwargs):
        calls.append((*args, *kwargs.values()))

    selective, trainer = type("Selective", (torch.optim.Adam,), {"step": recorded}), Host()
    trainer.optimizers = {name: selective([p]) for name, p in trainer.splats.items()}
    started(toy.ShowsDark(), host=trainer)[2]().mean().backward()
    everyone = torch.ones(20, dtype=torch.bool), 20
    trainer.optimizers["means"].step(*everyone[: step.__code__.co_argcount - 1])
    by_host, on_extra_view = calls
    assert torch.equal(by_host[0], on_extra_view[0])
    assert by_host[1:] == on_extra_view[1:]


def test_an_optimizer_that_needs_something_else_to_step_on_an_extra_view_is_refused():
    """As that of hierarchical 3DGS, which takes indices of Gaussians."""
    trainer = Host()
    other = type("Other", (torch.optim.Adam,), {"step": lambda self, relevant, closure=None: None})
    trainer.optimizers = {name: other([p]) for name, p in trainer.splats.items()}
    started(toy.ShowsDark(), host=trainer)[2]().mean().backward()
    with pytest.raises(HostError, match=r"Other.step needs relevant, which is not known for an extra view"):
        trainer.optimizers["means"].step(torch.arange(20))
