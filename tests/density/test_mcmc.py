"""Density control by sampling: what moves, what is added, what the noise leaves alone."""

import math
from dataclasses import replace

import pytest
import torch

from clear_strategies import MCMC
from clear_strategies.density.mcmc import Sampler, drawn, relocation
from clear_strategies.errors import DensityError, DivergedError
from clear_strategies.schedules import LogLinear
from clear_strategies.training import checkpoint
from clear_strategies.training.densifier import Densifier
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import iterate
from clear_strategies.training.optim import Adam, LearningRates
from integration.on_cpu.gsplat_functions import _relocation
from tests.helpers import toy
from tests.helpers.short_run import start, tensors

N = 60
EVERY = MCMC(start=0, stop=100, every=1, noise=0.0)
DEAD = -8.0  # logit of an opacity of 3e-4


def start_of_run(settings: MCMC = EVERY, opacity: float = 0.0, **changes):
    """(field, optimizer, densifier); every moment is 1."""
    theta = GaussianField.from_cloud(toy.cloud(N))
    theta.opacities.data[:] = opacity
    optimizer = Adam(theta.raw(), LearningRates(), extent=1.0)
    for moments in (*optimizer.first.values(), *optimizer.second.values()):
        moments[:] = 1
    return theta, optimizer, Sampler(replace(settings, **changes), N, seed=3)


def displacement(theta, optimizer, densifier, t: int = 1):
    """How far one step moves the means."""
    means = theta.means.data.clone()
    step(theta, optimizer, densifier, t)
    return theta.means.data - means


def step(theta, optimizer, densifier, t: int = 1):
    """The parents of one step; None: the structure did not change."""
    parents = []
    changed = densifier.step(theta, optimizer, t, parents.append)
    assert changed == bool(parents)
    return parents[0] if parents else None


def test_where_sampling_is_of_no_use_density_control_stays_and_that_is_said(caplog):
    """The toy's cameras are 5 away: the fewer points, the further they lie apart."""
    caplog.set_level("DEBUG")

    def shown(grey, background):
        views = toy.scene(8, train=3).train
        lit = [replace(v.lr, image=torch.full_like(v.lr.image, grey)) for v in views]
        return [replace(v, lr=lr, background=background) for v, lr in zip(views, lit, strict=True)]

    views = shown(0.5, (0.0, 0.0, 0.0))
    theta = GaussianField.from_cloud(toy.cloud(N))
    theta.scales.data[:] = -6.0
    long = replace(EVERY, stop=750)
    assert long.densifier(theta, views, 0).cap == round(EVERY.per_point * N)
    assert EVERY.densifier(theta, views, 0) is None
    assert "mcmc is off: it needs 1,500 iterations or more" in caplog.text
    theta.scales.data[:] = 2.0
    assert long.densifier(theta, views, 0) is None
    assert "mcmc is off: the initial points lie" in caplog.text
    theta.scales.data[:] = -6.0
    assert long.densifier(theta, shown(1.0, (1.0, 1.0, 1.0)), 0) is None
    assert "an object before a plain background" in caplog.text


def test_gsplats_loop_on_a_cpu_keeps_its_least_opacity():
    new, _ = _relocation(
        torch.tensor([0.01, 0.5]), torch.ones(2, 3), torch.tensor([9, 2]), torch.ones(51, 51), 51, 0.005
    )
    assert new.tolist() == pytest.approx([0.005, 1 - 0.5**0.5])


def test_relocation_is_equation_9_of_3dgs_mcmc_of_up_to_51_copies():
    """Its double sum, one Gaussian after another: what it keeps is the integral of alpha along a line through the middle."""
    g = torch.Generator().manual_seed(0)
    opacities, scales = torch.rand(40, generator=g) * 0.99, torch.rand(40, 3, generator=g)
    copies = torch.randint(1, 60, (40,), generator=g)
    copies[:2] = torch.tensor([1, 52])
    found, shrunk = relocation(opacities, scales, copies)
    for i, o in enumerate(opacities.double().tolist()):
        n = min(int(copies[i]), 51)
        shared = 1 - (1 - o) ** (1 / n)
        total = sum(
            math.comb(k - 1, j) * (-1) ** j * shared ** (j + 1) / math.sqrt(j + 1)
            for k in range(1, n + 1)
            for j in range(k)
        )
        assert float(found[i]) == pytest.approx(shared, rel=1e-6)
        assert shrunk[i].tolist() == pytest.approx((scales[i].double() * o / total).tolist(), rel=1e-6)


def test_sources_are_drawn_as_often_as_their_weights_say():
    weights = torch.tensor([0.0, 0.1, 0.0, 0.6, 0.3, 0.0])
    share = torch.bincount(drawn(weights, 100_000, torch.Generator().manual_seed(0)), minlength=6) / 100_000
    assert torch.allclose(share, weights, atol=5e-3)
    assert not share[weights == 0].any()


def test_dead_gaussians_move_to_live_ones_and_start_without_momentum():
    theta, optimizer, densifier = start_of_run(growth=0.0)
    theta.opacities.data[:20] = DEAD
    means, scales = theta.means.data.clone(), theta.scales.data.clone()
    parents = step(theta, optimizer, densifier)
    assert len(theta) == N
    assert bool((parents[:20] >= 20).all())
    assert torch.equal(parents[20:], torch.arange(20, N))
    assert torch.equal(theta.means.data, means[parents])
    copies = torch.bincount(parents, minlength=N)[parents]
    shared = copies > 1
    _, smaller = relocation(torch.full((N,), 0.5), scales[parents].exp(), copies)
    assert torch.allclose(theta.scales.data, smaller.log())
    for moments in (*optimizer.first.values(), *optimizer.second.values()):
        assert not bool(moments[shared].any())
        assert bool((moments[~shared] == 1).all())
    assert bool((theta.opacities.data[shared] < 0).all())
    assert bool((theta.opacities.data[~shared] == 0).all())
    theta, optimizer, densifier = start_of_run(opacity=40.0)  # 1 in float32
    step(theta, optimizer, densifier)
    assert bool(theta.opacities.data.isfinite().all())


def test_rounds_fall_between_start_and_stop_and_the_field_grows_to_a_multiple_of_its_points():
    densifier = start_of_run(start=10, stop=40, every=10)[2]
    assert isinstance(densifier, Densifier)
    assert [t for t in range(60) if densifier.due(t)] == [20, 30]
    assert not any(densifier.reset_due(t) for t in range(60))
    theta, optimizer, densifier = start_of_run(growth=0.5, per_point=2.0)
    sizes = []
    for t in range(1, 5):
        step(theta, optimizer, densifier, t)
        sizes.append(len(theta))
    assert sizes == [90, 120, 120, 120]
    before = {name: p.clone() for name, p in theta.raw().items()}
    assert step(theta, optimizer, densifier, 5) is None  # nothing is dead and the cap is reached
    assert all(torch.equal(p, before[name]) for name, p in theta.raw().items())
    assert start_of_run(per_point=2.0, max_gaussians=70)[2].cap == 70


def test_noise_moves_the_faint_along_their_covariance_as_far_as_the_scene_is_large_until_stop():
    theta, optimizer, densifier = start_of_run(noise=100.0, start=9)
    theta.opacities.data[:20] = -6.0
    moved = displacement(theta, optimizer, densifier).norm(dim=1)
    assert float(moved[:20].min()) > 0
    assert float(moved[20:].max()) < 1e-9
    assert not displacement(theta, optimizer, densifier, EVERY.stop).any()
    cooling, moved = LogLinear(1.0, 0.01, end=10), []
    for rate in (cooling, LogLinear(1.0, 1.0)):
        moved.append(displacement(*start_of_run(noise=100.0, start=9, opacity=-6.0, cooling=rate), t=4))
    assert torch.allclose(moved[0], cooling(4) * moved[1], rtol=1e-3, atol=1e-5)
    offsets = []
    for size in (1.0, 8.0):
        theta, optimizer, densifier = start_of_run(noise=100.0, start=9, opacity=-6.0)
        theta.means.data *= size
        theta.scales.data += torch.tensor(size).log()
        offsets.append(displacement(theta, optimizer, densifier) / size)
    assert torch.allclose(*offsets, rtol=1e-3, atol=1e-4)
    theta, optimizer, densifier = start_of_run(noise=1e3, start=9, opacity=-6.0)
    theta.scales.data[:] = torch.tensor([0.0, -20.0, -20.0])  # needles along their first axis
    half = 0.5**0.5
    theta.quats.data[:] = torch.tensor([half, 0, 0, half])  # which a turn about z by 90 degrees lays along y
    offset = displacement(theta, optimizer, densifier).abs()
    assert float(offset[:, 1].median()) > 0.1
    assert float(offset[:, [0, 2]].max()) < 1e-4


def test_a_run_resumes_to_the_bit_and_to_the_same_cap(tmp_path, monkeypatch):
    monkeypatch.setattr("clear_strategies.density.mcmc._DENSE", float("inf"))
    monkeypatch.setattr("clear_strategies.density.mcmc._SHORT_RUN", 0)

    def started():
        return start(("fading_opacity",), more=[MCMC(start=1, stop=13, every=3, per_point=2.0, growth=0.4, noise=20.0)])

    whole = started()
    n = len(whole.field)
    for t in range(1, 13):
        if t == 8:
            saved = checkpoint.save(tmp_path, whole.checkpoint({}))
            assert n < len(whole.field) <= 2 * n
        iterate(whole, toy.RASTERIZER)
    resumed = started()
    resumed.restore(checkpoint.load(saved), saved)
    while resumed.t < 13:
        iterate(resumed, toy.RASTERIZER)
    assert resumed.density.cap == whole.density.cap == 2 * n
    expected, result = tensors(whole), tensors(resumed)
    assert not [name for name in expected if not torch.equal(result[name], expected[name])]


def test_too_few_live_gaussians_and_numbers_that_are_not_finite_are_errors():
    theta, optimizer, densifier = start_of_run(opacity=0.5, min_gaussians=100)
    step(theta, optimizer, densifier)
    assert len(theta) > 60  # few that all live may become more
    theta, optimizer, densifier = start_of_run(opacity=DEAD, min_gaussians=5)
    theta.opacities.data[:3] = 0
    with pytest.raises(DensityError, match=r"3 of 60 Gaussians .* fewer than min_gaussians=5"):
        step(theta, optimizer, densifier)
    theta.scales.data[4] = torch.nan
    with pytest.raises(DivergedError, match="before densification, the parameter of scales"):
        step(theta, optimizer, densifier)


def test_a_densifier_without_state_resumes(tmp_path):
    class Stateless(Sampler):
        def state_dict(self):
            return {}

        def load_state_dict(self, tensors):
            assert not tensors

    state = start(())
    state.density = Stateless(EVERY, len(state.field), seed=0)
    iterate(state, toy.RASTERIZER)
    saved = checkpoint.load(checkpoint.save(tmp_path, state.checkpoint({})))
    state.restore(saved, tmp_path)
    assert state.t == 2
