"""CLEAR beside an Inria-shaped loop: two added lines or none, densification before or after the step, any subset."""

from __future__ import annotations

import importlib
import logging
import math
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import rasterizers
from clear_strategies import GCO, P2G, SVS, AnchorError, Conductor, DataError, Objective
from clear_strategies.compose import conductor
from clear_strategies.core.view import Photo, View
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay, scaled
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from integration import launch
from integration.attach import HostError
from integration.inria import attach, enlarged, intrinsics
from integration.lineage import change
from tests.helpers import toy

HOST = Path(__file__).parents[1] / "helpers" / "inria_host"
AT_ONCE = Objective(lambda_hr=WarmupDecay(start=0, full=1, decay_from=100, end=100))
SILENT = Objective(lambda_hr=WarmupDecay(peak=0, final=0))
STEPS, N = 25, 24


def svs(**settings):
    """Made anew each time: a strategy remembers."""
    weights = {"means": 1e-4, "scales": 1e-4, "detail": 1e-6}
    return scaled(SVS(**{"anchor_strength": 0.01, "anchor_weights": weights} | settings), STEPS / 10_000)


@pytest.fixture
def host(monkeypatch):
    """The stand-in's train.py; its modules' names are too common to stay."""
    monkeypatch.syspath_prepend(str(HOST))
    yield importlib.import_module("train")
    for name in [m for m in sys.modules if m.split(".")[0] in ("train", "scene", "gaussian_renderer")]:
        del sys.modules[name]


@pytest.fixture
def folder(host, tmp_path):
    importlib.import_module("scene").write(tmp_path, toy.scene(N))
    return tmp_path


def options(host, folder, **settings):
    opt = host.parser().parse_args(["-s", str(folder)])
    for name, value in settings.items():
        setattr(opt, name, value)
    return opt


def trained(host, folder, strategies, objective=AT_ONCE, **settings):
    """Train with the two lines."""
    opt = options(host, folder, **settings)
    gaussians, scene = host.setup(opt)
    render, grads = host.render, {}

    def between(iteration):
        grads.update({k: p.grad.clone() for k, p in clear.params().items() if p.grad is not None})

    clear = attach(
        gaussians, scene.getTrainCameras(), Conductor(*strategies, objective=objective), sr=folder / "sr",
        threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter,
    )  # fmt: skip
    render = clear.wrap(render)
    host.training(opt, gaussians, scene, render, between=between)
    return gaussians, clear, grads


def double(view, camera):
    """The view without the rounding of the host's float32 projection, which 25 steps would make large."""

    def photo(p):
        w, h = p.camera.width, p.camera.height
        fx, fy = w / 2 / math.tan(camera.FoVx / 2), h / 2 / math.tan(camera.FoVy / 2)
        pose = p.camera.world_to_camera.double()
        return Photo(replace(p.camera, world_to_camera=pose, fx=fx, fy=fy, cx=w / 2, cy=h / 2), p.image.double())

    return View(view.name, photo(view.lr), photo(view.hr))


def test_its_steps_are_those_of_our_own_trainer(host, folder):
    """In float64, and no Gaussian round: Adam follows the sign of a gradient that is nothing but rounding."""
    conductors = [
        Conductor(GCO(), P2G(patch=4), svs(), objective=scaled(Objective(), STEPS / 10_000), statistics_from=1)
        for _ in range(2)
    ]
    opt = options(host, folder, iterations=STEPS, densify_until_iter=0, sh_interval=1)
    toy_scene = toy.scene(N)
    gaussians, scene = host.setup(opt)
    clear = attach(gaussians, scene.getTrainCameras(), conductors[0], sr=folder / "sr")
    clear._views = {c.image_name: double(clear._views[c.image_name], c) for c in scene.cameras}
    views = tuple(clear._views[view.name] for view in toy_scene.train)

    own = TrainState.start(
        replace(toy_scene, train=views), conductors[1],
        settings=FitSettings(iterations=STEPS, degree_every=1, fused="off", scale_schedule=False),
        density=DensitySettings(start=1_000, stop=1_001), rates=LearningRates(means=LogLinear(1.6e-4, 1.6e-4, 1)),
        mip=MipFilter(variance=0),
    )  # fmt: skip
    own.field.double()
    own.field.scales += 0.3 * torch.randn(N, 3, generator=torch.Generator().manual_seed(1))
    adam, start = own.optimizer, own.field.scales.data.clone()
    adam.first, adam.second = ({k: v.double() for k, v in moments.items()} for moments in (adam.first, adam.second))
    rasterizer = rasterizers.load("torch", near=0.01, kernel=0.3, antialiased=False)
    names = []
    for _ in range(STEPS):
        names.append(own.view().name.removesuffix(".png"))
        iterate(own, rasterizer)

    for name, p in clear.params().items():
        p.data = p.data.double() if name != "scales" else start
    gaussians.optimizer.param_groups[0]["lr"] = 1.6e-4 * adam.extent
    gaussians.active_sh_degree = -1
    for camera in scene.cameras:
        camera.original_image, camera.world_view_transform = (
            camera.original_image.double(),
            camera.world_view_transform.double(),
        )
    host.training(opt, gaussians, scene, clear.wrap(host.render), names)

    found = clear.params()
    for name, p in own.field.raw().items():
        difference = float((p.flatten() - found[name].detach().flatten()).norm() / p.norm().clamp_min(1e-12))
        assert difference < 1e-9, name
    assert clear.attachment.counts["merged"] == STEPS
    assert clear.attachment.counts["HR renders"] == STEPS - 1  # lambda_HR is 0 until t = 1


def test_two_lines_and_none_give_the_same_file(host, folder, monkeypatch, caplog):
    settings = ["strategies.p2g.patch=4", "strategies.svs.anchor_strength=0"]
    opt = options(host, folder, iterations=12, densify_until_iter=9)
    gaussians, scene = host.setup(opt)
    with attach(
        gaussians, scene.getTrainCameras(), conductor("clear", *settings, iterations=12), sr=folder / "sr",
        threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter,
    ) as clear:  # fmt: skip
        host.training(opt, gaussians, scene, clear.wrap(host.render))
        gaussians.save_ply(folder / "two.ply")

    sets = [f"--set={s}" for s in settings]
    command = [
        "--sr",
        str(folder / "sr"),
        *sets,
        str(HOST / "train.py"),
        "-s",
        str(folder),
        "--save",
        str(folder / "none.ply"),
    ]
    with caplog.at_level(logging.INFO):
        assert launch.main([*command, "--iterations", "12", "--densify_until_iter", "9"]) == 0
    assert "12 merged" in caplog.text
    two, none = load_file(folder / "two.ply"), load_file(folder / "none.ply")
    assert len(two["xyz"]) != N  # the densifier was at work
    for name, rows in two.items():
        assert torch.equal(rows, none[name]), name
    assert not hasattr(host.render, "__wrapped__")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--clear", "nobody"], "nobody"),
        (["--set", "strategies.gco.tolerance=2"], "tolerance must lie in"),
        ([], "sr must say where the SR pictures are"),
    ],
)
def test_the_launcher_says_what_is_wrong_before_the_host_starts(arguments, said, folder, caplog):
    assert launch.main([*arguments, str(HOST / "train.py"), "-s", str(folder)]) == 2
    assert said in caplog.text


def test_the_launcher_refuses_a_missing_script_and_the_hosts_checkpoints(folder, caplog):
    assert launch.main(["--sr", str(folder), str(folder / "train.py")]) == 2
    assert "is not there" in caplog.text
    assert launch.main(["--sr", str(folder), "--", str(HOST / "train.py"), "--start_checkpoint", "chkpnt.pth"]) == 2
    assert "without --start_checkpoint" in caplog.text


def test_a_train_py_that_draws_nothing_is_told(folder, host, caplog):
    (folder / "train.py").write_text("import gaussian_renderer")
    assert launch.main(["--sr", str(folder / "sr"), str(folder / "train.py")]) == 1
    assert "CLEAR took no part" in caplog.text


def test_each_strategy_changes_what_it_should_and_nothing_else(host, folder):
    plain, base = run_once(host, folder)
    gco, with_gco = run_once(host, folder, GCO())
    p2g, with_p2g = run_once(host, folder, P2G(patch=4))
    svs, with_svs = run_once(host, folder, SVS(dropout=Ramp(maximum=0.5, shape="constant")))
    # GCO: rows in conflict alone, and never f_det.
    assert 0 < with_gco.attachment.log["corrected"] < 1
    changed = [(gco[name] != plain[name]).reshape(N, -1).any(1) for name in ("means", "scales", "opacities", "sh0")]
    assert sum(int(c.sum()) for c in changed) > 0
    assert all(int(c.sum()) < N for c in changed)
    assert torch.equal(gco["detail"], plain["detail"])
    # P2G: the HF share of every Gaussian, and the densifier's score.
    assert not torch.equal(p2g["detail"], plain["detail"])
    assert with_p2g.attachment.counts["scores handed over"] == 1
    # SVS: the dropped have no gradient at all.
    dropped = svs["means"].abs().sum(1) == 0
    assert 5 <= int((dropped & (plain["means"].abs().sum(1) > 0)).sum()) <= N - 5
    assert (
        base.attachment.counts == with_svs.attachment.counts == Counter({"HR renders": 1, "LR renders": 1, "merged": 1})
    )


def run_once(host, folder, *strategies, **settings):
    _, clear, grads = trained(host, folder, strategies, iterations=1, **settings)
    return grads, clear


@pytest.mark.parametrize("step_first", [False, True], ids=["densify, step", "step, densify"])
def test_in_either_order_of_events_everything_follows_the_densifier(step_first, host, folder):
    strategies = (GCO(), P2G(patch=4), SVS(dropout=Ramp(maximum=0.2, full=30), anchor_start=24, anchor_strength=0.01))
    gaussians, clear, grads = trained(host, folder, strategies, iterations=26, step_first=step_first)
    n = len(gaussians._xyz)
    assert n > N
    counts = clear.attachment.counts
    assert counts["structure changes"] >= 3
    assert counts["merged"] == counts["HR renders"] == 26
    assert {len(p) for p in clear.params().values()} == {n}
    assert bool((clear.params()["detail"] != 0).any())
    assert clear.attachment.conductor.state_dict()["SVS.means"].shape == (n, 3)  # anchored at t = 24
    assert all(bool(g.isfinite().all()) for g in grads.values())


def test_an_anchor_that_meets_a_changed_number_says_what_to_do(host, folder, caplog):
    early = SVS(anchor_start=5, anchor_strength=0.01)
    with (
        caplog.at_level(logging.WARNING),
        pytest.raises(
            AnchorError,
            match=r"anchor was taken at t=5 for .* Inria: densify_until_iter\) or raise strategies.svs.anchor_start",
        ),
    ):
        trained(host, folder, (early,))
    assert "densifies until densify_until_iter=24, but a strategy ends densification before" in caplog.text


def test_the_merge_is_that_of_the_summed_losses(host, folder):
    """By hand, and on a host whose last colours are frozen."""
    grads, clear = run_once(host, folder)
    opt = options(host, folder)
    gaussians, scene = host.setup(opt)
    camera = scene.cameras[1]
    view = clear._views[camera.image_name]
    drawn = host.render(camera, gaussians, None, None)["render"]
    host.Photometric.apply(drawn, camera.original_image).backward()
    image = host.render(enlarged(camera, 4), gaussians, None, None)["render"].permute(1, 2, 0)
    cotangents = AT_ONCE.hr(image.detach(), view.hr.image).cotangents
    (image * (cotangents[0] + 0.2 * cotangents[1])).sum().backward()
    assert torch.allclose(
        grads["means"], gaussians._xyz.grad, rtol=1e-4, atol=1e-7 * float(gaussians._xyz.grad.abs().max())
    )
    assert torch.allclose(grads["opacities"], gaussians._opacity.grad, rtol=1e-4, atol=1e-9)

    gaussians._features_rest.requires_grad_(False)
    clear = attach(gaussians, scene.cameras, Conductor(GCO(), objective=AT_ONCE), sr=folder / "sr")
    gaussians.optimizer.zero_grad()
    clear.wrap(host.render)(camera, gaussians, None, None)["render"].sum().backward()
    assert gaussians._features_rest.grad is None
    assert clear.attachment.counts["merged"] == 1


def test_the_densifier_reads_the_score_in_its_own_unit(host, folder):
    """By P2G alone: ‖∇_u‖ as handed over, times the scale, is S_i."""
    opt = options(host, folder)
    gaussians, scene = host.setup(opt)
    clear = attach(gaussians, scene.cameras, Conductor(objective=AT_ONCE), sr=folder / "sr")
    package = clear.wrap(host.render)(scene.cameras[0], gaussians, None, None)
    host.Photometric.apply(package["render"], scene.cameras[0].original_image).backward()
    with_hr = package["viewspace_points"].grad[:, :2].norm(dim=-1)

    seen = []
    for camera, target in ((scene.cameras[0], "lr"), (enlarged(scene.cameras[0], 4), "hr")):
        package = host.render(camera, gaussians, None, None)
        view = getattr(clear._views[scene.cameras[0].image_name], target)
        image = package["render"].permute(1, 2, 0)
        losses = AT_ONCE.lr(image.detach(), view.image) if target == "lr" else AT_ONCE.hr(image.detach(), view.image)
        weights = torch.tensor([1.0, 0.2])[: len(losses.cotangents), None, None, None]
        (image * (weights * losses.cotangents).sum(0)).sum().backward()
        seen.append(package["viewspace_points"].grad[:, :2])
    assert torch.allclose(with_hr, (seen[0] + seen[1]).norm(dim=-1), rtol=1e-3, atol=1e-9)
    assert float((with_hr - seen[0].norm(dim=-1)).abs().max()) > 0


def test_absolute_gradients_stay_the_hosts_own(host, folder, caplog):
    gaussians, scene = host.setup(options(host, folder))
    clear = attach(gaussians, scene.cameras, Conductor(P2G(patch=4), objective=AT_ONCE), sr=folder / "sr")
    grads = []
    for render in (host.render, clear.wrap(host.render)):
        package = render(scene.cameras[0], gaussians, None, None, columns=4)
        host.Photometric.apply(package["render"], scene.cameras[0].original_image).backward()
        grads.append(package["viewspace_points"].grad)
    assert torch.equal(grads[0][:, 2:], grads[1][:, 2:])
    assert not torch.equal(grads[0][:, :2], grads[1][:, :2])
    assert "4 columns" in caplog.text


@pytest.mark.parametrize("indices", [False, True])
def test_who_is_dropped_has_not_been_seen(indices, host, folder):
    gaussians, scene = host.setup(options(host, folder))
    half = SVS(dropout=Ramp(maximum=0.5, shape="constant"))
    clear = attach(gaussians, scene.cameras, Conductor(half, objective=SILENT))
    z = clear.attachment.conductor.gate(1, N)
    package = clear.wrap(host.render)(scene.cameras[0], gaussians, None, None, indices=indices)
    seen = package["visibility_filter"]
    seen = seen[:, 0] if indices else seen.nonzero()[:, 0]
    assert 0 < len(seen) < N
    assert bool((z[seen] > 0).all())
    assert torch.equal((package["radii"] > 0).nonzero()[:, 0], seen)


def test_without_hr_no_super_resolution_is_needed(host, folder):
    dropped = Conductor(SVS(dropout=Ramp(maximum=0.2, shape="constant")), objective=SILENT)
    opt = options(host, folder, iterations=3)
    gaussians, scene = host.setup(opt)
    clear = attach(gaussians, scene.getTrainCameras(), dropped)
    host.training(opt, gaussians, scene, clear.wrap(host.render))
    assert clear.attachment.counts == {"LR renders": 3, "merged": 3}
    assert bool((clear.params()["detail"] == 0).all())
    clear.remove()
    with pytest.raises(ValueError, match="sr must say where the SR pictures are, got None"):
        attach(gaussians, scene.getTrainCameras(), Conductor(GCO()))


def test_what_is_shown_and_saved_has_the_detail_and_training_goes_on_without(host, folder):
    gaussians, clear, _ = trained(host, folder, (), iterations=4, densify_until_iter=0)
    render, camera = clear.wrap(host.render), clear_camera(folder)
    dc = gaussians._features_dc
    with torch.no_grad():
        plain = host.render(camera, gaussians, None, None)["render"]
        shown = render(camera, gaussians, None, None)["render"]
        gaussians.save_ply(folder / "shown.ply")
        assert gaussians._features_dc is dc
        saved = load_file(folder / "shown.ply")["f_dc"]
        assert torch.equal(host.render(camera, gaussians, None, None)["render"], plain)
        clear.fold_detail()
        assert torch.equal(saved, gaussians._features_dc)
        assert torch.allclose(host.render(camera, gaussians, None, None)["render"], shown, atol=1e-6)
    assert float((shown - plain).abs().max()) > 1e-4
    clear.remove()
    gaussians.save_ply(folder / "shown.ply")
    assert type(gaussians).save_ply is gaussians.save_ply.__func__


def clear_camera(folder):
    scene = importlib.import_module("scene")
    return scene.Scene(folder, scene.GaussianModel()).cameras[0]


def test_removed_it_leaves_the_loop_as_it_was(host, folder):
    opt = options(host, folder, iterations=3)
    results = []
    for attached in (False, True):
        gaussians, scene = host.setup(opt)
        if attached:
            clear = attach(gaussians, scene.cameras, Conductor(GCO()), sr=folder / "sr", detail=False)
            render = clear.wrap(host.render)
            clear.remove()
        host.training(opt, gaussians, scene, render if attached else host.render)
        results.append(gaussians)
    assert torch.equal(results[0]._xyz, results[1]._xyz)
    assert torch.equal(results[0]._opacity, results[1]._opacity)


def test_without_a_detail_feature_the_rest_is_merged_as_ever(host, folder):
    with_detail, _ = run_once(host, folder, GCO())
    gaussians, scene = host.setup(options(host, folder))
    clear = attach(gaussians, scene.cameras, Conductor(GCO(), objective=AT_ONCE), sr=folder / "sr", detail=False)
    package = clear.wrap(host.render)(scene.cameras[1], gaussians, None, None)
    host.Photometric.apply(package["render"], scene.cameras[1].original_image).backward()
    assert "detail" not in clear.params()
    assert torch.equal(with_detail["means"], gaussians._xyz.grad)


class Filtered:
    """Mip-Splatting's getters, one of which calls another."""

    @property
    def get_opacity_with_3D_filter(self):
        return 0.5 * self.get_opacity

    @property
    def get_scaling_n_opacity_with_3D_filter(self):
        return 2 * self.get_scaling, self.get_opacity_with_3D_filter


def test_mip_splattings_getters_are_gated_once(host, folder):
    from integration.inria import _ROLES
    from integration.seen import Shown, seen

    base, _ = host.setup(options(host, folder))
    kind = type("Mip", (Filtered, type(base)), {})
    model = kind()
    vars(model).update(vars(base))
    z = torch.arange(N) / N
    shown = Shown(gate=z, detail=torch.ones(N, 3))
    view = seen(model, shown, _ROLES)
    assert isinstance(view, kind)
    expected = 0.5 * model.get_opacity * z[:, None]
    assert torch.equal(view.get_opacity_with_3D_filter, expected)
    scales, opacities = view.get_scaling_n_opacity_with_3D_filter
    assert torch.equal(opacities, expected)
    assert torch.equal(scales, 2 * model.get_scaling)
    assert shown.read == {"gate"}
    brighter = view.get_features - model.get_features
    assert torch.allclose(brighter[:, 0], torch.full((N, 3), 1 / 0.28209479177387814))
    assert bool((brighter[:, 1:] == 0).all())


def test_a_renderer_that_passes_the_getters_by_is_told(host, folder, caplog):
    gaussians, scene = host.setup(options(host, folder))
    always = SVS(dropout=Ramp(maximum=0.2, shape="constant"))
    clear = attach(gaussians, scene.cameras, Conductor(always, objective=AT_ONCE), sr=folder / "sr")
    render = clear.wrap(lambda camera, pc, pipe, background: host.render(camera, gaussians, pipe, background))
    render(scene.cameras[0], gaussians, None, None)
    assert "dropout has no effect" in caplog.text
    assert "detail feature has no effect" in caplog.text


def test_what_is_no_training_camera_passes_and_what_cannot_be_served_is_refused(host, folder, caplog):
    gaussians, scene = host.setup(options(host, folder))
    clear = attach(gaussians, scene.cameras, Conductor(GCO()), sr=folder / "sr")
    render, camera = clear.wrap(host.render), scene.cameras[0]
    camera.image_name = "elsewhere"
    render(camera, gaussians, None, None)
    render(camera, gaussians, None, None)
    assert caplog.text.count("none of the 3 views") == 1
    with pytest.raises(HostError, match=r"24x16 pixels was expected, render gave \(3, 64, 96\)"):
        render(enlarged(scene.cameras[1], 4), gaussians, None, None)
    with pytest.raises(HostError, match="jittered"):
        render(scene.cameras[1], gaussians, None, None, subpixel_offset=torch.zeros(1))
    with pytest.raises(HostError, match="render must return a dict"):
        clear.wrap(lambda *_: (1, 2))(scene.cameras[1], gaussians, None, None)
    with pytest.raises(HostError, match="attached already"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=folder / "sr")
    gaussians.training_setup(options(host, folder))
    with pytest.raises(HostError, match="another optimizer"):
        render(scene.cameras[1], gaussians, None, None)
    gaussians.optimizer = None
    with pytest.raises(HostError, match="has no optimizer"):
        attach(gaussians, scene.cameras, Conductor(GCO()), sr=folder / "sr")


def test_views_need_names_of_their_own_and_pictures_of_their_size(host, folder):
    gaussians, scene = host.setup(options(host, folder))
    with pytest.raises(ValueError, match="at least one training camera"):
        attach(gaussians, [], Conductor(), sr=folder / "sr")
    with pytest.raises(ValueError, match="two training cameras are called 'view0'"):
        attach(gaussians, [scene.cameras[0]] * 2, Conductor(), sr=folder / "sr")
    with pytest.raises(DataError, match="2 times the LR image is 48x32"):
        attach(gaussians, scene.cameras, Conductor(), sr=folder / "sr", factor=2)


def test_intrinsics_are_read_from_the_projection(host, folder):
    _, scene = host.setup(options(host, folder))
    camera = toy.scene(N).train[0].lr.camera
    K = intrinsics(scene.cameras[0])
    expected = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]).double()
    assert torch.allclose(K, expected, atol=1e-4)


def rows(*means, colour=None, turn=0.0):
    """Gaussians at x = means, each of its own colour unless told."""
    m = torch.tensor([[x, 0.0, 0.0] for x in means])
    c = torch.tensor([[[x, 0.0, 0.0]] for x in (means if colour is None else colour)])
    return {"means": m, "quats": torch.tensor([[1.0, turn, 0.0, 0.0]]).repeat(len(means), 1), "sh0": c}


def test_the_change_is_found_by_comparing():
    before = rows(1.0, 2.0, 3.0, 4.0)
    assert change(before, rows(1.0, 2.0, 3.0, 4.0)) is None
    # 2 is pruned, 3 cloned, 4 split in two that keep its colour.
    happened = change(before, rows(1.0, 3.0, 3.0, 3.9, 4.2, colour=(1.0, 3.0, 3.0, 4.0, 4.0)))
    assert happened.parents.tolist() == [0, 2, 2, 3, 3]
    assert happened.fresh.tolist() == [False, False, True, True, True]


def test_among_equal_colours_the_nearest_is_the_parent():
    before = rows(1.0, 2.0, 3.0, colour=(7.0, 7.0, 7.0))
    happened = change(before, rows(1.0, 2.0, 2.9, 1.2, colour=(7.0, 7.0, 7.0, 7.0)))
    assert happened.parents.tolist() == [0, 1, 2, 0]
    assert happened.fresh.tolist() == [False, False, True, True]


def test_a_gaussian_from_nowhere_has_no_parent_and_the_first_no_ancestors():
    assert change(rows(1.0), rows(1.0, 5.0)).parents.tolist() == [0, -1]
    assert change(rows(1.0), rows(1.0, turn=0.5)).parents.tolist() == [-1]
    empty = {name: tensor[:0] for name, tensor in rows(1.0).items()}
    assert change(empty, rows(1.0)).parents.tolist() == [-1]
    assert change(rows(1.0), empty).parents.tolist() == []
