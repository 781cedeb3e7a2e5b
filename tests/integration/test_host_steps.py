"""A host's optimizers and gradient scaler: f_det and the extra views follow them, and a step without the strategies is told."""

import functools
import gc
import sys
import weakref
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, FadingOpacity, Objective
from clear_strategies.compose import conductor as composed_conductor
from clear_strategies.errors import SettingError
from clear_strategies.merging.detail import DetailRates
from clear_strategies.merging.skips import Skips
from clear_strategies.schedules import WarmupDecay
from integration import HostError
from integration.detail import DETAIL_EPS
from integration.gsplat import attach
from rasterizers import autograd
from tests.helpers import gsplat_host, toy
from tests.helpers.gsplat_host import Host, started
from tests.helpers.host_parts import HR_FROM_START, photometric
from tests.helpers.loops import ADAM, separate


@pytest.mark.parametrize("clips", [False, True])
def test_an_overflow_is_a_step_that_the_scaler_skips_for_f_det_too(clips, caplog):
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**14)
    conductor = Conductor(GCO(), objective=HR_FROM_START, detail=DetailRates(decay=0))
    host, _, render = started(conductor=conductor, loss_scale=scaler.get_scale)
    targets = [photo.image for photo in host.photos.values()]
    for i in range(4):
        before = host.splats["detail"].detach().clone()
        loss = photometric(render(i % 3)[0], targets[i % 3]) * (float("inf") if i == 2 else 1.0)
        for o in host.optimizers.values():
            o.zero_grad()
        scaler.scale(loss).backward()
        for o in host.optimizers.values():
            scaler.unscale_(o)
        if clips:
            torch.nn.utils.clip_grad_norm_([p for p in host.splats.values() if p.grad is not None], 1.0)
        for o in host.optimizers.values():
            scaler.step(o)
        scaler.update()
        assert torch.equal(host.splats["detail"], before) == (i == 2)
    assert "without an optimizer step" not in caplog.text
    assert all(bool(p.isfinite().all()) for p in host.splats.values())


@pytest.mark.parametrize("fused", [False, True])
def test_a_scaler_whose_scale_is_not_told_is_refused_before_the_first_step(fused):
    alone = started(conductor=Conductor(objective=Objective(lambda_hr=WarmupDecay(peak=0, final=0))))
    adds = started(GCO())
    for (host, _, render), enabled, scale in (
        (alone, True, 1024.0),
        (adds, False, 1024.0),
        (adds, True, 1.0),
        (adds, True, 1024.0),
    ):
        before = host.splats["means"].detach().clone()
        scaler = torch.amp.GradScaler("cpu", init_scale=scale, enabled=enabled)
        optimizer = torch.optim.Adam([p for p in host.splats.values() if p.requires_grad], lr=1e-2, fused=fused)
        host.optimizers.update(all=optimizer)
        scaler.scale(render().mean()).backward()
        message = r"multiplies its loss by 1024, but not what is added. Pass loss_scale="
        with pytest.raises(HostError, match=message) if host is adds[0] and scaler.get_scale() > 1 else nullcontext():
            scaler.step(optimizer)
        optimizer.zero_grad()
    assert torch.equal(host.splats["means"], before)


def test_extra_views_are_stepped_on_by_optimizers_that_are_made_anew_and_it_is_told_where_they_no_longer_are(caplog):
    host, clear, render = started(toy.ShowsDark())
    for i in range(20):
        if i == 3:
            host.optimizers.update(separate(host.splats))
        render(i % 3).mean().backward()
        host.step()
    assert clear.attachment.counts["extra views"] == 20
    unknown = torch.optim.Adam([p for p in host.splats.values() if p.requires_grad])
    assert "no effect" not in caplog.text
    for i in range(12):
        image = render(i % 3)
        unknown.zero_grad()
        image.mean().backward()
        unknown.step()
    assert caplog.text.count("put new ones in the same dictionary") == 1
    assert "without an optimizer step" not in caplog.text


def test_optimizers_that_are_none_of_torchs_step_without_hooks():
    host, clear, render = started(GCO())
    for name, o in host.optimizers.items():
        host.optimizers[name] = SimpleNamespace(step=o.step, zero_grad=o.zero_grad, param_groups=o.param_groups)
    for i in range(2):
        render(i).mean().backward()
        host.step()
    assert clear.attachment.counts["merges"] == clear.attachment.t == 2


def test_a_step_with_a_closure_that_renders_has_the_same_bits():
    """As in PyTorch Lightning, which gives each optimizer a closure, and wraps it in an object that holds it as `optimizer`."""

    def trained(gives_closure):
        host, clear, render = started(GCO(), SVS(), toy.ShowsDark())
        for name, o in host.optimizers.items() if gives_closure else ():
            inner = {"step": o.step, "zero_grad": o.zero_grad, "param_groups": o.param_groups}
            host.optimizers[name] = SimpleNamespace(optimizer=o, **inner)
        for i in range(4):

            def backward(i=i):
                render(i % 3).mean().backward()

            closures = [backward, *[lambda: None] * (len(host.optimizers) - 1)]
            for o, closure in zip(host.optimizers.values(), closures, strict=True):
                if gives_closure:
                    o.step(closure=closure)
                else:
                    closure()
                    o.step()
            for o in host.optimizers.values():
                o.zero_grad()
        return host.splats, clear.attachment.t, clear.attachment.counts

    (splats, *rest), (expected, *of_loop) = trained(True), trained(False)
    assert rest == of_loop
    assert all(torch.equal(p, expected[name]) for name, p in splats.items())


def test_an_optimizer_that_calls_its_closure_several_times_is_refused():
    _, clear, render = started()
    optimizer = torch.optim.LBFGS([clear.params()["means"]])
    clear.attachment.hook([optimizer])

    def closure():
        loss = render().mean()
        loss.backward()
        return loss

    with pytest.raises(HostError, match="LBFGS calls its closure several times in a step"):
        optimizer.step(closure)


@pytest.mark.parametrize("form", ["alone", "in a dictionary", "of the means alone"])
def test_f_det_is_a_group_of_the_only_optimizer_of_several_parameters_else_it_has_one_of_its_own(form):
    host = Host()
    only = torch.optim.Adam([host.splats["means"]] if form == "of the means alone" else [*host.splats.values()], **ADAM)
    optimizers = only if form == "alone" else {"first": only}
    attach(host.splats, optimizers, host.scene.train, Conductor())
    stepping = only if form == "alone" else optimizers["detail"]  # where gsplat's densifiers look for it
    assert (stepping is only) == (form != "of the means alone")
    group = stepping.param_groups[-1]
    assert [id(p) for p in group["params"]] == [id(host.splats["detail"])]
    assert group["eps"] == DETAIL_EPS


def test_f_det_is_no_group_of_an_optimizer_whose_scheduler_counts_the_groups():
    host = Host()
    only = torch.optim.Adam([*host.splats.values()], **ADAM)
    schedule = torch.optim.lr_scheduler.LambdaLR(only, lambda _: 1.0)
    with pytest.raises(SettingError, match=r"Make the scheduler after attach\(\)"):
        attach(host.splats, only, host.scene.train, Conductor())
    attach(host.splats, only, host.scene.train, Conductor(), detail=False)
    schedule.step()


def frozen(host, render):
    for p in host.splats.values():
        p.requires_grad_(False)


def asked(host, render):
    torch.autograd.grad(render().mean(), host.splats["means"])


def detached(host, render):
    kept = dict(host.splats)
    drawn = {name: p.detach() for name, p in kept.items()}
    gsplat_host.drawn(host.rasterization, drawn, host.photos["view0"].camera)


@pytest.mark.parametrize(
    ("does", "cause"),
    [
        (lambda host, render: None, "none of its renderings was recognised.*cameras that were passed.*the sum with"),
        (frozen, "all parameters of the Gaussians are frozen.*require gradients"),
        (asked, r"no backward\(\) has given means, quats.*view0.*by loss\.backward\(\)"),
        (detached, "the rendering of view0 does not depend on means, quats.*not detached"),
        (lambda host, render: render(), r"no backward\(\) has given means, quats"),
    ],
)  # fmt: skip
def test_a_step_without_a_strategy_is_refused_at_first_and_told_later_with_its_cause(does, cause, caplog):
    host, _, render = started()
    means = host.optimizers["means"]
    does(host, render)
    with pytest.raises(HostError, match=cause):
        means.step()
    host, clear, render = started()
    render().mean().backward()
    host.optimizers["means"].step()
    assert "no strategy takes part" not in caplog.text
    does(host, render)
    for _ in range(3):
        host.optimizers["means"].step()
    assert caplog.text.count("the host makes a step in which no strategy takes part") == 1
    assert clear.attachment.counts["steps of the host alone"] == 3


@pytest.mark.parametrize(("backwards", "accumulation", "told"), [(2, 1, 1), (1, 1, 0), (2, 2, 0), (3, 2, 1)])
def test_more_backward_passes_than_accumulation_names_are_told_once(backwards, accumulation, told, caplog):
    """Each would bring the whole HR gradient."""
    host = Host(accumulation=backwards)
    started(host=host, conductor=Conductor(), accumulation=accumulation)
    host.train(["view0"] * 3 * backwards)
    assert caplog.text.count(f"but accumulation={accumulation}. If the loop divides each loss") == told


class Descent:
    """An optimizer that is not derived from torch's."""

    def __init__(self, params):
        self.param_groups = [{"params": [*params]}]


@pytest.mark.parametrize(
    ("optimizers", "rule"),
    [
        (lambda host: [*host.optimizers.values()], "must be a dict of optimizers or one of torch's, got list"),
        (lambda host: {"all": Descent(host.splats.values())}, "Descent has no add_param_group"),
    ],
)
def test_optimizers_that_f_det_cannot_join_are_refused(optimizers, rule):
    host = Host()
    with pytest.raises(SettingError, match=rule):
        attach(host.splats, optimizers(host), host.scene.train, Conductor())


def test_a_step_begins_after_each_merge_whichever_optimizers_take_part():
    host, clear, render = started()
    for name in ("means", "scales"):
        render().mean().backward()
        host.optimizers[name].step()
    assert clear.attachment.counts["steps of the host alone"] == 0
    host.optimizers["scales"].step()
    assert clear.attachment.counts["steps of the host alone"] == 1
    host.optimizers.update(separate(host.splats))
    render()  # and no pass
    for optimizer in host.optimizers.values():
        optimizer.step()
    assert clear.attachment.counts["steps of the host alone"] == 2


def test_hooks_that_run_after_accumulation_change_the_merged_gradient():
    """Of a hook on the gradient itself, each scale is an argument."""
    gradients = []

    def limit(p):
        p.grad.clamp_(-1e-3, 1e-3)

    for late in (False, True):
        host, _, render = started(toy.Recorder())
        for p in host.splats.values():
            if p.requires_grad and late:
                p.register_post_accumulate_grad_hook(limit)
        for _ in range(2):  # the hooks are still there in the second step
            host.optimizers["means"].zero_grad()
            render().mean().backward()
            if not late:
                limit(host.splats["means"])
        gradients.append(host.splats["means"].grad)
    assert float(gradients[0].abs().max()) == pytest.approx(1e-3)
    assert torch.equal(*gradients)
    host.optimizers["means"].zero_grad()
    (1e3 * host.splats["means"].sum()).backward()  # a pass without a rendering
    assert float(host.splats["means"].grad.abs().max()) == pytest.approx(1e-3)


def test_a_hook_after_accumulation_of_what_colours_are_computed_from_gets_the_gradient_of_both_scales():
    scene, offset, found = toy.scene(20), torch.nn.Parameter(torch.zeros(1, 1, 3)), []
    host, _, _ = started(scene=scene)
    offset.register_post_accumulate_grad_hook(lambda p: found.append(p.grad.clone()))
    splats = host.splats | {"sh0": host.splats["sh0"] + offset}
    gsplat_host.drawn(host.rasterization, splats, scene.train[0].lr.camera)[0].mean().backward()
    (g,) = found
    assert torch.equal(g, offset.grad)


@pytest.mark.parametrize("late", [False, True])
def test_hooks_that_freeze_some_gaussians_freeze_their_f_det(late):
    host, _, render = started()
    for p in host.splats.values():
        shown = torch.ones(20, *[1] * (p.dim() - 1))
        shown[:5] = 0
        if p.requires_grad and late:
            p.register_post_accumulate_grad_hook(lambda p, shown=shown: p.grad.mul_(shown))
        elif p.requires_grad:
            p.register_hook(lambda g, shown=shown: g * shown)
    before = {name: p.detach().clone() for name, p in host.splats.items()}
    for i in range(2):
        render(i).mean().backward()
        host.step()
    assert all(torch.equal(p[:5], before[name][:5]) for name, p in host.splats.items())
    assert bool((host.splats["detail"][5:] != 0).any())


@pytest.mark.parametrize("frozen", [0, 5])
def test_a_loop_that_freezes_gaussians_by_their_gradients_is_told(frozen, caplog):
    host, _, render = started()
    for _ in range(2):
        render().mean().backward()
        host.splats["means"].grad[:frozen] = 0
        host.step()
    assert caplog.text.count("to 0 before it steps") == (frozen > 0)


@pytest.mark.parametrize("how", ["a pass is dropped", "sparse", "without f_det"])
def test_a_loop_that_freezes_no_gaussian_that_would_change_is_not_told(how, caplog):
    """A gradient scaler drops the first passes, and another view sees other Gaussians; gsplat's loop makes gradients sparse."""
    host = gsplat_host.Host()
    means = host.splats["means"]
    if how == "sparse":
        host.optimizers["means"] = torch.optim.SparseAdam([means])
    _, _, render = started(GCO(), host=host, detail=how != "without f_det")
    render().mean().backward()
    if how == "a pass is dropped":
        for optimizer in host.optimizers.values():
            optimizer.zero_grad()
        means.data[:5] += 1000
        render().mean().backward()
    elif how == "sparse":
        means.grad = means.grad.to_sparse(1)
    else:
        means.grad[:5] = 0
    host.step()
    assert "to 0 before it steps" not in caplog.text


def test_a_hook_after_accumulation_is_called_once_where_the_loss_reaches_f_det_too():
    host, _, render = started()
    found = []
    host.splats["detail"].register_post_accumulate_grad_hook(lambda p: found.append(p.grad.clone()))
    regularizer = (host.splats["detail"] + 1).sum()
    (regularizer + render().mean()).backward()
    (g,) = found
    assert torch.equal(g, host.splats["detail"].grad)
    assert bool((g != 1).any())


def test_a_loop_that_trains_a_copy_of_what_was_attached_is_told_once(caplog):
    host, clear, render = started()
    render().mean().backward()
    host.step()
    clear.attachment.hook([])  # as the optimizers of the copy have no hooks
    copies = {name: torch.nn.Parameter(p.detach().clone()) for name, p in host.splats.items()}
    for _ in range(14):
        gsplat_host.drawn(host.rasterization, copies, host.photos["view0"].camera)[0].mean().backward()
    assert caplog.text.count("no part in the last 10 renderings of training views: no backward() has given means") == 1


@pytest.mark.parametrize(("factor", "loss_scale", "told"), [(1024, None, 1), (1024, lambda: 1024.0, 0), (1, None, 0)])
def test_a_loss_of_another_scale_than_that_of_hr_is_told_once(factor, loss_scale, told, caplog):
    host, _, render = started(loss_scale=loss_scale)
    for i in range(12):
        (factor * photometric(render(i % 3)[0], host.photos[f"view{(0, 2, 3)[i % 3]}"].image)).backward()
        host.step()
    assert caplog.text.count("times those of HR, which then has no effect") == told


@pytest.mark.parametrize("another_has_stepped", [False, True])
def test_a_step_inside_of_the_backward_pass_is_refused(another_has_stepped):
    host, _, render = started()
    if another_has_stepped:
        render().mean().backward()
        host.optimizers["means"].step()
    image = render()
    if another_has_stepped:
        image.register_hook(lambda g: host.optimizers["quats"].step() and None)
    else:
        host.splats["means"].register_post_accumulate_grad_hook(lambda p: host.optimizers["means"].step())
    with pytest.raises(HostError, match=r"steps inside of its backward pass"):
        image.mean().backward()


@pytest.mark.parametrize("accumulation", [1, 2])
def test_the_densifier_reads_a_score_that_has_the_scale_of_its_own_gradients(accumulation):
    """As `unscale_` and its mean over the passes expect it."""
    read = []
    for scale, passes in ((1.0, 1), (64.0, accumulation)):
        strategy, settings = SimpleNamespace(refine_stop_iter=0, grow_grad2d=1e-4), {"accumulation": passes}
        host, clear, _ = started(P2G(patch=4), strategy=strategy, loss_scale=lambda scale=scale: scale, **settings)
        photo = host.photos["view0"]
        renders, _, info = host.render(photo.camera, 3)
        (scale / passes * photometric(renders[0], photo.image)).backward()
        assert clear.attachment.counts["scores written"] == 1
        read.append(info["means2d"].grad * passes / scale)
    assert bool(read[0].any())
    assert torch.allclose(*read, rtol=1e-5, atol=0)


@pytest.mark.parametrize("set_to_none", [True, False])
def test_an_iteration_ends_with_the_hosts_step_whatever_became_of_its_passes(set_to_none):
    host, clear, render = started(toy.ShowsDark(), accumulation=2)

    def ends(passes, *, steps, t):
        for i in range(passes):
            render(i).mean().backward()
            assert clear.attachment.t == t
        for optimizer in host.optimizers.values():
            if steps:
                optimizer.step()
            optimizer.zero_grad(set_to_none=set_to_none)

    ends(2, steps=True, t=1)
    ends(1, steps=False, t=2)  # the other ran out of memory, and the loop goes on
    ends(2, steps=True, t=2)
    ends(1, steps=True, t=3)  # what is left of an epoch
    ends(2, steps=False, t=4)  # a gradient scaler skips the step
    ends(2, steps=True, t=5)
    assert clear.attachment.t == 6
    assert clear.attachment.counts["extra views"] == 4
    render(0).mean().backward()
    host.optimizers["means"].step()  # it alone; then all are made anew
    for optimizer in host.optimizers.values():
        optimizer.zero_grad(set_to_none=set_to_none)
    host.optimizers.update(separate(host.splats))
    render(0)
    assert clear.attachment.t == 7


def test_a_step_of_sam_is_one_iteration_and_one_of_summed_views_is_several():
    """Neither names an accumulation. In each step f_det has the gradient of its passes, and the extra views one step."""

    def trained(steps, **settings):
        host, clear, render = started(toy.ShowsDark(), **settings)
        for passes in steps:
            for i in passes:
                if i == "look":
                    render(0)
                elif i == "ascend":  # SAM steps with the gradient at a point near by, taken by another optimizer
                    for name, g in host.gradients().items():
                        host.splats[name].data.add_(g, alpha=1e-3)
                        host.splats[name].grad = None
                else:
                    render(i).mean().backward()
            found = host.splats["detail"].grad.clone()
            host.step()
        return clear.attachment.t, clear.attachment.counts["extra views"], found

    assert trained([(0, "ascend", 0), (1, "ascend", 1)])[:2] == (3, 2)
    t, extra, found = trained([(0,), (1, "look", "look", 2, 2, 0)])  # drawn with replacement
    assert (t, extra) == (6, 2)
    *_, expected = trained([(0,), (1, 2, 2, 0)], accumulation=4)
    torch.testing.assert_close(found, 4 * expected)


@pytest.mark.parametrize("optimizers", [True, False])
def test_a_loop_that_steps_by_hand_over_one_view_goes_on(optimizers):
    """The first pass alone may be that of SAM, whose step is still to come."""

    def begun():
        host = Host()
        host.optimizers = host.optimizers if optimizers else {}
        return started(host=host)

    host, clear, render = begun()
    for i in range(6):
        if i == 3:  # resumed
            state = clear.attachment.state_dict()
            host, clear, render = begun()
            clear.attachment.load_state_dict(state)
        render().mean().backward()
        for name, p in host.splats.items():
            p.grad = p.grad if name == "detail" else None
    assert clear.attachment.t == 5


def test_a_step_of_sam_whose_passes_reach_each_parameter_apart_is_one_iteration():
    host, clear, render = started(conductor=Conductor(objective=HR_FROM_START))
    for _ in range(2):
        loss = render(0).mean()
        loss.backward(inputs=[host.splats["means"]], retain_graph=True)
        loss.backward(inputs=[host.splats["scales"], host.splats["opacities"]])
        for name, p in host.splats.items():
            p.grad = p.grad if name == "detail" else None
    assert clear.attachment.t == 1


def test_a_gradient_penalty_from_the_merged_gradient_is_told_once_to_have_no_effect(caplog):
    host, _, render = started()
    for _ in range(2):
        render().mean().backward(create_graph=True)
        assert not any(g.requires_grad for g in host.gradients().values())
    assert caplog.text.count("a gradient penalty that is computed from .grad has no effect") == 1


def test_a_loop_resumes_between_the_passes_of_a_step_with_the_same_bits():
    def trained(pauses):
        loop = host, clear, render = started(toy.ShowsDark(), accumulation=2)
        host.splats["detail"].data += 1.0
        for i in range(4):
            if i in pauses:
                earlier, (host, clear, render) = loop, started(toy.ShowsDark(), accumulation=2)
                for name, p in host.splats.items():
                    before = earlier[0].splats[name]
                    p.data, p.grad = before.data, before.grad
                    if name in host.optimizers:
                        host.optimizers[name].load_state_dict(earlier[0].optimizers[name].state_dict())
                clear.attachment.load_state_dict(earlier[1].attachment.state_dict())
                loop = host, clear, render
            render(i % 3).mean().backward()
            if i % 2:
                host.step()
        return host.splats

    whole, resumed = trained(()), trained((1, 2, 3))
    assert not [name for name, p in whole.items() if not torch.equal(p, resumed[name])]


@pytest.mark.parametrize("passes", [1, 2])
@pytest.mark.parametrize("decay", [0.0, 0.5])
def test_f_det_fades_with_a_step_and_not_with_passes_that_the_loop_drops(decay, passes):
    conductor = Conductor(objective=HR_FROM_START, detail=DetailRates(decay=decay))
    host, _, render = started(conductor=conductor, accumulation=passes)
    host.splats["detail"].data += 1.0
    host.optimizers["detail"].param_groups[0]["lr"] = 0.0

    def share_after(n, *, steps):
        before = float(host.splats["detail"].mean())
        for i in range(n):
            render(i).mean().backward()
        for optimizer in host.optimizers.values():
            if steps:
                optimizer.step()
            optimizer.zero_grad()
        return float(host.splats["detail"].mean()) / before

    assert share_after(1, steps=False) == 1  # where there is another, it ran out of memory
    assert share_after(passes, steps=False) == 1  # a gradient scaler skips the step
    assert share_after(passes, steps=True) == (1 - decay / passes) ** passes
    assert share_after(1, steps=True) == 1 - decay / passes


@pytest.mark.parametrize(
    ("threshold", "anchor_start", "with_hr"),
    [(None, 100, [1, 3, 5]), (1e-4, 100, [1, 2, 3, 4, 5, 6]), (1e-4, 4, [1, 2, 3, 5])],
)
def test_hr_is_left_out_of_every_second_step_but_where_a_densifier_reads_its_score(threshold, anchor_start, with_hr):
    """It has half its size then."""
    widths, logs = set(), []

    @functools.wraps(autograd.rasterization)
    def recorded(**call):
        widths.add(call["width"])
        return gsplat_host.rasterization(**call)

    host = Host(rasterization=recorded)
    strategies = P2G(patch=4), SVS(anchor_start=anchor_start)
    conductor = Conductor(*strategies, objective=HR_FROM_START, skips=Skips(coarse_until=100, hr_every=2))
    strategy = SimpleNamespace(refine_stop_iter=0, grow_grad2d=threshold)
    _, clear, _ = started(host=host, conductor=conductor, strategy=strategy)
    host.train([*host.photos] * 2, between=lambda: logs.append(clear.attachment.log))
    assert [int(log["t"]) for log in logs if "mean_q" in log] == with_hr
    assert clear.attachment.counts["HR renders"] == len(with_hr)
    assert clear.attachment.counts["merges"] == 6
    assert widths == {24, 48}


def test_a_densifier_without_a_threshold_needs_no_hr_before_the_gradient_does(caplog):
    caplog.set_level("INFO")
    late = WarmupDecay(peak=0, start=0, full=0, decay_from=4, end=4)
    conductor = Conductor(
        P2G(patch=4), objective=Objective(lambda_hr=late), statistics_from=0, skips=Skips(coarse_until=3)
    )
    host, clear, _ = started(conductor=conductor)
    assert "HR takes part after step 4" in caplog.text
    assert "skips.coarse_until has no effect" in caplog.text
    host.train([*host.photos] * 2)
    assert (clear.attachment.counts["merges"], clear.attachment.counts["HR renders"]) == (6, 2)


@pytest.mark.parametrize("fails", ["by itself", "before it is removed"])
def test_a_loop_that_an_error_ends_is_not_told_of_its_length(fails, caplog, monkeypatch):
    gc.collect()  # of earlier tests, whose attachments tell it when they are freed
    caplog.clear()
    host, clear, _ = started(conductor=composed_conductor("gco"))

    def end():
        try:
            raise ValueError("of the loop")
        finally:
            if fails == "before it is removed":
                clear.remove()

    with pytest.raises(ValueError, match="of the loop"):
        host.train(["view0"], between=end)
    monkeypatch.setattr(sys, "last_value", ValueError(), raising=False)  # as Python does at the end of a program
    clear.remove()
    assert clear.attachment.counts["merges"] == 1
    assert "HR took no part" not in caplog.text


def test_what_an_earlier_error_holds_is_freed():
    """As in a notebook, whose user attaches again after a cell ran out of memory."""

    class Failed(Exception):
        pass

    try:
        raise Failed
    except Failed as error:
        held = weakref.ref(error)
        _, clear, _ = started(conductor=composed_conductor("gco"))
    gc.collect()
    assert held() is None
    clear.remove()


def test_a_loop_that_ends_before_hr_takes_part_is_told(caplog):
    caplog.set_level("INFO")
    host, clear, _ = started(conductor=composed_conductor("gco"), iterations=120)
    assert "HR takes part after step 500" in caplog.text
    assert "500, but the loop has 120 steps. Make the conductor for the length of the loop" in caplog.text
    host.train(host.photos)
    clear.remove()
    assert "HR took no part in the 3 steps of this loop: it would after step 500" in caplog.text
    caplog.clear()
    started(conductor=composed_conductor("gco", iterations=120), iterations=120)
    assert "HR takes part after step 6" in caplog.text
    assert "the loop has" not in caplog.text


@pytest.mark.parametrize("factor", [1, 4])
def test_a_loop_without_hr_is_told_of_no_work_on_it(factor, caplog):
    gc.collect()  # attachments of other tests speak when they end
    caplog.set_level("INFO")
    scene = toy.scene(20)
    views = [replace(view, hr=view.hr.reduced(view.factor // factor)) for view in scene.train]
    for strategies, said in [
        ("baseline", ["no strategy is attached: the host trains as alone."]),
        ("fading_opacity", []),
    ]:
        host = Host(scene)
        caplog.clear()
        attach(host.splats, host.optimizers, views, composed_conductor(strategies, "objective=lr_only", iterations=120))
        assert [text for text in caplog.messages if not text.startswith("FadingOpacity: ")] == said
    host = Host(scene)
    attach(host.splats, host.optimizers, views, composed_conductor("gco", iterations=120))
    assert ("SR images are halved only where factor is even" in caplog.text) == (factor == 1)
    assert ("Skipped: HR at half its size" in caplog.text) == (factor == 4)


@pytest.mark.parametrize("activation", [torch.nn.functional.softplus, torch.sigmoid])
def test_what_a_loop_computes_before_it_renders_is_of_what_strategies_have_left(activation):
    """A regularizer, or an activation: `after_step` comes with the step, not with the next rendering."""
    host, clear, _ = started(FadingOpacity(rate=0.1))
    p, seen = host.splats, []
    for _ in range(3):
        opacities = activation(p["opacities"]).clamp(max=0.99)
        regularizer = p["opacities"].square().mean()
        seen.append(p["opacities"].detach().clone())
        camera = host.photos["view0"].camera
        image = gsplat_host.drawn(
            lambda m, q, s, _, *more, o=opacities, **call: host.rasterization(m, q, s, o, *more, **call), p, camera
        )[0]
        (image.mean() + 0 * regularizer).backward()
        faded = p["opacities"].detach().clone()
        host.step()
        assert torch.equal(seen[-1], faded)
        assert float((p["opacities"] - faded).max()) < -0.05  # a tenth of the opacity, and Adam's step
    assert clear.attachment.t == 4
    clear.remove()


@pytest.mark.parametrize("step", [0, 1])
def test_parameters_that_are_frozen_before_a_step_stay_as_they_are(step):
    """Before the second, Adam's moments would move them on an extra view."""
    host, clear, render = started(FadingOpacity(rate=0.1), GCO(), toy.ShowsDark())
    for i in range(step + 3):
        if i == step:
            before = {name: host.splats[name].detach().clone() for name in ("means", "opacities", "detail")}
            for name in before:
                host.splats[name].requires_grad_(False)
        render(i % 3).mean().backward()
        host.step()
    assert not [name for name, x in before.items() if not torch.equal(x, host.splats[name])]
    clear.remove()


def test_gradients_in_autocast_are_those_outside_of_it():
    def merged(context):
        host, clear, render = started(GCO(), P2G())
        with context:
            render().mean().backward()
        clear.remove()
        return host.gradients()

    expected, found = merged(nullcontext()), merged(torch.autocast("cpu", torch.bfloat16))
    for name, g in expected.items():
        torch.testing.assert_close(found[name], g, rtol=1e-5, atol=1e-9)
