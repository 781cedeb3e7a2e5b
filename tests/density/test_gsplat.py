"""Strategies of gsplat's shape drive our trainer's density: rows stay together, the score arrives, runs resume."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, Objective, Strategy
from clear_strategies.density import lent
from clear_strategies.density.adaptive import Density, DensitySettings
from clear_strategies.density.threshold import topk_threshold
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.training import checkpoint
from clear_strategies.training.densifier import Densifier, DensifierSettings
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.gsplat_densifier import DEFAULT, KINDS, MCMC, TINY_ONE, N, grown, look, settings, tagged


def test_both_densifiers_are_one_interface():
    assert isinstance(settings(TINY_ONE), DensifierSettings)
    assert isinstance(DensitySettings(), DensifierSettings)
    assert isinstance(tagged()[2], Densifier)
    assert isinstance(Density(DensitySettings(), 1, extent=1.0, seed=0), Densifier)


@pytest.mark.parametrize("target", KINDS)
def test_every_tensor_follows_its_gaussian(target):
    """Growth, split, removal, relocation: parents[M] is read from the contents, not from the strategy's word."""
    theta, optimizer, made = tagged(target, threshold=0.5, max_gaussians=17)
    theta.scales.data[:] = torch.where(torch.arange(N) % 2 == 0, 0.5, 0.005).log()[:, None]
    theta.scales.data[:] = theta.scales.data.clamp_max(-3 if target == DEFAULT else 0)  # not too large to stay
    theta.opacities.data[:] = torch.where(torch.arange(N) % 5 == 4, -8.0, 0.0)  # rows 4 and 9 are dead
    ours = Strategy()
    ours.state["tag"] = torch.arange(N) + 1.0
    made.state["tag"] = torch.arange(N) + 1.0
    score = torch.where(torch.arange(N) % 3 == 0, 1.0, 0.0)  # rows 0, 3, 6, 9
    parents = torch.arange(N)

    def resized(found):
        nonlocal parents
        ours.on_resize(found)
        parents = found

    look(made, score)
    assert made.step(theta, optimizer, 1, resized)
    number = parents + 1.0
    assert torch.equal(theta.detail.data[:, 0], number)
    assert torch.equal(theta.quats.data[:, 2], number)
    assert torch.equal(theta.filter_3d, number)
    assert torch.equal(ours.state["tag"], number)
    if target != MCMC:  # whose operations do not touch its state
        assert torch.equal(made.state["tag"], number)
    else:
        assert len(made.state["tag"]) == N
    for moments in (*optimizer.first.values(), *optimizer.second.values()):
        assert len(moments) == len(parents)
        found = moments.flatten(1)[:, 0] if moments.dim() > 1 else moments
        own = torch.arange(len(found)) + 1.0 if target == MCMC else number  # a moved row keeps its momentum there
        kept = found != 0
        assert torch.equal(found[kept], own[kept])
        assert 0 < int(kept.sum()) < len(parents)
    children = torch.bincount(parents, minlength=N)
    assert children[[4, 9]].tolist() == [0, 0]  # removed, or moved elsewhere
    if target != MCMC:
        assert (children > 1).nonzero()[:, 0].tolist() == [0, 3, 6]
        assert len(parents) == 13
    else:
        assert len(parents) == N  # a twentieth of 12 rounds to none
    assert {len(p) for p in theta.raw().values()} == {len(parents)} == {len(made.score), len(made.count)}


def test_the_strategys_statistic_is_the_score_that_it_was_given():
    theta, optimizer, made = tagged(every=50)
    score = torch.arange(N) * 1e-4
    seen = torch.arange(N) < 8
    for t in (1, 2):
        look(made, score * t, t=t, seen=seen)
        assert not made.step(theta, optimizer, t, pytest.fail)
    expected = torch.where(seen, score * 3, 0.0)
    assert torch.allclose(made.state["grad2d"], expected, rtol=1e-6, atol=0)
    assert torch.equal(made.state["count"], seen * 2.0)
    assert torch.equal(made.count, made.state["count"])


@pytest.mark.parametrize(("version", "shape"), [("1.4.0", (1, N)), ("1.5.3", (1, N, 2)), (None, (1, N, 2))])
def test_radii_have_the_layout_of_the_installed_gsplat(version, shape, monkeypatch):
    monkeypatch.setattr(lent, "gsplat_version", lambda: version)
    theta, optimizer, made = tagged()
    look(made, torch.ones(N))
    made.strategy.step_post_backward = lambda p, o, s, t, info: made.strategy.infos.append(info)
    made.step(theta, optimizer, 1, pytest.fail)
    info = made.strategy.infos[0]
    assert info["radii"].shape == shape
    assert info["means2d"].grad.shape == (1, N, 2)
    assert (info["width"], info["height"], info["n_cameras"], info["gaussian_ids"]) == (64, 48, 1, None)


@pytest.mark.parametrize("target", [TINY_ONE, DEFAULT])
def test_as_many_grow_by_the_score_as_would_by_the_ordinary_statistic(target):
    theta, optimizer, made = tagged(target, threshold=0.5)
    ordinary, score = torch.zeros(N), torch.zeros(N)
    ordinary[:3] = 1.0  # three pass the threshold
    score[5:10] = torch.tensor([5.0, 4, 3, 2, 1]) * 1e-9
    look(made, score, ordinary)
    assert grown(made, theta, optimizer) == [5, 6, 7]
    assert made.strategy.grow_grad2d == 0.5  # its own again
    assert not made.count.any()  # the statistics begin anew, as the strategy's


def test_fixed_mode_holds_the_score_against_the_threshold():
    theta, optimizer, made = tagged(threshold=0.5, mode="fixed")
    look(made, torch.full((N,), 1e-9), torch.ones(N))
    assert grown(made, theta, optimizer) == []


def test_the_cap_binds_and_is_said(caplog):
    theta, optimizer, made = tagged(threshold=0.5, max_gaussians=14)
    look(made, torch.arange(N) + 1.0)
    assert grown(made, theta, optimizer) == [10, 11]
    assert "the cap of 14 Gaussians binds: 12 want to densify, 2 may" in caplog.text


@pytest.mark.parametrize(
    ("k", "threshold", "chosen"), [(0, float("inf"), 0), (1, 3.0, 1), (2, 1.5, 2), (3, 0.5, 3), (4, 0.0, 3)]
)
def test_a_threshold_that_the_k_highest_pass(k, threshold, chosen):
    score = torch.tensor([0.0, 2.0, 4.0, 1.0])
    assert topk_threshold(score, k) == threshold
    assert int((score > threshold).sum()) == chosen


def test_the_real_strategy_grows_what_our_own_density_control_grows():
    """Same statistic, same threshold: gsplat's ops and our gather map pick the same rows for clone and split."""
    g = torch.Generator().manual_seed(3)
    score = torch.rand(N, generator=g)
    theta, optimizer, made = tagged(DEFAULT, {"prune_opa": 0.005}, threshold=0.4)
    theta.scales.data[:] = torch.where(torch.rand(N, 1, generator=g) < 0.5, 0.05, 0.005).log()
    theta.filter_3d.zero_()
    own = Density(DensitySettings(threshold=0.4, start=0, stop=100, statistics_from=0), N, extent=1.0, seed=0)
    twin = GaussianField(theta.raw())
    look(made, score)
    look(own, score)
    expected = own.restructure(twin, Adam(twin.raw(), LearningRates(), 1.0), 1)
    told: list[torch.Tensor] = []
    made.step(theta, optimizer, 1, told.append)
    assert told[0].sort().values.tolist() == expected.sort().values.tolist()
    sizes = [f.scales.data[:, 0].exp().sort().values for f in (theta, twin)]
    assert torch.allclose(*sizes)


@pytest.mark.parametrize("target", KINDS)
def test_chance_is_a_function_of_seed_and_iteration(target):
    """The global generator neither decides nor is disturbed."""
    moved = []
    for global_seed in (1, 2):
        torch.manual_seed(global_seed)
        before = torch.get_rng_state()
        theta, optimizer, made = tagged(target, threshold=0.5)
        theta.opacities.data[:] = torch.where(torch.arange(N) % 5 == 4, -8.0, 0.0)
        theta.scales.data[:] = -3.0
        look(made, torch.ones(N))
        assert made.step(theta, optimizer, 1, lambda _: None)
        assert torch.equal(torch.get_rng_state(), before)
        moved.append(theta.raw())
    assert all(torch.equal(moved[0][name], moved[1][name]) for name in moved[0])


def start(target: str, *strategies, **changes: Any) -> TrainState:
    objective = Objective(lambda_hr=WarmupDecay(start=1, full=3, decay_from=8, end=12))
    shared = {"start": 1, "stop": 11, "every": 3, "statistics_from": 1, "threshold": None if target == MCMC else 1e-5}
    own = {"prune_scale3d": 100.0} if target == DEFAULT else {}  # the toy's Gaussians are large
    return TrainState.start(
        toy.scene(24, train=3, test=1),
        Conductor(*strategies, objective=objective, statistics_from=1),
        settings=FitSettings(
            iterations=12, scale_schedule=False, degree_every=6, probe_every=0, checkpoint_every=0, seed=5
        ),
        density=settings(target, own, min_gaussians=2, max_gaussians=50, **{**shared, **changes}),
        rates=LearningRates(means=LogLinear(end=12)),
        mip=MipFilter(every=5, last=1),
    )


@pytest.mark.parametrize("target", KINDS)
def test_resuming_is_bitwise(target, tmp_path, caplog):
    def fresh() -> TrainState:
        svs = SVS(dropout=Ramp(full=12), anchor_start=8)
        return start(target, GCO(), P2G(), svs, reset_every=0 if target == MCMC else 5)

    whole, saved = fresh(), {}
    with caplog.at_level("DEBUG"):
        while whole.t <= 9:
            if whole.t in (3, 6):
                saved[whole.t] = checkpoint.save(tmp_path / str(whole.t), whole.checkpoint({}))
            iterate(whole, toy.RASTERIZER)
    assert "t=3:" in caplog.text
    assert len(whole.field) > 24
    expected = whole.checkpoint({}).tensors
    for t, path in saved.items():
        resumed = fresh()
        resumed.restore(checkpoint.load(path), path)
        while resumed.t <= 9:
            iterate(resumed, toy.RASTERIZER)
        found = resumed.checkpoint({}).tensors
        assert found.keys() == expected.keys()
        different = [name for name in expected if not torch.equal(found[name], expected[name])]
        assert not different, f"cut before t={t}: {different}"


def test_numbers_of_the_strategys_own_are_saved_as_what_they_are():
    theta, optimizer, made = tagged(threshold=0.5)
    look(made, torch.ones(N))
    made.step(theta, optimizer, 1, lambda _: None)
    other = tagged(threshold=0.5)[2]
    other.load_state_dict(made.state_dict())
    assert other.state["rounds"] == 1
    assert isinstance(other.state["rounds"], int)
    assert other.state["scene_scale"] == 1.0
    assert torch.equal(other.state["count"], made.state["count"])


def test_svs_ends_densification_and_whatever_else_the_strategy_does():
    state = start("tests.helpers.gsplat_like.Blind", SVS(dropout=Ramp(full=12), anchor_start=7, anchor_strength=0.01))
    for _ in range(12):
        iterate(state, toy.RASTERIZER)
    assert state.density.strategy.steps == [1, 2, 3, 4, 5, 6]
    assert len(state.conductor.strategies[0].state["means"]) == len(state.field)


def test_a_score_that_nobody_reads_is_said_once(caplog):
    theta, optimizer, made = tagged("tests.helpers.gsplat_like.Blind", threshold=0.5)
    for t in (1, 2):
        look(made, torch.ones(N), torch.zeros(N), t=t)
        made.step(theta, optimizer, t, pytest.fail)
    assert caplog.text.count("Blind reads no screen gradient: the strategies' score has no effect") == 1


def test_resets_reach_the_field_and_a_reset_that_does_not_come_is_said(caplog):
    theta, optimizer, made = tagged(threshold=100.0, every=50, reset_every=2)
    look(made, torch.ones(N), t=2)
    made.step(theta, optimizer, 2, pytest.fail)
    assert float(theta.opacities.data.max()) == pytest.approx(-4.6)
    assert not optimizer.first["opacities"].any()
    assert "reset no opacity" not in caplog.text
    theta, optimizer, made = tagged("tests.helpers.gsplat_like.Blind", threshold=100.0, reset_every=2)
    look(made, torch.ones(N), t=2)
    made.step(theta, optimizer, 2, pytest.fail)
    assert "t=2: density.reset_every falls here, and Blind" in caplog.text
