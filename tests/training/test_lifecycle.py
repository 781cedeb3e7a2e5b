"""The field through clone, split, prune and reset: every per-Gaussian tensor stays with its Gaussian."""

import math
import re
from dataclasses import replace
from functools import partial

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies import SVS, Conductor, Grads, Photo, Strategy, Update
from clear_strategies.core import deferred
from clear_strategies.core.points import PointCloud
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.errors import AnswerError, DensityError, DivergedError
from clear_strategies.schedules import scaled
from clear_strategies.testing import StubShot
from clear_strategies.training.densifier import Densifier, cameras_extent
from clear_strategies.training.evaluation import evaluate
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter, filter_std
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.geometry import SH_C0
from tests.helpers import short_run, toy


def tagged(n=12):
    """A field whose every tensor carries its Gaussian's number, with optimizer and statistics alike."""
    field = GaussianField.from_cloud(toy.cloud(n))
    number = torch.arange(n, dtype=torch.float32)
    field.detail.data[:] = number[:, None]
    optimizer = Adam(field.raw(), LearningRates(), extent=1.0)
    for moments in (optimizer.first, optimizer.second):
        moments["detail"][:] = number[:, None] + 0.5
    density = toy.densifier(DensitySettings(start=0, stop=100, statistics_from=0, min_gaussians=1), field)
    return field, optimizer, density


def test_start_and_extent_are_those_of_3dgs():
    points = PointCloud(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]]), torch.full((4, 3), 0.75), "four")
    field = GaussianField.from_cloud(points)
    # Root mean square distance to the three others, from the first point: √((1 + 4 + 9) / 3).
    assert field.scales.data[0].exp().tolist() == pytest.approx([math.sqrt(14 / 3)] * 3)
    assert torch.allclose(field.opacities.data.sigmoid(), torch.full((4,), 0.1))
    assert torch.allclose(field.sh0.data[:, 0] * SH_C0 + 0.5, torch.full((4, 3), 0.75))
    assert not field.detail.data.any()
    assert field.max_degree == 3
    pose, view = torch.eye(4), short_run.SCENE.train[0]
    views = []
    for pose[0, 3] in (1.0, -1.0, 0.0):
        at = {"world_to_camera": pose.clone()}
        lr, hr = (replace(photo, camera=replace(photo.camera, **at)) for photo in (view.lr, view.hr))
        views.append(replace(view, lr=lr, hr=hr))
    assert cameras_extent(views) == pytest.approx(1.1)
    assert cameras_extent(views[:1]) > 0


@given(
    chosen=st.lists(st.booleans(), min_size=12, max_size=12),
    large=st.lists(st.booleans(), min_size=12, max_size=12),
    faint=st.lists(st.booleans(), min_size=12, max_size=12),
)
@settings(max_examples=40, deadline=None)
def test_every_tensor_follows_its_gaussian(chosen, large, faint):
    field, optimizer, density = tagged()
    wanted, big, gone = (torch.tensor(x) for x in (chosen, large, faint))
    if bool(gone.all()):
        return
    field.scales.data[:] = torch.where(big, 0.5, 0.005).log()[:, None]
    field.opacities.data[:] = torch.where(gone, torch.logit(torch.tensor(0.001)), torch.tensor(0.0))
    density.score[:] = density.ordinary[:] = wanted.float()
    density.count[:] = 1
    parents = density.restructure(field, optimizer, 10)
    numbers = parents.float()
    assert torch.equal(field.detail.data[:, 0], numbers)
    fresh = optimizer.first["detail"][:, 0] == 0
    assert torch.equal(optimizer.first["detail"][~fresh, 0], numbers[~fresh] + 0.5)
    assert {len(p) for p in field.raw().values()} == {len(parents)} == {len(field.filter_3d)}
    assert {len(m) for m in optimizer.first.values()} == {len(parents)} == {len(density.count)}
    expected = [
        0 if gone[i] else 2 if wanted[i] else 1  # a clone beside it, or two children instead of it
        for i in range(12)
    ]
    assert torch.bincount(parents, minlength=12).tolist() == expected


def test_split_children_lie_inside_their_parent_clones_are_copies_and_the_score_picks_as_many_as_the_rule():
    field, optimizer, density = tagged(2)
    field.scales.data[:] = torch.tensor([[0.5, 0.5, 0.5], [0.001, 0.001, 0.001]]).log()
    density.score[:] = density.ordinary[:] = 1.0
    density.count[:] = 1
    means = field.means.data.clone()
    parents = density.restructure(field, optimizer, 10)
    assert parents.tolist() == [1, 1, 0, 0]
    assert torch.equal(field.means.data[:2], means[[1, 1]])
    assert torch.allclose(field.scales.data[2:].exp(), torch.full((2, 3), 0.5 / 1.6))
    offset = (field.means.data[2:] - means[0]).norm(dim=1)
    assert ((offset > 0) & (offset < 0.5 * 6)).all()
    assert not torch.equal(field.means.data[2], field.means.data[3])
    field, optimizer, density = tagged()
    density.count[:] = 1
    density.ordinary[:3] = 1.0  # three pass the threshold
    density.score[5:10] = torch.tensor([5.0, 4, 3, 2, 1]) * 1e-9
    parents = density.restructure(field, optimizer, 10)
    assert torch.bincount(parents, minlength=12)[5:8].tolist() == [2, 2, 2]
    assert len(parents) == 15
    density.settings = replace(density.settings, reduce="max")  # of largest values there is no mean
    density.count[:], density.score[:4], density.ordinary[:4] = 1e6, 1.0, 1.0
    assert len(density.restructure(field, optimizer, 20)) == 19


def test_what_is_small_in_a_large_scene_is_cloned():
    for extent, parents in ((1.0, [1, 0, 0]), (10.0, [0, 1, 0])):
        field, optimizer, density = tagged(2)
        field.scales.data[:] = math.log(0.05)
        density.score[0] = density.ordinary[0] = density.count[0] = 1.0
        density.extent = extent
        assert density.restructure(field, optimizer, 10).tolist() == parents


def test_split_children_lie_along_the_long_axis_of_their_parent():
    field, optimizer, density = tagged(1)
    field.scales.data[:] = torch.tensor([[0.5, 1e-4, 1e-4]]).log()
    field.quats.data[:] = torch.tensor([[math.cos(0.3), 0, 0, math.sin(0.3)]])  # by 0.6 about z
    density.score[:] = density.ordinary[:] = density.count[:] = 1.0
    before = field.means.data.clone()
    density.restructure(field, optimizer, 10)
    x, y, z = (field.means.data - before).T
    assert torch.allclose(torch.atan(y / x), torch.tensor(0.6), atol=0.02)
    assert (z.abs() < 1e-3).all()


def test_the_cap_binds_and_is_said(caplog):
    field, optimizer, _ = tagged()
    density = toy.densifier(DensitySettings(start=0, stop=100, max_gaussians=14), field)
    for _ in range(2):
        density.score[:] = density.ordinary[:] = torch.arange(len(field)) + 1.0
        density.count[:] = 1
        assert len(density.restructure(field, optimizer, 10)) == 14
    (said,) = (r.getMessage() for r in caplog.records if "limit" in r.getMessage())
    assert "the limit of 14 Gaussians is reached: 12 are to be cloned or split, and there is room for 2" in said


def test_statistics_are_means_over_the_views_that_saw_a_gaussian_and_at_least_ten_rounds_fit():
    density = toy.densifier(DensitySettings(start=0, stop=100, statistics_from=0), 3)

    seen = StubShot(torch.zeros(2, 2, 3), torch.zeros(3, 2), torch.tensor([True, True, False]), [])
    for value in (1.0, 3.0):
        score = torch.full((3,), value)
        density.accumulate(Update(toy.step(), Grads(), score, score * 2), seen, 5)
    seen.visible = torch.tensor([True, False, False])
    density.accumulate(Update(toy.step(), Grads(), torch.full((3,), 8.0), torch.zeros(3)), seen, 6)
    assert (density.score / density.count.clamp_min(1)).tolist() == pytest.approx([4, 2, 0])
    assert density.count.tolist() == [3, 2, 0]
    settings = DensitySettings(start=50, stop=500)
    assert settings.interval == 45
    density = toy.densifier(settings, 1)
    assert [t for t in range(1, 600) if density.due(t)] == list(range(90, 500, 45))
    assert DensitySettings().interval == 100


def test_opacity_reset_acts_on_what_is_drawn():
    field, optimizer, density = tagged()
    field.filter_3d = torch.full((12,), 0.3)
    field.opacities.data[:] = torch.linspace(-8, 8, 12)
    before = field.filtered_opacities()
    optimizer.first["opacities"][:] = 1
    density.reset_opacity(field, optimizer)
    assert torch.allclose(field.filtered_opacities(), before.clamp_max(0.01), rtol=1e-4)
    assert not optimizer.first["opacities"].any()


@pytest.mark.parametrize(
    ("white", "stop", "resets"), [(True, 5_000, [500, 3000]), (False, 5_000, [3000]), (True, 0, [])]
)
def test_white_backgrounds_get_an_early_reset(white, stop, resets):
    views = [replace(short_run.SCENE.train[0], background=(1.0, 1.0, float(white)))]  # yellow is not white
    density = DensitySettings(stop=stop).densifier(GaussianField.from_cloud(short_run.SCENE.cloud), views, 0)
    assert [t for t in range(1, 10_001) if density.reset_due(t)] == resets


@pytest.mark.parametrize(("anchor_start", "probed"), [(6, True), (7, False)])
def test_opacities_that_a_strategy_keeps_from_a_reset_are_evaluated(anchor_start, probed):
    state = short_run.start((), more=[SVS(anchor_start=anchor_start)])  # a reset falls on t = 6
    for _ in range(6):
        iterate(state, toy.RASTERIZER)
    evaluate(state, toy.scene(), toy.RASTERIZER, 6)
    assert ("psnr_test" in state.history[-1]) is probed


@pytest.mark.parametrize("prune_world", [1e-6, None])
def test_an_error_names_each_setting_that_pruned_too_many(prune_world):
    field, optimizer, density = tagged()
    density.settings = replace(density.settings, prune_world=prune_world, prune_opacity=0.99)
    with pytest.raises(DensityError, match=r"leave 0 of 12 .* Lower density.prune_opacity=0.99") as error:
        density.restructure(field, optimizer, 10)
    assert ("raise density.prune_world=1e-06" in str(error.value)) is (prune_world is not None)


def test_the_size_rule_removes_what_is_too_large_after_splitting():
    field, optimizer, density = tagged(4)
    field.scales.data[:] = torch.tensor([1.4, 1.4, 1.7, 0.9]).log()[:, None]
    density.score[:] = density.ordinary[:] = torch.tensor([1.0, 0.0, 1.0, 0.0])  # rows 0 and 2 are split
    density.extent, density.settings = 1.0, replace(density.settings, prune_world=1.0)
    assert density.restructure(field, optimizer, 10).tolist() == [3, 0, 0]


def test_a_field_of_few_gaussians_may_grow_and_not_shrink():
    field, optimizer, density = tagged()
    density.settings = replace(density.settings, min_gaussians=100, prune_opacity=0.0)
    assert len(density.restructure(field, optimizer, 10)) >= 12
    density.settings = replace(density.settings, prune_opacity=0.99)
    with pytest.raises(DensityError, match=r"fewer than min_gaussians=100"):
        density.restructure(field, optimizer, 20)


@pytest.mark.parametrize("named", ["parameter of means", "sum of score", "sum of ‖∇_u L‖"])
def test_a_round_refuses_numbers_that_are_not_finite_also_on_a_device(named, monkeypatch):
    """Sorted downwards NaN comes first: such a score takes the place of another Gaussian's."""
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)
    field, optimizer, density = tagged()
    tables = {"means": field.means.data, "score": density.score, "‖∇_u L‖": density.ordinary}
    tables[named.partition(" of ")[2]][5] = torch.nan
    with pytest.raises(DivergedError, match=rf"before densification, the {re.escape(named)} .* first Gaussian 5"):
        density.restructure(field, optimizer, 10)


def test_adam_is_torchs_adam():
    field, _, _ = tagged()
    params = {name: value.clone() for name, value in field.raw().items()}
    rates = LearningRates(detail_decay=0.0)
    ours = Adam(params, rates, extent=2.0)
    theirs = {name: value.clone().requires_grad_() for name, value in params.items()}
    g = torch.Generator().manual_seed(0)
    optimizers = {n: torch.optim.Adam([p], lr=1.0, eps=1e-15) for n, p in theirs.items()}
    for t in range(1, 6):
        grads = {name: torch.randn(value.shape, generator=g) * 1e-6 for name, value in params.items()}
        ours.step(params, grads)
        for name, optimizer in optimizers.items():
            optimizer.param_groups[0]["lr"] = rates.at(t, 2.0)[name]
            theirs[name].grad = grads[name]
            optimizer.step()
    for name, value in params.items():
        assert torch.allclose(value, theirs[name].detach(), rtol=1e-5, atol=1e-7), name


def test_a_short_run_moves_the_geometry_faster_and_f_det_slower_and_nothing_else(caplog):
    plain = LearningRates(geometry_steps=0)
    with caplog.at_level("DEBUG"):
        short = plain.of_run(300)
    assert short.detail == pytest.approx(plain.detail / 5)
    assert replace(short, detail=plain.detail) == plain
    assert "rate of 0.0005 instead of 0.0025: the run has 300 iterations" in caplog.text
    assert plain.of_run(1_500) == plain
    assert replace(plain, detail_steps=0).of_run(1) == replace(plain, detail_steps=0)
    rates, plain = LearningRates(), LearningRates(geometry_steps=0)
    short = rates.of_run(3_750)
    assert (short.scales, short.quats) == pytest.approx((2 * plain.scales, 2 * plain.quats))
    for t in (1, 5_000, 10_000):
        assert short.means(t) == pytest.approx(2 * plain.means(t))
    assert replace(short, means=plain.means, scales=plain.scales, quats=plain.quats) == rates
    assert rates.of_run(30_000) == rates.of_run(60_000) == rates


def test_in_the_last_tenth_all_rates_fall_to_zero_but_that_of_the_means_falls_all_along():
    rates, held = LearningRates(), LearningRates(cool_from=10_000)
    assert rates.at(9_000, 1.0) == held.at(9_000, 1.0)
    half, last = (rates.at(t, 1.0) for t in (9_501, 10_000))
    for name, rate in held.at(1, 1.0).items():
        if name == "means":
            assert (half[name], last[name]) == (rates.means(9_501), rates.means(10_000))
        else:
            assert held.at(10_000, 1.0)[name] == rate
            assert half[name] == pytest.approx(rate / 2, rel=2e-3)
            assert last[name] == pytest.approx(rate / 1_001)
    assert held.at(30_000, 1.0)["sh0"] == held.sh0  # of a longer run, whose milestones do not stretch
    assert scaled(rates, 0.15).at(1_500, 1.0)["scales"] == pytest.approx(rates.scales / 151)


def test_the_3d_filter_by_hand_unseen_gaussians_take_the_largest_and_the_compiled_one_is_the_same():
    camera = toy.camera(0.0)
    means = torch.tensor([[0.0, 0, 0], [0, 0, 4], [0, 0, -100]])  # depths 4, 8, behind
    f = filter_std(means, [camera], 0.2)
    assert f.tolist() == pytest.approx([4 / camera.fx * 0.2**0.5, 8 / camera.fx * 0.2**0.5, 8 / camera.fx * 0.2**0.5])
    assert not filter_std(means[2:], [camera], 0.2).any()
    assert not filter_std(means, [camera], 0.0).any()
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= 0.1  # another unit of the world
    means[2, 2] = -3.8  # depth 0.2
    smaller = replace(camera, world_to_camera=pose)
    assert torch.allclose(filter_std(0.1 * means, [smaller], 0.2), 0.1 * filter_std(means, [camera], 0.2))
    cameras = [toy.camera(0.1 * i) for i in range(-20, 20)]
    means = torch.randn(1003, 3, generator=torch.Generator().manual_seed(0))
    readable = filter_std(means.double(), cameras, 0.2)
    assert len(readable.unique()) > 900
    assert torch.allclose(filter_std(means, cameras, 0.2).double(), readable, rtol=1e-6)


def test_filtered_opacity_sends_its_gradient_into_the_scales():
    scene = toy.scene(12)
    field = GaussianField.from_cloud(scene.cloud).double()
    field.filter_3d = torch.full((12,), 0.2, dtype=torch.float64)
    view = scene.train[0]
    v = torch.randn(1, 64, 96, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    import rasterizers

    smooth = rasterizers.load("torch", alpha_min=1e-9, transmittance_min=0.0)
    _, hr = field.render_scales(smooth, view)
    (gradient,) = hr.vjp(v)
    g = torch.Generator().manual_seed(1)
    for name in ("scales", "opacities", "means", "quats", "detail"):
        direction = torch.randn(gradient[name].shape, generator=g, dtype=torch.float64)
        values = []
        for sign in (1, -1):
            field.raw()[name].add_(direction, alpha=sign * 1e-6)
            values.append(float((field.render_scales(smooth, view)[1].image * v[0]).sum()))
            field.raw()[name].sub_(direction, alpha=sign * 1e-6)
        numeric = (values[0] - values[1]) / 2e-6
        assert float((gradient[name] * direction).sum()) == pytest.approx(numeric, rel=1e-4, abs=1e-6), name


def test_lr_does_not_see_the_detail_feature():
    scene = toy.scene(12)
    field = GaussianField.from_cloud(scene.cloud)
    plain_lr, plain_hr = field.render_scales(toy.RASTERIZER, scene.train[0])
    field.detail.data += 0.2
    lr, hr = field.render_scales(toy.RASTERIZER, scene.train[0])
    assert torch.equal(lr.image, plain_lr.image)
    assert not torch.equal(hr.image, plain_hr.image)
    assert "detail" not in lr.vjp(torch.ones(1, 16, 24, 3))[0]


def test_the_3d_filter_counts_what_the_rasterizer_of_the_run_draws():
    """A capture in kilometres needs a smaller near plane; its filter is that of the same capture in metres."""
    scene = toy.scene(12)

    def smaller(photo: Photo) -> Photo:
        pose = photo.camera.world_to_camera.clone()
        pose[:3, 3] /= 1024
        return replace(photo, camera=replace(photo.camera, world_to_camera=pose))

    views = tuple(replace(v, lr=smaller(v.lr), hr=smaller(v.hr)) for v in scene.train)
    tiny = replace(scene, train=views, cloud=replace(scene.cloud, means=scene.cloud.means / 1024))
    expected = toy.started(of=scene).field.filter_3d / 1024
    assert torch.allclose(toy.started(of=tiny, near=0.01 / 1024).field.filter_3d, expected)
    assert not toy.started(of=tiny).field.filter_3d.any()  # the default draws nothing of it


class Doubles(Densifier):
    """The shortest of somebody else: copies each Gaussian once, and keeps sums of the scores."""

    name, settings = "doubling", None

    def __init__(self, n, told=lambda parents: parents, gathers=lambda parents: parents):
        self.sums, self.told, self.gathers = torch.zeros(n), told, gathers

    def collects(self, t):
        return t < 4

    def accumulate(self, update, shot, t):
        self.sums += update.score

    def step(self, field, optimizer, t, resized):
        if t != 2:
            return False
        parents = torch.arange(len(field)).repeat(2)
        field.take(self.gathers(parents))
        optimizer.take(parents, torch.arange(len(parents)) >= len(parents) // 2)
        self.sums = self.sums[parents]
        if (told := self.told(parents)) is not None:
            resized(told)
        return True


def brings(make):
    """A strategy with this densifier."""
    strategy = type("Brings", (Strategy,), {"densifier": lambda self, field, views, seed: make(len(field))})
    return short_run.start((), more=[strategy()])


def test_density_is_replaced_by_what_has_the_hook_of_a_strategy():
    def density(made):
        return type("Mine", (), {"densifier": lambda self, field, views, seed: made(len(field))})()

    start = partial(
        TrainState.start, short_run.SCENE, Conductor(), settings=FitSettings(), rates=LearningRates(), mip=MipFilter()
    )
    assert type(start(density=density(Doubles)).density) is Doubles
    with pytest.raises(AnswerError, match=r"Mine.densifier\(\) must give a .*Densifier, got None"):
        start(density=density(lambda n: None))
    old = type("Old", (), {"densifier": lambda self, n, *, extent, seed: Doubles(n)})()
    with pytest.raises(
        AnswerError, match=r"Old.densifier\(\) must take \(field, views, seed\), got \(n, \*, extent, seed\)"
    ):
        start(density=old)


def test_a_densifier_of_ones_own_gets_the_scores_that_it_collects():
    state = brings(Doubles)
    n = len(state.field)
    while state.t <= 6:
        iterate(state, toy.RASTERIZER)
    assert len(state.field) == len(state.density.sums) == 2 * n
    assert bool(state.density.sums.any())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda n: Doubles(n, told=lambda parents: None), "resized.parents. after a change of structure, here from 16 to 32"),
        (lambda n: Doubles(n, told=lambda parents: parents[1:]), "resized.parents. with the 32 rows .* got 31"),
        (lambda n: Doubles(n, gathers=lambda parents: parents[:16]), "resized.parents. with the 16 rows .* got 32"),
    ],
    ids=["untold", "other parents", "another field"],
)  # fmt: skip
def test_a_densifier_that_leaves_others_behind_is_refused(make, message):
    state = brings(make)
    iterate(state, toy.RASTERIZER)
    with pytest.raises(AnswerError, match=rf"Doubles.step\(\) must call {message}"):
        iterate(state, toy.RASTERIZER)
    with pytest.raises(AnswerError, match=r"Brings.densifier\(\) must give a .*Densifier or None, got 16"):
        brings(lambda n: n)
