"""`joint_loss` in the smallest host: torch parameters, torch.optim, and a renderer with autograd."""

from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, Strategy
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.core.step import Step
from clear_strategies.training.field import GaussianField
from integration import AutogradShot, HostError, ScoreScaler, autograd_shot, extra_loss, graph, joint_loss
from integration.autograd_shot import ScreenGradientSlot
from rasterizers import autograd
from rasterizers.geometry import SH_C0
from tests.helpers import toy
from tests.helpers.command_line import started
from tests.helpers.host_parts import HR_FROM_START, shot_of


class Host:
    """A trainer that is not ours."""

    def __init__(self, scene):
        self.field, g = GaussianField.from_cloud(scene.cloud), torch.Generator().manual_seed(0)
        self.field.degree = 3
        # The rotation of a ball has no gradient but for rounding.
        for rows in (self.field.scales.data, self.field.quats.data):
            rows.add_(torch.randn(rows.shape, generator=g), alpha=0.5)
        self.params = {name: value.clone().requires_grad_() for name, value in self.field.raw().items()}

    def activated(self, **computed):
        """What a rasterizer is given: the activated parameters, and what is computed of them in their place."""
        p = self.params
        return p | {"scales": p["scales"].exp(), "opacities": p["opacities"].sigmoid()} | computed

    def draw(self, camera, offset=None, centres=None, **computed):
        """A shot with this offset of the colours."""
        return shot_of(self.params, camera, offset, centres, **computed)

    def render(self, camera, z=None, detail=True):
        p = self.params
        gated = {} if z is None else {"opacities": p["opacities"].sigmoid() * z}
        if detail:
            return self.draw(camera, p["detail"], **gated)
        params = {name: value for name, value in p.items() if name != "detail"}
        return replace(self.draw(camera, torch.zeros_like(p["detail"]), **gated), params=params)


def drawn(*strategies):
    """A host, a conductor, a view, and both of its renderings."""
    host, view = Host(scene := toy.scene(20)), scene.train[0]
    conductor = Conductor(*strategies, objective=HR_FROM_START)
    return host, conductor, view, host.render(view.lr.camera, detail=False), host.render(view.hr.camera)


def cotangents(objective, lr, hr, view, share=1.0):
    """Of the losses of LR, of HR and of HR's high frequencies, which compare this share of the brightness."""
    (of_lr,) = share * objective.lr(share * lr.image.detach(), view.lr.image, None).cotangents
    base, hf = share * objective.hr(share * hr.image.detach(), view.hr.image, None).cotangents
    return of_lr, base, hf


def gradients(objective, lr, hr, view, *leaves):
    """Of the whole loss at t = 5, without routing."""
    of_lr, base, hf = cotangents(objective, lr, hr, view)
    of_hr = objective.lambda_hr(5) * (base + objective.lambda_hf * hf)
    of_scales = torch.autograd.grad(lr.image, leaves, of_lr), torch.autograd.grad(hr.image, leaves, of_hr)
    return [g_lr + g_hr for g_lr, g_hr in zip(*of_scales, strict=True)]


@pytest.mark.parametrize("strategies", [(), (GCO(),), (P2G(),), (SVS(),), (GCO(), P2G(), SVS())], ids=len)
def test_backward_gives_the_conductors_gradient(strategies):
    scene = toy.scene(20)
    host, view = Host(scene), scene.train[0]
    conductor = Conductor(*strategies, objective=HR_FROM_START)
    conductor.on_fit_start(3, 0)
    z = conductor.gate(5, 20)
    lr, hr = host.render(view.lr.camera, z, detail=False), host.render(view.hr.camera, z)
    (2.0 * joint_loss(conductor, host.params, lr, hr, view, 5)[0]).backward()

    ours = Conductor(*strategies, objective=HR_FROM_START)
    ours.on_fit_start(3, 0)
    shots = host.field.render_scales(toy.RASTERIZER, view, gate=ours.gate(5, 20))
    expected = ours.update(host.field.raw(), *shots, view, 5).grads
    for name, p in host.params.items():
        scale = float(expected[name].abs().max())
        assert torch.allclose(p.grad, 2 * expected[name], atol=1e-4 * scale, rtol=1e-3), name
    own = {name: x.requires_grad_() for name, x in host.field.raw().items()}  # which no graph leads from
    joint_loss(ours, own, *shots, view, 5, ScoreScaler(1e-4))[0].backward()
    assert not [name for name, p in own.items() if not torch.equal(p.grad, expected[name])]
    shots[1].image.requires_grad_()  # for its cotangents
    joint_loss(ours, own, *shots, view, 5)


def test_its_value_is_the_sum_of_the_losses_and_backward_writes_the_score_for_a_densifier():
    host, conductor, view, lr, hr = drawn(GCO())
    loss, update = joint_loss(conductor, host.params, lr, hr, view, 50, ScoreScaler(1e-4))
    l = update.losses
    assert loss.item() == pytest.approx(l["lr"] + l["base"] + 0.2 * l["hf"], rel=1e-6)
    (2 * loss).backward()
    written = lr.means2d.grad * torch.tensor([view.lr.camera.width / 2, view.lr.camera.height / 2])
    assert torch.allclose(written.norm(dim=1), 2 * update.score)


def test_lbfgs_trains_by_a_closure_that_is_called_several_times_in_a_step():
    host, conductor, view, *_ = drawn(GCO(), P2G(patch=4), SVS())
    conductor.on_fit_start(3, 0)
    optimizer = torch.optim.LBFGS([*host.params.values()], line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        shots = host.render(view.lr.camera, detail=False), host.render(view.hr.camera)
        loss, _ = joint_loss(conductor, host.params, *shots, view, t)
        loss.backward()
        return loss

    losses = []
    for t in range(1, 4):  # noqa: B007 - of the closure
        losses.append(float(optimizer.step(closure).detach()))
    assert losses[-1] < 0.8 * losses[0]


def test_an_extra_view_has_the_gradient_of_its_losses_at_lr():
    scene = toy.scene(20)
    host, conductor = Host(scene), Conductor(toy.ShowsDark(), objective=HR_FROM_START)
    conductor.on_fit_start(3, 0, views=scene.train)
    (extra,) = conductor.extra_views(1)
    image = host.render(extra.photo.camera, detail=False).image
    (g,) = torch.autograd.grad(2 * extra_loss(conductor, image, extra, 1), image)
    assert g.any()
    torch.testing.assert_close(g, 2 * conductor.extra_loss(image, extra, 1).cotangents[0])


@dataclass(frozen=True)
class Halved(Strategy):
    """Compares half of the brightness."""

    def compare(self, scale, image, photo, step, losses):
        found = losses(image * 0.5)
        found.cotangents.mul_(0.5)
        return found


class OfCameras(torch.autograd.Function):
    """One node that draws by a function of its inputs, which have a first dimension of cameras, as those of gsplat's node."""

    @staticmethod
    def forward(ctx, draw, *inputs):
        ctx.inputs = [x[0].detach().requires_grad_() for x in inputs]
        with torch.enable_grad():
            ctx.image = draw(*ctx.inputs)
        return ctx.image.detach()

    @staticmethod
    def backward(ctx, g):
        return None, *(x[None] for x in torch.autograd.grad(ctx.image, ctx.inputs, g, retain_graph=True))


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("strategies", [(GCO(),), (GCO(), P2G(patch=4))], ids=len)
@pytest.mark.parametrize("hooked", [False, True])
@pytest.mark.parametrize("by_camera", [False, True])
def test_what_else_the_loop_trains_gets_its_gradient(share, strategies, hooked, by_camera):
    """The exposure, which is applied after drawing, that of LR; an offset of what is drawn also that of HR after routing."""
    scene, comparing = toy.scene(20), [Halved()] * (share < 1)
    host, view, conductor = Host(scene), scene.train[0], Conductor(*strategies, *comparing, objective=HR_FROM_START)
    conductor.on_fit_start(3, 0, views=scene.train)
    exposure, offset = torch.eye(3).requires_grad_(), torch.zeros(1, 1, 3, requires_grad=True)

    def render(camera, detail=None):
        sh0 = host.params["sh0"] + offset
        if hooked:
            sh0.register_hook(lambda g: 3 * g)
        shot = host.draw(camera, detail, sh0=sh0)
        if by_camera:
            named = host.activated(sh0=sh0 if detail is None else sh0 + detail[:, None] / SH_C0)
            inputs = {name: named[name][None] for name in PARAMETERS}
            centres = (host.params["means"][:, :2] * 1)[None]
            image = OfCameras.apply(
                lambda means2d, *x: host.draw(camera, None, means2d, **dict(zip(inputs, x, strict=True))).image,
                centres, *inputs.values(),
            )  # fmt: skip
            shot = replace(shot, image=image, slot=ScreenGradientSlot(centres, (camera.width, camera.height)))
        return replace(shot, image=shot.image @ exposure)

    lr, hr = render(view.lr.camera), render(view.hr.camera, host.params["detail"])
    joint, _ = joint_loss(conductor, host.params, lr, hr, view, 5)
    (3 * joint).backward()
    objective, m = conductor.objective, conductor.hr_gradients(hr, Step(5, view)).m
    of_lr, *of_hr = cotangents(objective, lr, hr, view, share)
    of_exposure, of_offset = torch.autograd.grad(lr.image, (exposure, offset), of_lr)
    base, hf = hr.vjp(torch.stack(of_hr))
    routed = base["sh0"] + objective.lambda_hf * torch.as_tensor(m).view(-1, 1, 1) * hf["sh0"]
    of_offset = of_offset + objective.lambda_hr(5) * routed.sum(0, keepdim=True)
    for leaf, expected in ((exposure, of_exposure), (offset, of_offset)):
        assert expected.abs().max() > 1e-4
        torch.testing.assert_close(leaf.grad, 3 * expected)


def sum_of_blobs(p, colours, camera):
    """An image, many nodes of torch, and the projected centres that it is computed from."""
    pose = camera.world_to_camera
    x, y, z = (p["means"] @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    centres = torch.stack((camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), 1)
    centres.retain_grad()
    pixels = torch.stack(torch.meshgrid(torch.arange(camera.width), torch.arange(camera.height), indexing="xy"), -1)
    distances = (pixels - centres[:, None, None]).square().sum(-1, keepdim=True)
    sizes = camera.width * p["scales"].exp().mean(1)[:, None, None, None]
    alphas = p["opacities"].sigmoid()[:, None, None, None] * torch.exp(-distances / sizes**2)
    return (alphas * colours[:, None]).sum(0), centres


def test_the_graph_of_a_rasterizer_that_loops_in_torch_is_not_walked_at_each_of_its_nodes(monkeypatch, caplog):
    """A network before it learns from LR alone. A walk at each node would take longer than the step."""
    host, conductor, view, *_ = drawn()
    offset, leaf_of, seen = torch.zeros(3, requires_grad=True), graph.leaf_of, []
    monkeypatch.setattr(graph, "leaf_of", lambda node: (seen.append(node), leaf_of(node))[1])
    del host.params["detail"], host.params["shN"]

    def render(camera):
        image, centres = sum_of_blobs(host.params, host.params["sh0"] + offset, camera)
        looped = sum(image * centres[i % 20, 0] for i in range(200))
        return AutogradShot(looped, centres, torch.ones(20, dtype=torch.bool), host.params)

    joint_loss(conductor, host.params, render(view.lr.camera), render(view.hr.camera), view, 5)[0].backward()
    assert len(seen) < 4 * len(set(seen))
    assert "learn from LR alone" in caplog.text


@pytest.mark.parametrize("found", ["in the graph", "behind the centres", "in torch", "by name"])
def test_what_reaches_the_colours_and_the_rasterizer_counts_once(found):
    """The gradient of the positions, from whose directions a network computes colours."""
    scene = toy.scene(20)
    host, view, conductor = Host(scene), scene.train[0], Conductor(objective=HR_FROM_START)
    conductor.on_fit_start(3, 0, views=scene.train)
    network = torch.nn.Linear(3, 3)
    if found == "in torch":
        del host.params["detail"], host.params["shN"]

    def render(camera, detail=None):
        p = host.params
        sh0 = p["sh0"] + network(torch.nn.functional.normalize(p["means"], dim=1))[:, None]
        centres = p["means"] * 1 if found == "behind the centres" else p["means"]
        if found == "in torch":
            image, centres = sum_of_blobs(p, sh0, camera)
            return AutogradShot(image, centres, torch.ones(20, dtype=torch.bool), p)
        named = host.activated(means=centres, sh0=sh0)
        shot = host.draw(camera, detail, **named)
        slot = ScreenGradientSlot(shot.means2d if centres is p["means"] else centres, (camera.width, camera.height))
        return replace(shot, slot=slot, drawn=named if found == "by name" else None)

    lr, hr = render(view.lr.camera), render(view.hr.camera, host.params.get("detail"))
    if found == "by name":
        for of_lr, of_hr in ((lr, replace(hr, drawn=None)), (replace(lr, drawn=None), hr)):
            with pytest.raises(HostError, match="means of drawn reaches sh0"):
                joint_loss(conductor, host.params, of_lr, of_hr, view, 5)
        return
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    leaves = [*map(host.params.get, ("means", "opacities", "sh0")), network.weight]
    for leaf, g in zip(leaves, gradients(conductor.objective, lr, hr, view, *leaves), strict=True):
        torch.testing.assert_close(leaf.grad, g, rtol=1e-4, atol=1e-4 * float(g.abs().max()))


def test_the_means_count_once_at_lr_where_two_drawings_make_the_picture():
    host, conductor, view, *_ = drawn()
    del host.params["detail"]
    named = host.activated(sh0=host.params["sh0"] + host.params["means"][:, None])
    with autograd.collected_drawings() as drawings:
        first, second = (host.draw(view.lr.camera, **named) for _ in range(2))
    lr = replace(first, image=(first.image + second.image) / 2, drawn=named, drawings=drawings)
    joint_loss(conductor, host.params, lr, None, view, 5)[0].backward()
    (cotangent,) = conductor.objective.lr(lr.image.detach(), view.lr.image, None).cotangents
    means = host.params["means"]
    torch.testing.assert_close(means.grad, *torch.autograd.grad(lr.image, means, cotangent))


@pytest.mark.parametrize("rows", [1, 20])
@pytest.mark.parametrize("frozen", [False, True])
def test_what_moves_the_means_also_learns_from_hr_where_a_rasterizer_takes_centres_that_are_computed_from_them(
    frozen, rows
):
    host, conductor, view, *_ = drawn()
    shift = torch.zeros(rows, 2, requires_grad=True)  # of 20 rows it has the shape of the centres
    host.params["means"].requires_grad_(not frozen)

    def render(camera, detail=None):
        means = host.params["means"] + torch.nn.functional.pad(shift, (0, 1))
        return host.draw(camera, detail, means[:, :2] * 1, means=means)

    lr, hr = render(view.lr.camera), render(view.hr.camera, host.params["detail"])
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    torch.testing.assert_close(shift.grad, *gradients(conductor.objective, lr, hr, view, shift))


def test_a_tensor_that_reaches_the_rasterizer_and_its_image_learns_from_lr_alone_and_a_warning_tells(caplog):
    host, conductor, view, *_ = drawn()
    gain, network = torch.ones(1, requires_grad=True), torch.ones(3, requires_grad=True)

    def render(camera, detail=None):
        shot = host.draw(camera, detail, sh0=host.params["sh0"] * gain * network)
        return replace(shot, image=shot.image * gain)

    lr, hr = render(view.lr.camera), render(view.hr.camera, host.params["detail"])
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    of_lr, *_ = cotangents(conductor.objective, lr, hr, view)
    torch.testing.assert_close(gain.grad, torch.autograd.grad(lr.image, gain, of_lr, retain_graph=True)[0])
    (of_both,) = gradients(conductor.objective, lr, hr, view, network)
    torch.testing.assert_close(network.grad, of_both)  # what is not shared
    assert "learn from LR alone" in caplog.text


def test_the_graph_beside_what_is_drawn_is_walked_once(monkeypatch):
    host, _, view, *_ = drawn()
    named, beside, walks = host.activated(), autograd_shot._beside, []
    shot = replace(host.draw(view.lr.camera, **named), drawn={name: named[name] for name in PARAMETERS})
    monkeypatch.setattr(autograd_shot, "_beside", lambda shot: walks.append(1) or beside(shot))
    assert autograd_shot.at_inputs(shot, print).drawn == shot.drawn
    assert len(walks) == 1
    in_part = autograd_shot.at_inputs(replace(shot, drawn={"means": named["means"]}), print)
    assert (in_part.drawn, len(walks)) == (None, 3)


def test_what_a_host_copies_for_the_screen_gradient_is_told_without_a_wait_for_the_device(monkeypatch):
    host, conductor, view, *_ = drawn()

    def render(camera, detail=None):
        centres = torch.zeros(20, 3, requires_grad=True) + 0
        shot = host.draw(camera, detail, centres[:, :2])
        return replace(
            shot, means2d=shot.means2d.detach(), slot=ScreenGradientSlot(centres, (camera.width, camera.height))
        )

    lr, hr = render(view.lr.camera), render(view.hr.camera, host.params["detail"])
    monkeypatch.setattr(torch, "equal", None)
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()


def test_a_compiled_loop_calls_the_loss_outside_of_its_graph(recwarn):
    host, conductor, view, lr, hr = drawn(GCO())
    torch.compile(lambda: 2 * joint_loss(conductor, host.params, lr, hr, view, 5)[0], backend="eager")().backward()
    assert not [warning for warning in recwarn if "ynamo" in str(warning.message)]


def test_f_det_may_be_named_beside_the_colours_that_are_computed_from_it():
    host, conductor, view, lr, _ = drawn()
    detail = host.params["detail"]
    named = host.activated(sh0=host.params["sh0"] + detail[:, None])
    hr = replace(host.draw(view.hr.camera, **named), drawn=named)
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    *_, hf = cotangents(conductor.objective, lr, hr, view)
    (expected,) = torch.autograd.grad(hr.image, detail, conductor.objective.lambda_hf * hf)
    torch.testing.assert_close(detail.grad, expected * conductor.objective.lambda_hr(5))


ROWS = {
    "as they are": lambda x: x,
    "in another order": lambda x: x.flip(0),
    "some of them": lambda x: x[:15],
    "a sky beside them": lambda x: torch.cat((x, x[:6].detach() + 0.1)),
}


@pytest.mark.parametrize(
    ("made", "known"), [("drawn", False), ("exposed", False), ("exposed", True), ("brightened", True)]
)
@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS)
def test_what_is_drawn_may_have_other_rows_than_the_parameters(rows, made, known):
    """Each parameter gets its gradient by autograd, f_det also where it is drawn at half of its strength, opacities also where
    they reach the image beside its drawing. If the shot has `drawings`, other rows are refused.
    """
    scene = toy.scene(20)
    host, view = Host(scene), scene.train[0]
    conductor = Conductor(GCO(), P2G(patch=4), objective=HR_FROM_START)
    conductor.on_fit_start(3, 0, views=scene.train)
    exposure = torch.eye(3).requires_grad_()

    def render(camera, detail):
        each = host.activated()
        with autograd.collected_drawings() as drawings:
            shot = host.draw(camera, rows(0.5 * detail), **{name: rows(x) for name, x in each.items()})
        drawn = rows(torch.arange(20.0)).long()[:20]
        centres = shot.means2d[: len(drawn)].detach()  # of which no tensor of the graph has these rows
        slot = ScreenGradientSlot(centres, (camera.width, camera.height), rows=drawn)
        visible = torch.zeros(20, dtype=torch.bool).index_copy_(0, drawn, shot.visible[: len(drawn)])
        means2d = torch.zeros(20, 2).index_copy_(0, drawn, shot.means2d[: len(drawn)].detach())
        images = {
            "drawn": shot.image,
            "exposed": shot.image @ exposure,
            "brightened": shot.image + 0.1 * each["opacities"].mean(),
        }
        return AutogradShot(images[made], means2d, visible, host.params, slot, drawings=drawings if known else ())

    lr, hr = render(view.lr.camera, torch.zeros(20, 3)), render(view.hr.camera, host.params["detail"])
    if known and made == "exposed" and rows is not ROWS["as they are"]:
        with pytest.raises(HostError, match="hr is rendered with its Gaussians in another order"):
            joint_loss(conductor, host.params, lr, hr, view, 5)
        return
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    lr, hr = replace(lr, drawings=()), replace(hr, drawings=())
    expected = conductor.update({name: p.detach() for name, p in host.params.items()}, lr, hr, view, 5).grads
    for name, p in host.params.items():
        atol = 1e-5 * float(expected[name].abs().max())
        torch.testing.assert_close(
            p.grad, expected[name], rtol=1e-4, atol=atol, msg=lambda found, name=name: f"{name}: {found}"
        )


def test_a_hook_of_a_parameter_is_called_once_with_the_merged_gradient():
    found = []
    for hooked in (False, True):
        host, conductor, view, lr, hr = drawn(GCO())
        if hooked:
            host.params["means"].register_hook(lambda g: 3 * g)
        joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
        found.append({name: p.grad for name, p in host.params.items()})
    plain, tripled = found
    for name, g in plain.items():
        torch.testing.assert_close(tripled[name], 3 * g if name == "means" else g)
    host.params["means"].grad = None
    (2 * host.params["means"].sum()).backward()
    assert bool((host.params["means"].grad == 6).all())  # the hook is still there


def test_what_is_no_rendering_of_the_parameters_is_refused():
    host, conductor, view, lr, hr = drawn()
    joint = partial(joint_loss, conductor, view=view, t=5)
    with pytest.raises(HostError, match="sh0 must be a leaf"):
        joint(host.params | {"sh0": host.params["sh0"] * 2}, lr, hr)
    with pytest.raises(
        HostError, match=r"must hold the parameters themselves, got other tensors as scales\. Pass .*drawn="
    ):
        joint(host.params, replace(lr, params=lr.params | {"scales": lr.params["scales"].exp()}), hr)
    with pytest.raises(TypeError, match=r"hr must be a Shot, e\.g\. AutogradShot.*, got Tensor"):
        joint(host.params, lr, hr.image)
    with torch.no_grad():
        frozen = host.render(view.hr.camera)
    with pytest.raises(HostError, match=r"hr must be drawn with gradients: leave torch\.no_grad\(\)"):
        joint(host.params, lr, frozen)
    with pytest.raises(ValueError, match=r"must have the shape \[16, 24, 3\] of its LR image, got \[16, 24, 4\]"):
        joint(host.params, replace(lr, image=torch.cat((lr.image, lr.image[..., :1]), -1)), hr)
    rule = r"view view0: the HR rendering must have the shape \[64, 96, 3\] .*, got \[16, 24, 3\]"
    with pytest.raises(ValueError, match=rule):
        joint(host.params, lr, host.render(view.lr.camera))


@pytest.mark.parametrize("scale", ["lr", "hr"])
def test_a_rendering_with_other_intrinsics_than_its_photo_is_refused(scale):
    host, conductor, view, *_ = drawn()
    cameras = {"lr": view.lr.camera, "hr": view.hr.camera}
    cameras[scale] = replace(cameras[scale], fx=cameras[scale].fx * 1.1)
    lr, hr = host.render(cameras["lr"], detail=False), host.render(cameras["hr"])
    with pytest.raises(HostError, match=f"{scale} of view0 is rendered with fx=.*but its photo has fx="):
        joint_loss(conductor, host.params, lr, hr, view, 5)


def test_parameters_without_a_row_for_each_gaussian_or_of_other_names_are_refused():
    host, conductor, view, lr, hr = drawn()
    with pytest.raises(ValueError, match=r"params\['pose'\] must have a row for each of the 20 .*, got \[1, 6\]"):
        joint_loss(conductor, host.params | {"pose": torch.zeros(1, 6)}, lr, hr, view, 5)
    renamed = {("xyz" if name == "scales" else name): p for name, p in host.params.items()}
    with pytest.raises(ValueError, match="they have no gradient of xyz"):
        joint_loss(conductor, renamed, lr, hr, view, 5)


def test_f_det_at_lr_or_not_at_hr_and_a_strategy_that_has_not_started_are_refused():
    host, conductor, view, lr, hr = drawn(SVS())
    with pytest.raises(ValueError, match="SVS has not started"):
        joint_loss(conductor, host.params, lr, hr, view, 5)
    conductor.on_fit_start(3, 0)
    joint_loss(conductor, host.params, lr, hr, view, 5)
    with pytest.raises(ValueError, match="lr is drawn with f_det"):
        joint_loss(conductor, host.params, host.render(view.lr.camera), hr, view, 5)
    with pytest.raises(ValueError, match="hr is drawn without f_det"):
        joint_loss(conductor, host.params, lr, host.render(view.hr.camera, detail=False), view, 5)
    host.params["detail"].requires_grad_(False)
    joint_loss(conductor, host.params, lr, host.render(view.hr.camera), view, 5)[0].backward()
    assert host.params["detail"].grad is None


def test_a_picture_that_is_masked_in_place_has_the_gradients_of_what_is_left():
    def trained(mask):
        host, conductor, view, *_ = drawn()

        def render(name):
            with autograd.collected_drawings() as drawings:
                shot = host.render(getattr(view, name).camera, detail=name == "hr")
            return replace(shot, image=mask(shot.image), drawings=drawings)

        joint_loss(conductor, host.params, render("lr"), render("hr"), view, 5)[0].backward()
        return host.params

    def upper(image):
        image[len(image) // 2 :] = 0
        return image

    shown = {n: (torch.arange(n) < n // 2)[:, None, None] for n in (16, 64)}
    in_place, times = trained(upper), trained(lambda image: image * shown[len(image)])
    for name, p in times.items():
        torch.testing.assert_close(in_place[name].grad, p.grad, rtol=1e-4, atol=1e-9, msg=name)


def test_a_part_of_the_centres_and_colours_by_camera_are_refused_by_name():
    """As of gsplat's `info`: the screen gradient would be 0, and routing would take each camera for a Gaussian."""
    host, conductor, view, lr, hr = drawn(P2G(patch=4))
    conductor.on_fit_start(3, 0)
    with pytest.raises(HostError, match=r"lr is not computed from its means2d \[20, 2\], .* slot=ScreenGradientSlot\("):
        joint_loss(conductor, host.params, replace(lr, means2d=lr.means2d[:]), hr, view, 5)
    joint_loss(conductor, host.params, replace(lr, means2d=lr.means2d[:].detach()), hr, view, 5)
    named = host.activated(colors=torch.cat((host.params["sh0"], host.params["shN"]), 1)[None])
    with pytest.raises(HostError, match=r"colors of drawn must have a row for each of the 20 Gaussians, got \[1, 20, "):
        replace(hr, drawn={name: named[name] for name in ("means", "colors")})


def test_a_parameter_of_another_name_is_summed():
    host, conductor, view, *_ = drawn(GCO())
    tint = host.params["tint"] = torch.zeros(20, 3, requires_grad=True)
    lr, hr = host.draw(view.lr.camera, tint + 0), host.draw(view.hr.camera, tint + host.params["detail"])
    joint_loss(conductor, host.params, lr, hr, view, 5)[0].backward()
    torch.testing.assert_close(tint.grad, *gradients(conductor.objective, lr, hr, view, tint))


@pytest.mark.parametrize("drawn", ["lr", "hr", "a pose of no view"])
def test_a_rendering_of_another_view_than_the_one_that_is_passed_is_refused(drawn):
    scene = toy.scene(20)
    host, conductor = Host(scene), Conductor(objective=HR_FROM_START)
    view, other = scene.train[:2]
    conductor.on_fit_start(3, 0, views=scene.train)
    of = {"lr": view.lr, "hr": view.hr} | {drawn: other.hr if drawn == "hr" else other.lr}
    lr = host.render(toy.camera(1.2).scaled(0.25) if drawn == "a pose of no view" else of["lr"].camera, detail=False)
    hr = host.render(of["hr"].camera)
    message = f"{drawn} must be drawn by the camera of its view {view.name}, got that of {other.name}"
    with pytest.raises(ValueError, match=message) if drawn in ("lr", "hr") else nullcontext():
        joint_loss(conductor, host.params, lr, hr, view, 5)


def test_processes_that_average_its_gradients_train_the_same_field(tmp_path):
    code = "import sys; from tests.helpers import two_processes; two_processes.train(int(sys.argv[1]), sys.argv[2])"
    said = [tmp_path / name for name in ("first", "second")]
    both = [started("-c", code, str(k), f"{tmp_path}/group", cwd=tmp_path, said=said[k]) for k in range(2)]
    assert [process.wait() for process in both] == [0, 0], [file.read_text() for file in said]
