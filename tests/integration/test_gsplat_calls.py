"""Calls of a wrapped `rasterization`: which one is the rendering of a photo, and what else a loop draws beside it."""

import functools
from contextlib import ContextDecorator, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from torch.utils.checkpoint import checkpoint

import rasterizers
from clear_strategies import GCO, P2G, SVS, Conductor, PseudoViews, RandomBackground, Strategy, View
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.schedules import Ramp
from integration import HostError
from integration.gsplat import calls
from integration.gsplat.calls import Poses
from integration.gsplat.rows import ROWS
from integration.host_merge import HostMerge
from rasterizers import as_gsplat, autograd
from rasterizers.geometry import SH_C0
from tests.helpers import gsplat_host, toy
from tests.helpers.backends import needs
from tests.helpers.gsplat_host import Host, started
from tests.helpers.host_parts import HR_FROM_START, WITHOUT_HR, photometric
from tests.helpers.loops import FUNCTIONS, Loop, Running, pictures, scene
from tests.training.test_replayed_iteration import cropped


def features(function, host, colors):
    p, camera = host.splats, host.photos["view0"].camera
    view = camera.world_to_camera[None], intrinsics(camera)[None], camera.width, camera.height
    return function(p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), colors, *view)[0]


@pytest.mark.parametrize("named", [True, False])
@pytest.mark.parametrize("grad", [True, False])
def test_normals_beside_the_photo_have_no_detail_feature(named, grad):
    host, clear, render = started(P2G(patch=4))
    host.splats["detail"].data += 0.2
    render().mean().backward()
    normals = torch.nn.functional.normalize(host.splats["means"].detach())
    with clear.rendering(None) if named else nullcontext(), torch.set_grad_enabled(grad):
        image = features(host.rasterization, host, normals)
    assert torch.equal(image, features(gsplat_host.rasterization, host, normals))
    assert clear.attachment.counts["LR renders"] == 1


def test_hr_has_what_a_partial_presets():
    given = {"rasterize_mode": "antialiased", "eps2d": 3.0}
    found = []
    for preset, named in ((given, {}), ({}, given)):
        function = functools.partial(rasterizers.rasterization, backend="torch", **preset)
        host, _, render = started(P2G(patch=4), host=Host(rasterization=function), hr_by="torch")
        render(**named).mean().backward()
        found.append([host.splats[name].grad for name in ("means", "scales", "sh0", "opacities")])
    assert all(map(torch.equal, *found))


def test_a_function_that_may_draw_more_than_its_arguments_say():
    ours = rasterizers.rasterization

    class Traced(ContextDecorator, nullcontext):
        """As gsplat 1.6 decorates its function."""

    @functools.wraps(ours)
    def brighter(*args, **kwargs):
        image, *rest = ours(*args, **kwargs)
        return (1.1 * image, *rest)

    assert calls.draws_its_arguments(ours)
    assert calls.draws_its_arguments(functools.partial(ours, backend="torch"))
    assert calls.draws_its_arguments(Traced()(ours))
    assert not calls.draws_its_arguments(brighter)
    assert not calls.draws_its_arguments(Traced()(brighter))


def test_a_depth_pass_is_part_of_its_step_and_colours_without_spherical_harmonics_have_the_detail_feature():
    _, clear, render = started(P2G(patch=4))
    (render().mean() + render(render_mode="ED").mean()).backward()
    assert clear.attachment.counts["LR renders"] == clear.attachment.counts["merges"] == 1
    host, _, _ = started()
    host.splats["detail"].data += 0.2
    colors = torch.rand(20, 3)
    with torch.no_grad():
        image = features(host.rasterization, host, colors)
        assert torch.equal(image, features(gsplat_host.rasterization, host, colors + host.splats["detail"]))


@pytest.mark.parametrize("degree", [3, None])
@pytest.mark.parametrize("function", FUNCTIONS)
def test_the_colours_of_the_only_camera_have_the_gradients_of_those_by_gaussian(function, degree):
    def gradients(form):
        running = Running(Loop(function=function))
        p = running.splats
        colors = torch.cat((p["sh0"], p["shN"]), 1) if degree else 0.5 + p["sh0"][:, 0]
        c, photo = (photo := scene().train[0].lr).camera, photo.image
        view = c.world_to_camera[None], intrinsics(c)[None], c.width, c.height
        activated = p["scales"].exp(), p["opacities"].sigmoid(), form(colors)
        photometric(
            running.function(p["means"], p["quats"], *activated, *view, sh_degree=degree)[0][0], photo
        ).backward()
        return {name: x.grad for name, x in p.items() if x.grad is not None}

    found, expected = gradients(lambda colors: colors[None]), gradients(lambda colors: colors)
    assert found.keys() == expected.keys()
    for name, g in expected.items():
        torch.testing.assert_close(found[name], g, rtol=1e-3, atol=1e-9, msg=name)


def test_a_function_of_ones_own_may_have_the_degree_as_its_default():
    def drawn(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree=3, **more):
        view = viewmats, Ks, width, height
        return gsplat_host.rasterization(means, quats, scales, opacities, colors, *view, sh_degree=sh_degree, **more)

    host = Host(scene(), rasterization=drawn)
    clear = gsplat_host.attached(host, scene(), Conductor(objective=HR_FROM_START), detail=False)
    p, c = host.splats, scene().train[0].lr.camera
    colors, view = torch.cat((p["sh0"], p["shN"]), 1), (c.world_to_camera[None], intrinsics(c)[None], c.width, c.height)
    activated = p["scales"].exp(), p["opacities"].sigmoid(), colors
    host.rasterization(p["means"], p["quats"], *activated, *view)[0].mean().backward()
    assert clear.attachment.counts["merges"] == 1


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_loop_that_trains_what_follows_the_picture_may_freeze_all_gaussians(function):
    running, gain = Running(Loop(function=function)), torch.nn.Parameter(torch.ones(3))
    for p in running.splats.values():
        p.requires_grad_(False)
    image = pictures(running.loop, running.function, running.tensors(), [])(scene().train[0].lr)[0][0]
    (image * gain).mean().backward()
    torch.testing.assert_close(gain.grad, image.mean((0, 1)) / 3)


def learned(running, function):
    """The gradients of a step that draws by this function in the loop's place."""
    photo = scene().train[0].lr
    image = pictures(running.loop, running.clear.wrap(function), running.tensors(), [])(photo)[0]
    image[0].mul_(0.9)  # a loop may write to what it gets
    photometric(image[0], photo.image).backward()
    return {name: p.grad for name, p in running.tensors().items() if p.grad is not None}


def require_same(found, expected, caplog):
    assert found.keys() == expected.keys() >= {"gain"}
    for name, g in expected.items():
        torch.testing.assert_close(found[name], g, rtol=1e-3, atol=1e-6 * float(g.abs().max()), msg=name)
    assert "learn from LR alone" not in caplog.text


PICTURES = {
    "masked in place": (lambda draw: draw().mul_(0.5), lambda draw: 0.5 * draw()),
    "drawn twice": (lambda draw: 0.5 * draw() + 0.5 * draw(), lambda draw: draw()),
}


@pytest.mark.parametrize("made", PICTURES)
def test_colours_of_the_means_count_once_and_a_gain_learns_from_hr_where_no_single_drawing_is_the_picture(made, caplog):
    """By a function of the loop's own around this package's."""

    def gradients(picture):
        @functools.wraps(autograd.rasterization)
        def drawn(*args, **call):
            found = []
            image = picture(lambda: found.append(autograd.rasterization(*args, **call)) or found[-1][0])
            return image, *found[-1][1:]

        return learned(Running(Loop(colours="by the means", opacities="faded")), drawn)

    require_same(*map(gradients, PICTURES[made]), caplog)


@needs("cpp")
@pytest.mark.parametrize("given", ["sigmoid", "detached"])
def test_parameters_and_a_gain_that_the_function_itself_reads_learn_from_both_scales(given, caplog):
    def gradients(given, read):
        running = Running(Loop(function="another", opacities=given))

        def drawn(means, quats, scales, opacities, colors, viewmats, Ks, width, height, **call):
            view, made = (viewmats, Ks, width, height), read(running.tensors(), opacities)
            renders, _, info = FUNCTIONS["another"](means, quats, scales, made, colors, *view, **call)
            return renders, None, info  # not every function has alphas

        return learned(running, drawn)

    expected = gradients("faded", lambda p, opacities: opacities)
    found = gradients(given, lambda p, opacities: p["opacities"].sigmoid() * p["gain"])
    require_same(found, expected, caplog)


@pytest.mark.parametrize("name", [ROWS, "detail"])
def test_params_without_what_attach_has_added_are_refused(name):
    host, clear, render = started()
    del host.splats[name]
    with pytest.raises(HostError, match=f"params have lost {name}, which attach added"):
        render()
    clear.remove()
    assert "means" in clear.params()


def test_a_transform_of_torch_func_is_refused_by_name_in_a_loop():
    host, _, _ = started()

    def brightness(means):
        return gsplat_host.drawn(host.rasterization, {**host.splats, "means": means}, host.photos["view0"].camera)[
            0
        ].mean()

    with pytest.raises(NotImplementedError, match=r"the transforms of torch\.func"):
        torch.func.grad(brightness)(host.splats["means"].detach())


def test_a_photo_of_a_part_of_the_gaussians_is_refused():
    host, _, _ = started()
    part = {name: p[:7] for name, p in host.splats.items()}
    with pytest.raises(HostError, match="view0 is rendered with 7 of 20 Gaussians"):
        gsplat_host.drawn(host.rasterization, part, host.photos["view0"].camera)


def beside(*offsets):
    """The pose of a photo, and views whose cameras are moved from there, along x."""
    view, views = toy.scene(20).train[0], []
    for i, x in enumerate(offsets):
        pose = view.lr.camera.world_to_camera.clone()
        pose[0, 3] += x
        lr, hr = (replace(p, camera=replace(p.camera, world_to_camera=pose)) for p in (view.lr, view.hr))
        views.append(View(f"frame{i}", lr, hr))
    return view.lr.camera.world_to_camera, views


@pytest.mark.parametrize(
    ("origin", "step"), [(0.0, 5e-4), (3e5, 0.5)], ids=["near the origin", "in coordinates of a map"]
)
def test_cameras_that_lie_close_together_are_told_apart(origin, step):
    _, views = beside(*(origin + i * step for i in range(3)))
    poses = Poses(views)
    for view in views:
        rounded = torch.linalg.inv(torch.linalg.inv(view.lr.camera.world_to_camera))[None]
        assert poses.find(rounded) is view


def test_a_step_reads_its_camera_in_one_transfer(monkeypatch):
    """Of a device; what is drawn is then known on the CPU."""
    _, _, render = started(P2G(patch=4), hr_by="torch")
    read, cpu = [], torch.Tensor.cpu
    monkeypatch.setattr(torch.Tensor, "cpu", lambda x: read.append(x.numel()) or cpu(x))
    render().mean().backward()
    assert [n for n in read if n <= 16 + 9] == [16 + 9]  # others are of pictures
    call = {"viewmats": torch.rand(1, 4, 4), "Ks": torch.rand(1, 3, 3, dtype=torch.float64)}
    for name, x in calls.cameras_read(call).items():
        assert torch.equal(x, call[name])
        assert x.dtype == call[name].dtype


def test_a_step_reads_its_cameras_once(monkeypatch):
    """From a device, each read waits for what was launched before."""
    read, cameras_read, asked, cameras_of = [], calls.cameras_read, [], as_gsplat.cameras_of
    monkeypatch.setattr(calls, "cameras_read", lambda call: read.append(cameras_read(call)) or read[-1])
    monkeypatch.setattr(as_gsplat, "cameras_of", lambda poses, *more: asked.append(poses) or cameras_of(poses, *more))
    _, _, render = started()
    render()
    (cameras,) = read
    assert len(asked) == 2  # HR and LR
    assert all(poses is cameras["viewmats"] for poses in asked)


@pytest.mark.parametrize(("ratio", "found"), [(8, False), (12, True)])
def test_the_nearest_camera_is_the_one_that_is_rendered_if_the_next_is_ten_times_as_far(ratio, found):
    """Poses that a loop optimizes or adds noise to lie beside those of the photos."""
    pose, views = beside(1e-5, -ratio * 1e-5)
    with nullcontext() if found else pytest.raises(HostError, match="frame0 and frame1 have the same pose"):
        assert Poses(views).find(pose[None]) is views[0]


def test_a_pose_that_is_rounded_to_bfloat16_is_refused():
    pose, views = beside(1e-5)
    with pytest.raises(HostError, match="viewmats must be float32 or float64, got bfloat16"):
        Poses(views).find(pose[None].bfloat16())


def test_other_intrinsics_than_those_of_the_photo_are_refused_unless_the_view_is_named():
    host, clear, _ = started()
    view = clear.views[0]
    shifted = replace(view.lr.camera, cx=view.lr.camera.cx + 1)
    with clear.rendering(view):
        gsplat_host.drawn(host.rasterization, host.splats, shifted)
    with torch.no_grad():
        gsplat_host.drawn(host.rasterization, host.splats, shifted)
    with pytest.raises(HostError, match=r"view0 is rendered with .*cx=13, .*its photo has .*cx=12, .*view\(\) the K"):
        gsplat_host.drawn(host.rasterization, host.splats, shifted)


@pytest.mark.parametrize("by_name", [False, True])
def test_the_detail_feature_is_trained_in_a_loop_that_tells_every_optimizer_what_is_visible(by_name):
    host, _, render = started()
    render(0).mean().backward()
    visibility = torch.zeros(20, dtype=torch.bool)
    host.optimizers["detail"].step(visibility=visibility) if by_name else host.optimizers["detail"].step(visibility)
    assert float(host.splats["detail"].detach().abs().max()) > 0


def test_the_gradient_of_the_colours_comes_by_its_factors_but_where_a_hook_looks_at_it(monkeypatch):
    """The second pass has gradients of the first, which are not zeroed."""
    by_factors, seen, merge_gradients = [], [], HostMerge.merge_gradients

    def spied(self, done, *arguments):
        by_factors.append(done.colour is not None)
        return merge_gradients(self, done, *arguments)

    monkeypatch.setattr(HostMerge, "merge_gradients", spied)
    for hooked in (False, True):
        host, _, render = started()
        if hooked:
            host.splats["shN"].register_hook(seen.append)
        for i in range(2):
            render(i).mean().backward()
    assert by_factors == [True, True, False, False]
    assert len(seen) == 4  # of LR and of HR


@pytest.mark.parametrize("named", [True, False], ids=["named as of no photo", "by the function that was wrapped"])
def test_a_second_pass_stands_beside_the_photo(named):
    host, clear, render = started()
    with pytest.raises(HostError, match="its __wrapped__"):
        (render().mean() + render().mean()).backward()
    first = render()
    if not named:
        host.rasterization = host.rasterization.__wrapped__
    with clear.rendering(None) if named else nullcontext():
        second = render()
    (first.mean() + second.mean()).backward()
    assert clear.attachment.counts["merges"] == 1


def test_a_compiled_loop_has_the_same_gradients(recwarn):
    """`torch.compile` breaks its graph where the loop draws, at either scale."""
    gradients = []
    cameras = [view.lr.camera for view in toy.scene(20).train]
    viewmats, Ks = (torch.stack([f(c).float() for c in cameras]) for f in (lambda c: c.world_to_camera, intrinsics))
    for compiled in (False, True):
        host, clear, _ = started()
        p, draw = host.splats, host.rasterization

        def loss(i, p=p, draw=draw):
            activated = p["scales"].exp(), p["opacities"].sigmoid(), torch.cat([p["sh0"], p["shN"]], 1)
            image = draw(p["means"], p["quats"], *activated, viewmats[i, None], Ks[i, None], 24, 16, sh_degree=3)[0]
            return (image * 2).sigmoid().mean()

        loss = torch.compile(loss, backend="eager") if compiled else loss
        for t in range(10):
            loss(t % 3).backward()
        assert clear.attachment.counts["merges"] == 10
        gradients.append(host.gradients())
    assert all(torch.equal(g, gradients[1][name]) for name, g in gradients[0].items())
    assert not [warning for warning in recwarn if "ynamo" in str(warning.message)]


@pytest.mark.parametrize("reentrant", [True, False])
def test_a_rendering_that_a_backward_pass_makes_is_refused(reentrant):
    _, clear, render = started()
    with pytest.raises(HostError, match="view0 is rendered inside of a backward pass"):
        checkpoint(lambda _: render(), torch.zeros(1, requires_grad=True), use_reentrant=reentrant).mean().backward()
    assert not clear.attachment.counts["merges"]


@pytest.mark.parametrize(
    ("strategies", "more", "refused"),
    [
        (
            [PseudoViews()],
            {"camera_model": "fisheye", "radial_coeffs": torch.zeros(1, 6)},
            "radial_coeffs, camera_model=fisheye",
        ),
        ([PseudoViews()], {"camera_model": "pinhole", "radial_coeffs": None}, ""),
        ([], {"camera_model": "fisheye"}, ""),
    ],
)
def test_what_is_computed_between_photos_is_refused_for_other_than_pinhole_cameras(strategies, more, refused):
    @functools.wraps(gsplat_host.rasterization.func)
    def function(*args, camera_model="pinhole", radial_coeffs=None, **kwargs):
        return gsplat_host.rasterization(*args, **kwargs)

    _, _, render = started(*strategies, host=Host(rasterization=function))
    message = f"PseudoViews must have pinhole cameras, got {refused}"
    with pytest.raises(HostError, match=message) if refused else nullcontext():
        render(**more)


def watched(look):
    """A host; `look` sees each call of its function first."""

    @functools.wraps(autograd.rasterization)
    def function(**call):
        look(call)
        return gsplat_host.rasterization(**call)

    return Host(rasterization=function)


def test_random_numbers_inside_of_the_hosts_function_are_the_same_in_all_renderings_of_a_step_and_as_without_clear():
    """DropGaussian drops some of its Gaussians there."""
    torch.manual_seed(3)
    alone, drawn = torch.rand(2), []
    torch.manual_seed(3)
    _, _, render = started(toy.ShowsDark(), host=watched(lambda _: drawn.append(torch.rand(1))))
    render()
    hr, extra, lr = drawn
    assert hr == extra == lr == alone[0]
    assert torch.rand(1) == alone[1]


def test_the_gated_opacities_of_a_step_are_not_kept_with_their_graph():
    """A leaf whose data a loop replaces by fewer rows gets a new node of its gradient, unless an old graph is alive."""
    host, _, render = started(SVS(dropout=Ramp(full=2)))
    render().mean().backward()
    host.step()
    for p in host.splats.values():
        p.grad, p.data = None, p.data[3:].clone()
    render().mean().backward()
    assert host.splats["opacities"].grad.shape == (17,)


def test_the_detail_feature_has_the_type_of_what_is_drawn():
    host = Host()
    host.splats["means"] = torch.nn.Parameter(host.splats["means"].detach().double())
    _, clear, _ = started(host=host)
    drawn = {**host.splats, "means": host.splats["means"].float()}
    gsplat_host.drawn(host.rasterization, drawn, host.photos["view0"].camera)[0].mean().backward()
    assert clear.attachment.counts["merges"] == 1
    assert bool(host.splats["detail"].grad.any())


def test_the_detail_feature_beside_colours_in_float16_has_gradients_that_float16_has_not():
    detail, colors = torch.zeros(4, 3, requires_grad=True), torch.rand(4, 16, 3).half()
    for degree, shown, expected in ((3, colors, 1e-9 / SH_C0), (None, colors[:, 0], 1e-9)):
        found = calls.with_offset({"colors": shown, "sh_degree": degree}, detail, is_ours=False)["colors"]
        (g,) = torch.autograd.grad(1e-9 * found.float().sum(), detail)
        torch.testing.assert_close(g, torch.full_like(g, expected))


def test_opacities_that_a_loop_keeps_are_multiplied_by_the_gate_of_each_step():
    seen = []
    host, _, _ = started(SVS(dropout=Ramp(full=2)), host=watched(lambda call: seen.append(call["opacities"].detach())))
    kept = host.splats["opacities"].detach().sigmoid()
    for _ in range(2):
        function = lambda m, q, s, o, *more, **call: host.rasterization(m, q, s, kept, *more, **call)  # noqa: E731
        gsplat_host.drawn(function, host.splats, host.photos["view0"].camera)[0].mean().backward()
        host.step()
    hr, lr, next_hr, next_lr = seen
    assert torch.equal(hr, lr)
    assert torch.equal(next_hr, next_lr)
    assert not torch.equal(hr, next_hr)


@needs("cpp")
def test_a_square_picture_that_a_host_turns_has_the_gradients_of_what_was_drawn():
    gradients, made = [], toy.scene(20)
    for function in FUNCTIONS.values():

        @functools.wraps(function)
        def turned(function=function, **call):
            renders, alphas, info = function(**call)
            return renders.transpose(1, 2), alphas, info

        scene = replace(made, train=tuple(cropped(view, 8) for view in made.train))
        host, _, render = started(host=Host(scene, rasterization=turned), scene=scene)
        host.splats["scales"].data[:, 0] += 0.5  # round Gaussians have no gradient of their rotation
        render().square().mean().backward()
        gradients.append(host.gradients())
    for name, g in gradients[0].items():
        assert torch.allclose(gradients[1][name], g, rtol=1e-3, atol=1e-6 * float(g.abs().max()) + 1e-9), name


@needs("cpp")
def test_a_densifier_sees_no_radius_of_gaussians_that_the_gate_drops():
    """A function of gsplat 1.4 gives each its radius, whatever its opacity."""

    @functools.wraps(FUNCTIONS["another"])
    def of_1_4(**call):
        renders, alphas, info = FUNCTIONS["another"](**call)
        return renders, alphas, info | {"radii": torch.ones_like(info["radii"])}

    host, clear, _ = started(SVS(looks=0, dropout=Ramp(full=1)), host=Host(rasterization=of_1_4))
    _, _, info = host.render(host.photos["view0"].camera)
    dropped = clear.attachment.conductor.gate(1, 20) == 0
    assert 0 < int(dropped.sum()) < 20
    assert torch.equal((info["radii"][0] > 0).all(-1), ~dropped)


@pytest.mark.parametrize("looked_at", [True, False])
def test_a_host_that_draws_twice_for_one_rendering_has_the_same_gradients_and_is_told_what_it_costs(looked_at, caplog):
    caplog.set_level("INFO")

    def twice(call):
        with torch.set_grad_enabled(torch.is_grad_enabled() and not looked_at):
            gsplat_host.rasterization(**call)

    gradients = []
    for looks in (lambda call: None, twice):
        host, clear, render = started(host=watched(looks))
        for i in range(2):
            render(i).mean().backward()
        gradients.append(host.gradients())
    assert caplog.text.count("The host calls its rasterizer 2 times for one rendering") == (0 if looked_at else 1)
    assert clear.attachment.counts["HR renders in parts"] == (0 if looked_at else 2)
    for name, g in gradients[0].items():
        assert torch.allclose(gradients[1][name], g, rtol=1e-4, atol=1e-7), name


@pytest.mark.parametrize(
    ("stepped", "accumulation", "objective", "warnings"),
    [
        (False, 1, HR_FROM_START, 1),
        (True, 1, HR_FROM_START, 0),
        (False, 2, HR_FROM_START, 0),
        (False, 1, WITHOUT_HR, 0),
    ],
)
def test_a_detail_feature_whose_ten_gradients_no_optimizer_steps_on_gives_a_warning(
    stepped, accumulation, objective, warnings, caplog
):
    conductor = Conductor(P2G(patch=4), objective=objective, statistics_from=0)  # HR is drawn without λ_HR, too
    densifier = SimpleNamespace(grow_grad2d=2e-4, refine_stop_iter=10**6)  # which reads P2G's score
    host, clear, render = started(conductor=conductor, accumulation=accumulation, strategy=densifier, scene=scene())
    for i in range(12):
        render(i % 3).mean().backward()
        if (i + 1) % accumulation == 0:
            host.optimizers["detail" if stepped else "means"].step()
    assert clear.attachment.counts["HR renders"] == 12
    assert caplog.text.count("f_det has no effect") == warnings


@pytest.mark.parametrize("before_the_drawing", [True, False])
def test_what_a_loop_itself_adds_to_the_gradient_of_f_det_stays(before_the_drawing):
    """Autograd goes backwards: what comes of a node that is older than the drawing comes after the drawing's gradient."""
    merged = []
    for adds in (0, 1):
        host, _, render = started()
        image = None if before_the_drawing else render()
        penalty = adds * host.splats["detail"].sum()
        image = render() if image is None else image
        (image.mean() + penalty).backward()
        merged.append(host.splats["detail"].grad)
    assert torch.allclose(merged[1] - merged[0], torch.ones(20, 3))


def test_functions_that_are_wrapped_one_after_the_other_get_their_own_arguments():
    def theirs(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, render_mode="RGB"):
        given = means, quats, scales, opacities, colors, viewmats, Ks, width, height
        return gsplat_host.rasterization(*given, sh_degree=sh_degree, render_mode=render_mode)

    _, clear, render = started(host=Host(rasterization=theirs))
    clear.wrap(autograd.rasterization)  # which takes an offset of the colours
    render().mean().backward()
    assert clear.attachment.counts["merges"] == 1


def test_a_strategy_that_compares_images_hears_that_the_loss_at_lr_is_the_hosts(caplog):
    compares = {"compare": lambda self, scale, image, photo, step, losses: losses(image)}
    started(type("Compares", (Strategy,), compares)())
    assert "Compares.compare() is called at HR alone: the host has the loss at LR." in caplog.text
    caplog.clear()
    started()
    assert "compare()" not in caplog.text


@pytest.mark.parametrize(("objective", "warned"), [(WITHOUT_HR, True), (HR_FROM_START, False)])
def test_a_strategy_without_effect_is_told(objective, warned, caplog):
    started(conductor=Conductor(GCO(), objective=objective))
    assert ("GCO has no effect: lambda_HR is 0 throughout." in caplog.text) == warned


def test_of_a_strategy_that_a_host_calls_in_part_the_other_part_is_told(caplog):
    hooks = {"densifier": lambda self, field, views, seed: None, "score": lambda self, step, screen: None}
    started(type("Grows", (Strategy,), hooks)())
    assert "Grows.densifier() has no effect here: the host keeps its own density control." in caplog.text


@pytest.mark.parametrize("own_background", [False, True])
def test_all_renders_are_over_the_background_of_a_strategy_unless_the_loop_has_its_own(own_background, caplog) -> None:
    caplog.set_level("INFO")
    backgrounds, chosen = [], RandomBackground()
    host = watched(lambda call: backgrounds.append(call.get("backgrounds")))
    _, _, render = started(chosen, toy.ShowsDark(), host=host, own_background=own_background)
    render().mean().backward()
    assert ("RandomBackground has no effect here" in caplog.text) == own_background
    color = None if own_background else torch.tensor(chosen.background(1)).tolist()
    assert [b if b is None else b[0].tolist() for b in backgrounds] == [color] * 3


ROWS = torch.randperm(20, generator=torch.Generator().manual_seed(0))
ORDERS = {
    "by an index": lambda x: x[ROWS],
    "by another function": lambda x: x.flip(0),
    "of the values alone": lambda x: x.detach()[ROWS] if x.dim() < 3 else x[ROWS],
    "without gradients": lambda x: x.detach()[ROWS],
    "two rows": lambda x: torch.cat((x[1:2], x[:1], x[2:])),
    "in parts": lambda x: torch.cat((x[:7], x[7:])),
    "by the rows themselves": lambda x: x[torch.arange(20)],
    "with the mean of all": lambda x: x - 0.1 * x.mean(0, keepdim=True),
}


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("function", FUNCTIONS)
@needs("cpp")
def test_gaussians_in_another_order_than_the_parameters_are_refused(order, function):
    host, _, _ = started(host=Host(rasterization=FUNCTIONS[function]))
    for name in ("scales", "sh0"):  # as a loop that makes all of its tensors anew has them
        host.splats[name].data += torch.rand_like(host.splats[name])
    draw = lambda *x, **call: host.rasterization(*map(ORDERS[order], x[:5]), *x[5:], **call)  # noqa: E731
    stays, message = (
        order in ("in parts", "by the rows themselves", "with the mean of all"),
        "view0 .* in another order",
    )
    with nullcontext() if stays else pytest.raises(HostError, match=message):
        gsplat_host.drawn(draw, host.splats, host.photos["view0"].camera)[0].mean().backward()


@pytest.mark.parametrize("grad", [True, False])
@pytest.mark.parametrize("function", FUNCTIONS)
@needs("cpp")
def test_gaussians_that_are_looked_at_have_their_own_detail_feature_in_any_order_part_or_batch(function, grad):
    """As a viewer draws them that sorts or crops: from a pose of no photo, or without gradients."""
    host, _, _ = started(host=Host(rasterization=FUNCTIONS[function]))
    plain, camera = FUNCTIONS[function], toy.camera(0.05)
    splats = {name: p.detach() for name, p in host.splats.items()}
    splats["detail"][:] = torch.rand(20, 3)

    def seen(draw, rows, splats=splats, **more):
        return gsplat_host.drawn(draw, {name: p[rows] for name, p in splats.items()}, camera, **more)[0]

    shown = {**splats, "sh0": splats["sh0"] + splats["detail"][:, None] / SH_C0}
    stranger = {name: torch.cat((p[:7], p[7:9] + 0.25)) for name, p in splats.items()}
    with torch.set_grad_enabled(grad):
        for rows in (slice(None), ROWS, slice(7), ROWS[:9]):
            assert torch.allclose(seen(host.rasterization, rows), seen(plain, rows, shown), atol=1e-6), rows
        moved = {**splats, "means": splats["means"] + 0.25}
        assert torch.allclose(
            seen(host.rasterization, slice(None), moved),
            seen(plain, slice(None), {**shown, "means": moved["means"]}), atol=1e-6,
        )  # fmt: skip
        ours = {
            **stranger,
            "sh0": stranger["sh0"] + torch.cat((splats["detail"][:7], torch.zeros(2, 3)))[:, None] / SH_C0,
        }
        assert torch.allclose(
            seen(host.rasterization, slice(None), stranger), seen(plain, slice(None), ours), atol=1e-6
        )
        splats["means"][1], copies = splats["means"][0], torch.arange(20)  # a clone that no step has moved yet
        assert torch.allclose(seen(host.rasterization, copies), seen(plain, copies, shown), atol=1e-6)


def test_batches_of_scenes_are_looked_at_with_the_detail_feature_and_refused_as_a_photo():
    host, _, _ = started(host=Host(rasterization=autograd.rasterization))
    host.splats["detail"].data += 0.2
    camera = host.photos["view0"].camera

    def batched(*tensors, **call):
        batch = [x[None] if isinstance(x, torch.Tensor) else x for x in tensors]
        return host.rasterization(*batch, **call)

    with torch.no_grad():
        one, batch = (gsplat_host.drawn(draw, host.splats, camera)[0] for draw in (host.rasterization, batched))
    assert torch.equal(batch[0], one)
    with pytest.raises(
        HostError, match=r"batches of scenes, means \[1, 20, 3\]. Leave out what is in front of \[20, 3\]"
    ):
        gsplat_host.drawn(batched, host.splats, camera)
