"""CLEAR in a 3DGS-style loop: by two added lines, by one, or by `python -m integration.inria train.py …` without any."""

import copy
import importlib
import math
import pickle
import runpy
import sys
from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from clear_strategies import GCO, P2G, SVS, Conductor, DataError, Objective, RandomBackground, SplatSuRe, Strategy
from clear_strategies.data.priors import Images
from clear_strategies.errors import SettingError
from clear_strategies.geometry import projection
from clear_strategies.schedules import Ramp, WarmupDecay, scaled
from clear_strategies.strategies import random_background
from clear_strategies.training.loop import iterate, view_at
from integration import HostError
from integration.inria import attach
from integration.inria.__main__ import main
from integration.inria.cameras import HostViews, intrinsics
from integration.inria.from_options import install
from rasterizers import Splats, autograd
from rasterizers.differentiable import outer
from tests.helpers import toy
from tests.helpers.gsplat_host import RASTERIZER, doubled, in_double
from tests.helpers.host_parts import FOLDER, FROM_START, HR_FROM_START, WITHOUT_HR, N, loop, options

STEPS = 25


def svs(**settings):
    """New objects at every call, since strategies have state."""
    weights = {"means": 1e-4, "scales": 1e-4, "detail": 1e-6}
    return scaled(SVS(**{"anchor_strength": 0.01, "anchor_weights": weights} | settings), STEPS / 10_000)


def trained(host, folder, strategies, objective=HR_FROM_START, also=lambda gaussians, iteration: None, **settings):
    """Train with the strategies attached.

    Args:
        also: is done between the backward pass and the step.
    """
    opt = options(host, folder, **settings)
    gaussians, scene = host.setup(opt)
    grads = {}

    def between(iteration):
        grads.update({k: p.grad.clone() for k, p in clear.params().items() if p.grad is not None})
        also(gaussians, iteration)

    clear = attach(
        gaussians, scene.getTrainCameras(), Conductor(*strategies, objective=objective), sr=folder / "sr",
        threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter,
    )  # fmt: skip
    loop(host, clear, opt, gaussians, scene, between=between)
    return gaussians, clear, grads


class InDouble(HostViews):
    """The views without the rounding errors of the host's float32 projection, which 25 steps would amplify."""

    def find(self, camera):
        def photo(p):
            w, h = p.camera.width, p.camera.height
            fx, fy = w / 2 / math.tan(camera.FoVx / 2), h / 2 / math.tan(camera.FoVy / 2)
            return replace(p, camera=replace(p.camera, fx=fx, fy=fy, cx=w / 2, cy=h / 2))

        view = doubled(super().find(camera))
        return replace(view, lr=photo(view.lr), hr=photo(view.hr))


def test_its_steps_equal_those_of_our_own_trainer(inria_host, inria_capture, monkeypatch):
    """Over random backgrounds, then over its own. Without spheres: their rotations have gradients of rounding errors alone."""
    monkeypatch.setattr(random_background, "_LONG_RUN", 0)
    objective = scaled(Objective(), STEPS / 10_000)
    conductors = [
        Conductor(GCO(), P2G(patch=4), svs(), RandomBackground(until=20), objective=objective, statistics_from=1)
        for _ in range(2)
    ]
    opt = options(inria_host, inria_capture, iterations=STEPS, densify_until_iter=0, sh_interval=1)
    toy_scene = toy.scene(N)
    gaussians, scene = inria_host.setup(opt)
    clear = attach(gaussians, scene.getTrainCameras(), conductors[0], sr=inria_capture / "sr", densify_until=0)
    clear.views = InDouble(scene.cameras, Images(str(inria_capture / "sr")), 4)
    views = tuple(map(clear.views.find, scene.cameras))

    own = in_double(replace(toy_scene, train=views), conductors[1], STEPS)
    own.field.scales += 0.3 * torch.randn(N, 3, generator=torch.Generator().manual_seed(1))
    start = own.field.scales.data.clone()
    names = []
    for _ in range(STEPS):
        names.append(view_at(own).name.removesuffix(".png"))
        iterate(own, RASTERIZER)

    for name, p in clear.params().items():
        p.data = p.data.double() if name != "scales" else start
    gaussians.optimizer.param_groups[0]["lr"] = 1.6e-4 * own.optimizer.extent
    gaussians.active_sh_degree = -1
    for camera in scene.cameras:
        camera.original_image = camera.original_image.double()
        camera.world_view_transform = camera.world_view_transform.double()
    loop(inria_host, clear, opt, gaussians, scene, names=names)

    params = clear.params()
    for name, p in own.field.raw().items():
        difference = float((p.flatten() - params[name].detach().flatten()).norm() / p.norm().clamp_min(1e-12))
        assert difference < 1e-9, name
    assert clear.attachment.counts["merges"] == STEPS
    assert clear.attachment.counts["HR renders"] == STEPS - 1  # lambda_HR is 0 until t = 1


@dataclass(frozen=True)
class ReadsOpacities(Strategy):
    """Its hooks take one opacity a row, and raise the gradient of all by 0.5."""

    def correct(self, lr, hr, step):
        assert {x["opacities"].shape for x in (lr, hr, step.params)} == {step.visible.shape}
        return {"opacities": torch.zeros_like(hr["opacities"])}

    def regularize(self, params, t):
        return {"opacities": torch.full_like(self.splats(params).opacities, 0.5)}

    def after_step(self, params, step):
        params["opacities"].copy_(step.visible * 7.0)


def test_strategies_are_shown_opacities_in_the_shape_of_all_other_trainers(inria_host, inria_capture):
    _, _, plain = trained(inria_host, inria_capture, [], objective=WITHOUT_HR, iterations=1)
    objective = replace(HR_FROM_START, lambda_hr=WarmupDecay(start=0, full=0, decay_from=100, end=100))
    gaussians, _, grads = trained(inria_host, inria_capture, [ReadsOpacities()], objective=objective, iterations=1)
    assert torch.allclose(grads["opacities"], plain["opacities"] + 0.5, atol=1e-6)
    assert gaussians._opacity.shape == (N, 1)
    assert gaussians._opacity.unique().tolist() in ([7], [0, 7])
    (conductor := Conductor(svs())).load_state_dict({"SVS.opacities": torch.ones(N, 1)})  # of an earlier version
    assert conductor.state_dict()["SVS.opacities"].shape == (N,)


@pytest.mark.parametrize("step_first", [False, True], ids=["densify, step", "step, densify"])
def test_everything_follows_the_densifier_before_or_after_the_step(step_first, inria_host, inria_capture):
    strategies = (GCO(), P2G(patch=4), SVS(dropout=Ramp(maximum=0.2, full=30), anchor_start=24, anchor_strength=0.01))
    gaussians, clear, grads = trained(inria_host, inria_capture, strategies, iterations=26, step_first=step_first)
    n = len(gaussians._xyz)
    assert n > N
    counts = clear.attachment.counts
    assert counts["structure changes"] >= 3
    assert counts["merges"] == counts["HR renders"] == 26
    assert {len(p) for p in clear.params().values()} == {n}
    assert bool((clear.params()["detail"] != 0).any())
    assert clear.attachment.conductor.state_dict()["SVS.means"].shape == (n, 3)  # anchored at t = 24
    assert all(bool(g.isfinite().all()) for g in grads.values())


def test_a_checkpoint_has_the_rows_of_a_densification_since_the_last_rendering(inria_host, inria_capture):
    gaussians, clear, _ = trained(inria_host, inria_capture, [SplatSuRe()], iterations=5)
    assert len(gaussians._xyz) > N
    state = clear.attachment.state_dict()["strategies"]
    assert state
    assert {len(rows) for rows in state.values()} == {len(gaussians._xyz)}


def test_a_host_that_masks_its_rendering_in_place_trains(inria_host, inria_capture, inria_attached):
    clear, *its = inria_attached(mask=torch.ones(1, 16, 24))
    loop(inria_host, clear, options(inria_host, inria_capture, iterations=2), *its)
    assert clear.attachment.counts["merges"] == 2


def test_a_loop_that_trains_nothing_of_the_gaussians_is_refused(inria_host, inria_attached):
    """LangSplat trains a feature that is drawn with the image."""
    clear, gaussians, scene = inria_attached(GCO())
    for name, p in clear.params().items():
        p.requires_grad_(name == "detail")
    clear.wrap(inria_host.render)(scene.cameras[0], gaussians, None, None)["render"].mean().backward()
    with pytest.raises(
        HostError, match="all parameters of the Gaussians are frozen, so that no strategy would take part"
    ):
        gaussians.optimizer.step()


def test_accumulated_passes_have_the_gradient_of_one_and_are_one_iteration(inria_host, inria_attached):
    found = []
    for passes in (1, 2):
        clear, gaussians, scene = inria_attached(GCO(), accumulation=passes)
        render, camera = clear.wrap(inria_host.render), scene.cameras[0]
        for i in range(2 * passes - 1):
            if i == passes - 1:  # the first step fails
                gaussians.optimizer.zero_grad()
            image = render(camera, gaussians, None, None)["render"]
            (inria_host.photometric(image, camera.original_image) / passes).backward()
        found.append({name: p.grad.clone() for name, p in clear.params().items() if p.grad is not None})
        gaussians.optimizer.step()
        assert clear.attachment.t == 2
    assert found[0]["detail"].any()
    for name, g in found[0].items():
        assert torch.allclose(found[1][name], g, rtol=1e-4, atol=1e-6 * float(g.abs().max())), name


@pytest.mark.parametrize("compact", [False, True])
@pytest.mark.parametrize("indices", [False, True])
def test_dropped_gaussians_are_not_visible(indices, compact, inria_host, inria_attached):
    """Some forks have the radii of all Gaussians, hierarchical 3DGS of the visible ones alone."""

    def render(*args, **kwargs):
        package = inria_host.render(*args, **kwargs)
        visible = package["radii"] > 0
        passed = visible.clone()
        passed[:3] = visible[:3] = False  # out of sight
        radii = (torch.arange(1, N + 1) * visible)[visible] if compact else torch.arange(1, N + 1) * visible
        return {**package, "radii": radii, "visibility_filter": passed.nonzero() if indices else passed}

    half = SVS(dropout=Ramp(maximum=0.5, shape="constant"))
    clear, gaussians, scene = inria_attached(half, objective=WITHOUT_HR, sr=None)
    z = clear.attachment.conductor.gate(1, N)
    package = clear.wrap(render)(scene.cameras[0], gaussians, None, None)
    visible = package["visibility_filter"]
    visible = visible[:, 0] if indices else visible.nonzero()[:, 0]
    assert 3 < len(visible) < N - 3
    assert bool((z[visible] > 0).all())
    assert not bool((visible < 3).any())
    radii = package["radii"]
    assert torch.equal(radii if compact else radii[radii > 0], visible + 1)


def test_without_hr_no_sr_images_are_needed(inria_host, inria_capture, inria_attached):
    dropping = SVS(dropout=Ramp(maximum=0.2, shape="constant"))
    clear, gaussians, scene = inria_attached(dropping, objective=WITHOUT_HR, sr=None)
    loop(inria_host, clear, options(inria_host, inria_capture, iterations=3), gaussians, scene)
    assert clear.attachment.counts == {"LR renders": 3, "merges": 3}
    assert bool((clear.params()["detail"] == 0).all())
    clear.remove()
    with pytest.raises(SettingError, match="sr: must be the folder of the SR images, got None"):
        attach(gaussians, scene.getTrainCameras(), Conductor(GCO()))


def test_evaluation_viewers_and_saved_files_show_the_detail_feature(inria_host, inria_capture):
    gaussians, clear, _ = trained(inria_host, inria_capture, (), iterations=4, densify_until_iter=0)
    render, dc, file = clear.wrap(inria_host.render), gaussians._features_dc, inria_capture / "shown.ply"
    camera = importlib.import_module("scene").Scene(inria_capture, type(gaussians)()).cameras[0]
    with torch.no_grad():
        plain = inria_host.render(camera, gaussians, None, None)["render"]
        shown = render(camera, gaussians, None, None)["render"]
        assert float((shown - plain).abs().max()) > 1e-4
        gaussians.save_ply(file)
        assert gaussians._features_dc is dc
        assert torch.equal(inria_host.render(camera, gaussians, None, None)["render"], plain)
    camera.image_name = None  # a MiniCam: 3DGS's viewer renders inside the training loop, with gradients on
    viewed = render(camera, gaussians, None, None)["render"]
    assert torch.equal(viewed, shown)
    viewed.sum().backward()
    assert clear.params()["detail"].grad is None
    assert clear.attachment.counts["merges"] == 4
    clear.fold_detail()
    assert torch.equal(load_file(file)["f_dc"], gaussians._features_dc)
    clear.remove()
    assert type(gaussians).save_ply is gaussians.save_ply.__func__


def test_remove_restores_the_loop(inria_host, inria_capture):
    opt = options(inria_host, inria_capture, iterations=3)
    alone, attached = (inria_host.setup(opt) for _ in range(2))
    clear = attach(attached[0], attached[1].cameras, Conductor(GCO()), sr=inria_capture / "sr", detail=False)
    clear.replace_everywhere(inria_host.render)
    clear.remove()
    assert "clear" not in attached[0].optimizer.state_dict()
    for each in (alone, attached):
        inria_host.loop(opt, *each)
    assert torch.equal(alone[0]._xyz, attached[0]._xyz)
    assert torch.equal(alone[0]._opacity, attached[0]._opacity)


@pytest.mark.parametrize(
    "copied",
    [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))],  # noqa: S301
    ids=["copy", "pickle"],
)
def test_a_copy_of_the_model_is_the_hosts_own(copied, inria_host, inria_attached):
    """It has neither the photos, nor rows that follow another model."""
    clear, gaussians, scene = inria_attached(GCO())
    render = clear.wrap(inria_host.render)
    for camera in scene.cameras:
        render(camera, gaussians, None, None)["render"].mean().backward()
        gaussians.optimizer.step()
        model = copied(gaussians)
        assert torch.equal(model._xyz, gaussians._xyz)
        assert all(
            getattr(model, name).__func__ is getattr(type(model), name) for name in ("save_ply", "_prune_optimizer")
        )
    assert clear.attachment.counts["merges"] == 3


class OneNode(torch.autograd.Function):
    """Draws by one node of autograd that this package does not know, as the CUDA rasterizer of 3DGS does."""

    @staticmethod
    def forward(ctx, points, colors, camera, *shapes):
        ctx.drawn = RASTERIZER(Splats(*(x.detach() for x in (*shapes, colors[:, :1], colors[:, 1:]))), camera)
        return ctx.drawn.image.clone()

    @staticmethod
    def backward(ctx, g):
        of = ctx.drawn.vjp(g.contiguous()[None])
        shapes = of.means[0], of.quats[0], of.scales[0], of.opacities[0]
        return of.screen[0], outer(of.rgb[0], of.basis, 16), None, *shapes


def test_a_network_before_the_rasterizer_learns_from_both_scales(inria_host, inria_attached, monkeypatch, caplog):
    """It makes colours of directions, so that positions reach the image by two ways. Whoever draws, gradients are the same."""
    renderer = sys.modules["gaussian_renderer"]

    def one_node(rasterizer, splats, camera, points, colors):
        visible = renderer.RASTERIZER(splats, camera).visible
        shapes = 1 * splats.means, splats.quats, splats.scales, splats.opacities
        return SimpleNamespace(image=OneNode.apply(points, colors, camera, *shapes), visible=visible)

    def without_centres(rasterizer, splats, camera, points, colors):
        return one_node(rasterizer, splats, camera, points.detach(), colors)

    def gradients(draw, *, lr_alone=False):
        monkeypatch.setattr(renderer, "autograd", SimpleNamespace(draw=draw))
        strategies = () if lr_alone else (GCO(), P2G(patch=4))
        clear, gaussians, scene = inria_attached(*strategies, objective=WITHOUT_HR if lr_alone else HR_FROM_START)
        gaussians.active_sh_degree = 3
        gaussians._scaling.data[:, 0] += 0.5  # round Gaussians have no gradient of their rotation
        for p in clear.params().values():
            p.register_hook(lambda g: g)
        torch.manual_seed(0)
        network = torch.nn.Linear(3, 3)

        def features(self):
            directions = torch.nn.functional.normalize(self._xyz, dim=1)
            of_directions = network(directions + self._features_dc[:, 0])[:, None]
            return torch.cat((self._features_dc + of_directions, self._features_rest), 1)

        monkeypatch.setattr(type(gaussians), "get_features", property(features))
        camera = scene.cameras[0]
        image = clear.wrap(inria_host.render)(camera, gaussians, None, torch.zeros(3))["render"]
        inria_host.photometric(image, camera.original_image).backward()
        clear.remove()
        return {name: p.grad for name, p in clear.params().items()} | {"network": network.weight.grad}

    ours, other = gradients(autograd.draw), gradients(one_node)
    for name, g in ours.items():
        torch.testing.assert_close(other[name], g, rtol=1e-3, atol=1e-4 * float(g.abs().max()), msg=name)
    assert "learn from LR alone" not in caplog.text
    unknown, of_lr = gradients(without_centres), gradients(one_node, lr_alone=True)
    assert "trains 2 tensors beside the Gaussians (torch.float32 [3, 3], torch.float32 [3])" in caplog.text
    torch.testing.assert_close(unknown["network"], of_lr["network"])
    assert float((other["network"] - of_lr["network"]).abs().max()) > 0.1 * float(of_lr["network"].abs().max())


def test_a_renderer_that_does_not_read_the_getters_is_warned_of(inria_host, caplog, inria_attached):
    always = SVS(dropout=Ramp(maximum=0.2, shape="constant"))
    clear, gaussians, scene = inria_attached(always)
    render = clear.wrap(lambda camera, pc, pipe, background: inria_host.render(camera, gaussians, pipe, background))
    render(scene.cameras[0], gaussians, None, None)
    assert "dropout has no effect" in caplog.text
    assert "detail feature has no effect" in caplog.text


def test_a_training_camera_is_recognised_but_not_by_its_name_alone_nor_with_other_colours(inria_attached):
    clear, _, scene = inria_attached(GCO())
    camera, copied = scene.cameras[1], copy.copy(scene.cameras[1])
    assert clear.views.find(camera) is clear.views.find(copied)
    copied.world_view_transform = copied.world_view_transform + 0.1  # as Blender's test photos of the same names
    assert clear.views.find(copied) is None
    clear, gaussians, scene = inria_attached()
    seen = []
    wrapped = clear.wrap(lambda camera, pc, override_color=None: seen.append(pc))
    wrapped(scene.cameras[0], gaussians, override_color=gaussians.get_xyz)
    assert seen == [gaussians]
    assert not clear.attachment.counts


def test_a_pixel_that_the_hosts_mask_hides_is_hidden_at_both_scales(inria_host, inria_attached):
    """3DGS's --train_test_exp hides half of each test photo by alpha_mask; the SR image would supervise that half."""
    clear, gaussians, scene = inria_attached(GCO(), mask=(torch.arange(24) < 12).float().expand(1, 16, 24))
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


def test_channels_behind_the_colours_are_the_hosts_own(inria_host, inria_attached):
    """GOF draws normals and depth there."""
    merged = []
    for more in (0, 4):
        clear, gaussians, scene = inria_attached(GCO(), objective=HR_FROM_START)

        def render(*args, more=more):
            package = inria_host.render(*args)
            return package | {"render": torch.cat((package["render"], *[package["render"][:1]] * more))}

        image = clear.wrap(render)(scene.cameras[1], gaussians, None, None)["render"]
        assert len(image) == 3 + more
        image[:3].square().mean().backward()
        merged.append([p.grad for p in clear.params().values() if p.grad is not None])
    assert all(torch.allclose(a, b, atol=1e-6 * float(a.abs().max())) for a, b in zip(*merged, strict=True))


def posed(host):
    def render(*args, camera_pose):
        return host.render(*args)

    return render


def test_unsupported_calls_are_refused(inria_host, inria_capture, inria_attached):
    clear, gaussians, scene = inria_attached(GCO(), objective=WITHOUT_HR)
    render, camera = clear.wrap(inria_host.render), scene.cameras[1]
    with pytest.raises(HostError, match="jittered"):
        render(camera, gaussians, None, None, subpixel_offset=torch.zeros(1))
    package = clear.wrap(posed(inria_host))(camera, gaussians, None, None, camera_pose=torch.eye(4))
    assert package["render"].shape == (3, 16, 24)
    with pytest.raises(HostError, match="render must return a dict"):
        clear.wrap(lambda *_: (1, 2))(camera, gaussians, None, None)
    camera.image_width *= 2
    with pytest.raises(HostError, match=r"24x16 pixels, the size of its camera, got shape \(3, 16, 48\)"):
        render(camera, gaussians, None, None)
    whole, gaussians._xyz.data = gaussians._xyz.data, gaussians._xyz.data[1:]
    with pytest.raises(HostError, match=f"number of Gaussians from {N} to {N - 1} inside its parameters"):
        render(camera, gaussians, None, None)
    gaussians._xyz.data = whole
    with pytest.raises(HostError, match="attached already"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=inria_capture / "sr")
    clear.remove()
    gaussians._xyz = torch.empty(0)
    with pytest.raises(HostError, match=f"must be rows of _xyz, .* got 0, {N}, .* as SCGaussian"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=inria_capture / "sr")
    gaussians.optimizer = None
    with pytest.raises(HostError, match="has no optimizer"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=inria_capture / "sr")


def test_a_pose_that_is_not_the_cameras_is_refused_with_strategies_that_show_other_views(inria_host, inria_attached):
    """InstantSplat trains its poses beside the cameras, and draws from them."""
    clear, gaussians, scene = inria_attached(toy.ShowsDark())
    render = clear.wrap(posed(inria_host))
    with pytest.raises(HostError, match=r"camera_pose.* ShowsDark"):
        render(scene.cameras[1], gaussians, None, None, camera_pose=torch.eye(4))


def test_views_need_unique_names_and_sr_images_of_the_right_size(inria_host, inria_capture) -> None:
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    with pytest.raises(SettingError, match="at least one training camera"):
        attach(gaussians, [], Conductor(), sr=inria_capture / "sr")
    with pytest.raises(DataError, match="view0: name: is that of two photos"):
        attach(gaussians, [scene.cameras[0]] * 2, Conductor(), sr=inria_capture / "sr")
    with pytest.raises(DataError, match="is 96x64 where 48x32 is expected"):
        attach(gaussians, scene.cameras, Conductor(), sr=inria_capture / "sr", factor=2)
    scene.cameras[0].image_width *= 4  # SRGS draws at HR
    with pytest.raises(HostError, match="view0 is drawn at 96x16 pixels, but its photo has 24x16"):
        attach(gaussians, scene.cameras, Conductor(), sr=inria_capture / "sr")
    _, scene = inria_host.setup(options(inria_host, inria_capture))
    expected = projection.intrinsics(toy.scene(N).train[0].lr.camera)
    assert torch.allclose(intrinsics(scene.cameras[0]), expected, atol=1e-4)


# ---- CLEAR in a 3DGS-style train.py: by one line in it, or by `python -m integration.inria train.py …` without any change
SETUP = "gaussians.training_setup(opt)"
TRAINING = "    training(parser().parse_args())\n"


def test_one_line_and_none_give_the_same_file(inria_host, inria_capture, inria_launched, caplog, monkeypatch):
    late, sr = "strategies.svs.anchor_start=7500", str(inria_capture / "sr")
    for file in (inria_capture / "sr").iterdir():
        file.rename(file.with_stem(f"{file.stem}_up"))
    script = ["--iterations", "8", "--densify_until_iter", "7", "--save"]
    assert inria_launched(*script, inria_capture / "none", clear=["--overrides", late, "--suffix", "_up"]) == 0
    assert "8 merges" in caplog.text
    assert "no effect" not in caplog.text
    assert not hasattr(inria_host.render, "__wrapped__")
    line = f"; install(gaussians, scene, opt, overrides={[*FROM_START, late]!r}, sr={sr!r}, suffix='_up')"
    edited = inria_capture / "edited.py"
    source = (FOLDER / "train.py").read_text().replace(SETUP, SETUP + line, 1)
    edited.write_text("from integration.inria import install\n" + source)
    monkeypatch.setattr(sys, "argv", ["edited.py", "-s", str(inria_capture), *script, str(inria_capture / "one")])
    runpy.run_path(str(edited), run_name="__main__")
    one, none = load_file(inria_capture / "one"), load_file(inria_capture / "none")
    assert len(one["xyz"]) != N  # the host has densified
    for name, rows in one.items():
        assert torch.equal(rows, none[name]), name


def test_schedules_are_those_of_the_hosts_own_options(inria_host, inria_capture):
    """Its defaults are not on the command line: 30 iterations, densification until 24."""
    opt = options(inria_host, inria_capture)
    gaussians, scene = inria_host.setup(opt)
    clear = install(gaussians, scene, opt, strategies="clear_paper", overrides=FROM_START[2:], sr=inria_capture / "sr")
    conductor = clear.attachment.conductor
    assert opt.densify_until_iter == 16  # clear_paper takes its anchor after iteration 15, half of all
    assert conductor.may_densify(14)
    assert not conductor.may_densify(15)
    assert conductor.objective.lambda_hr(9) == conductor.objective.lambda_hr.peak  # full at 3,000 of 10,000
    with pytest.raises(HostError, match="has no iterations"):
        install(gaussians, scene, object(), sr=inria_capture / "sr")
    clear.remove()
    clear = install(gaussians, scene, opt, sr=inria_capture / "sr", accumulation=2)
    for passes in (1, 2):
        inria_host.render(scene.cameras[0], gaussians, None, torch.zeros(3))["render"].mean().backward()
        assert clear.attachment.passes == passes
    clear.remove()


@pytest.mark.parametrize("points", ["own", "stereo"])
def test_a_run_continues_from_the_hosts_checkpoint(points, inria_capture, inria_launched, caplog) -> None:
    checkpoint = inria_capture / "5.pth"

    def saved(name, *arguments):
        common = "--iterations", "8", "--sh_interval", "1", "--densify_until_iter", "0", "--save", inria_capture / name
        assert inria_launched(*common, *arguments, clear=["--points", points]) == 0
        return load_file(inria_capture / name)

    whole = saved("whole", "--checkpoint", checkpoint, "--checkpoint_iteration", "5")
    assert caplog.text.count("points=stereo: ") == (points == "stereo")
    assert "8 merges" in caplog.text
    assert (len(whole["xyz"]) == N) == (points == "own")
    resumed = saved("resumed", "--start_checkpoint", checkpoint)
    for name, rows in whole.items():
        assert torch.allclose(rows, resumed[name], atol=1e-5), name


def test_a_checkpoint_without_clear_is_refused(inria_host, inria_capture, inria_launched, caplog):
    gaussians, _ = inria_host.setup(options(inria_host, inria_capture))
    torch.save((gaussians.capture(), 3), inria_capture / "3.pth")
    assert inria_launched("--start_checkpoint", inria_capture / "3.pth") == 2
    assert "written without CLEAR" in caplog.text


def test_save_lr_writes_the_photos_as_they_are_trained_on_and_stops(inria_capture):
    with pytest.raises(SystemExit) as stopped:
        main(["--save-lr", str(inria_capture / "lr"), str(FOLDER / "train.py"), "-s", str(inria_capture)])
    assert stopped.value.code == 0
    written = sorted((inria_capture / "lr").iterdir())
    assert [file.name for file in written] == [f"{view.name}.png" for view in toy.scene(N).train]
    assert Image.open(written[0]).size == (24, 16)


@pytest.mark.parametrize("named", [["render_fastgs"], ["render_a", "render_b"]])
def test_a_renderer_of_another_name_is_found_if_it_is_the_only_one(
    named, inria_host, inria_launched, caplog, monkeypatch
):
    """FastGS has no other; of several, none is the first."""
    module = sys.modules["gaussian_renderer"]
    for name in named:
        monkeypatch.setattr(module, name, inria_host.render, raising=False)
    monkeypatch.delattr(module, "render")
    monkeypatch.delattr(inria_host, "render")
    change = "import render\n", f"import {named[0]} as render\n"
    assert inria_launched("--iterations", "4", change=change) == (0 if len(named) == 1 else 2)
    assert ("4 merges" if len(named) == 1 else "got render_a, render_b. Use attach") in caplog.text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--strategies", "nobody", str(FOLDER / "train.py")], "nobody"),
        (["--overrides", "strategies.gco.tolerance=2", str(FOLDER / "train.py")], "tolerance: must lie in"),
        ([str(FOLDER / "train.py")], "sr: must be the folder of the SR images"),
        (["--sr", ".", "missing.py"], "is not there"),
    ],
)
def test_wrong_arguments_are_refused_before_the_host_starts(arguments, message, inria_capture, caplog):
    assert main([*arguments, "-s", str(inria_capture)]) == 2
    assert message in caplog.text


def training_setup_pp(gaussians, opt, rates):
    type(gaussians).own_setup(gaussians, opt)


@pytest.mark.parametrize("points", ["own", "stereo"])
def test_another_method_that_sets_a_model_up_is_known_by_its_name(
    points, inria_host, inria_launched, caplog, monkeypatch
):
    """InstantSplat's for a rate of each point, which those of stereo have not."""
    monkeypatch.setattr(inria_host.GaussianModel, "own_setup", inria_host.GaussianModel.training_setup, raising=False)
    monkeypatch.setattr(inria_host.GaussianModel, "training_setup_pp", training_setup_pp, raising=False)
    change = SETUP, "gaussians.training_setup_pp(opt, None)"
    status = inria_launched("--iterations", "4", clear=["--points", points], change=change)
    assert (status, "4 merges" in caplog.text) == ((0, True) if points == "own" else (2, False))
    assert ("the script calls training_setup_pp" in caplog.text) == (points == "stereo")
    assert inria_host.GaussianModel.training_setup_pp is training_setup_pp


OWN = "render.__wrapped__(camera, gaussians, pipe, background)"
DECORATED = """import gaussian_renderer
before = gaussian_renderer.render
def decorated(*args):
    return before(*args)
gaussian_renderer.render = render = decorated


def photometric"""
SCRIPTS = {
    "trains two models": ((TRAINING, 2 * TRAINING), 2),
    "sets up an earlier stage without options, as SCGaussian": ((SETUP, f"gaussians.training_setup_init()\n    {SETUP}"), 1),
    "keeps render since before the setup, as EDGS": (
        (SETUP, f"global render\n    kept = render\n    {SETUP}\n    render = kept"), 1
    ),
    "draws by its own function, too": (("package = render(", f"unpaired = {OWN}\n        package = render("), 1),
    "puts a function of its own in place of render": (("def photometric", DECORATED), 1),
}  # fmt: skip


@pytest.mark.parametrize("script", SCRIPTS)
def test_each_model_has_the_strategies_where_a_script(script, inria_host, inria_launched, caplog, monkeypatch):
    monkeypatch.setattr(sys.modules["gaussian_renderer"], "render", inria_host.render)  # which the script may change
    monkeypatch.setattr(inria_host.GaussianModel, "training_setup_init", lambda self: None, raising=False)
    change, models = SCRIPTS[script]
    assert inria_launched("--iterations", "4", change=change) == 0
    assert caplog.text.count("4 HR renders, 4 LR renders, 4 merges") == models
    assert not hasattr(inria_host.render, "__wrapped__")


@pytest.mark.parametrize("drawing", ["", "render = render.__wrapped__"])
def test_a_model_that_would_train_without_the_strategies_is_refused_at_its_first_step(
    drawing, inria_host, inria_launched, caplog, monkeypatch
):
    """GES's has another class, and is drawn by another function."""
    monkeypatch.setattr(inria_host.GaussianModel, "own_setup", inria_host.GaussianModel.training_setup, raising=False)
    own = f"global render\n    {drawing}\n    gaussians.own_setup(opt)"
    assert inria_launched("--iterations", "4", change=(SETUP, own)) == 2
    assert "would train without CLEAR" in caplog.text
    assert not hasattr(inria_host.render, "__wrapped__")


def test_a_train_py_without_a_renderer_beside_it_is_refused(inria_capture, caplog):
    (inria_capture / "train.py").write_text("")
    assert main(["--sr", str(inria_capture / "sr"), str(inria_capture / "train.py")]) == 2
    assert "has no module gaussian_renderer beside it" in caplog.text


def test_a_train_py_that_trains_nothing_is_an_error(inria_capture, inria_host, caplog):
    (inria_capture / "train.py").write_text("import gaussian_renderer")
    assert main(["--sr", str(inria_capture / "sr"), str(inria_capture / "train.py")]) == 1
    assert "trained without CLEAR" in caplog.text
