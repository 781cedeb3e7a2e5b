"""Settings of a densifier by a strategy of gsplat's shape, what is refused, and MCMC without CUDA."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch
from omegaconf import OmegaConf

from clear_strategies import DataError, Update
from clear_strategies.core.gradients import Grads
from clear_strategies.density.base import DensityError
from clear_strategies.density.gsplat import GsplatDensifier, GsplatSettings
from clear_strategies.schedules import scaled
from clear_strategies.settings import build
from clear_strategies.strategies.testing import StubShot
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam, LearningRates
from tests.helpers import toy
from tests.helpers.command_line import TINY, run
from tests.helpers.configs import composed
from tests.helpers.gsplat_densifier import DEFAULT, MCMC, TINY_ONE, N, look, need, settings, tagged


def test_the_schedule_stretches_with_the_run():
    made = scaled(replace(settings(TINY_ONE), start=500, stop=5_000, every=100, reset_every=3_000), 0.1)
    strategy = made.densifier(N, extent=2.5, seed=0, white_background=False).strategy
    assert (strategy.refine_start_iter, strategy.refine_stop_iter) == (50, 500)
    assert (strategy.refine_every, strategy.reset_every) == (10, 300)
    tiny = scaled(made, 1e-3).densifier(N, extent=1.0, seed=0, white_background=False).strategy
    assert (tiny.refine_every, tiny.reset_every) == (1, sys.maxsize)


UNUSABLE = {
    "nowhere.Nothing": "nowhere.Nothing cannot be imported",
    "tests.helpers.gsplat_like.Nothing": "tests.helpers.gsplat_like.Nothing is not there",
    "gsplat.strategy.MCMCStrategy": "take density=gsplat_mcmc",
}


@pytest.mark.parametrize(("target", "message"), UNUSABLE.items(), ids=str)
def test_a_strategy_that_cannot_be_used_is_told_in_one_sentence(target, message):
    own = {"_target_": need(target) if str(target).startswith("gsplat.") else target}
    with pytest.raises(DataError, match=message):
        GsplatSettings(own).densifier(N, extent=1.0, seed=0, white_background=False)


def test_a_missing_gsplat_is_told_with_the_command_that_installs_it(monkeypatch):
    for name in [name for name in sys.modules if name.partition(".")[0] == "gsplat"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "clear_strategies.density.mcmc", raising=False)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    for target in (DEFAULT, MCMC):
        with pytest.raises(DataError, match=r"pip install 'clear-strategies\[gsplat\]'"):
            GsplatSettings({"_target_": target}).densifier(N, extent=1.0, seed=0, white_background=False)


@pytest.mark.parametrize(
    ("strategy", "message"),
    [
        ({"no_such": 1}, "unexpected keyword argument 'no_such'"),
        ({"absgrad": True}, "absolute screen gradients, which our rasterizers do not report"),
        ({"refine_scale2d_stop_iter": 100}, "screen radii"),
    ],
)
def test_settings_of_the_strategy_that_cannot_work_are_refused(strategy, message):
    with pytest.raises(DataError, match=message):
        tagged(TINY_ONE, strategy)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strategy": {"_target_": TINY_ONE, "refine_every": 5}}, "density.every"),
        ({"strategy": {"_target_": TINY_ONE, "cap_max": 5}}, "density.max_gaussians"),
        ({"threshold": 0.0}, "threshold must be > 0"),
        ({"max_gaussians": 0}, "at least 1"),
    ],
)
def test_settings_outside_their_range_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(settings(TINY_ONE), **changes)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Careless", "Careless left means with 11 rows where 'rows' has 12"),
        ("Greedy", r"reads info\['conics'\]; this trainer has means2d, radii"),
        ("Emptying", "Emptying left 1 of 12 Gaussians, fewer than min_gaussians=2"),
    ],
)
def test_a_strategy_that_breaks_the_contract_is_named(name, message):
    theta, optimizer, made = tagged(f"tests.helpers.gsplat_like.{name}", min_gaussians=2)
    look(made, torch.ones(N))
    with pytest.raises(DensityError, match=message):
        made.step(theta, optimizer, 1, lambda _: None)


def test_relocation_leaves_what_is_seen():
    """An opacity of 0.75 as two Gaussians: each has 1 - √0.25 = 0.5, and shrinks by 0.75 / (2 · 0.5 - 0.5² / √2)."""
    need(MCMC)
    from clear_strategies.density.mcmc import relocation

    opacities, scales = relocation(torch.tensor([0.75, 0.3]), torch.ones(2, 3), torch.tensor([2, 1]))
    assert opacities.tolist() == pytest.approx([0.5, 0.3])
    assert scales[:, 0].tolist() == pytest.approx([0.75 / (1 - 0.25 / 2**0.5), 1.0])
    many, _ = relocation(torch.tensor([0.999999]), torch.ones(1, 3), torch.tensor([51]))
    assert 1 - (1 - float(many)) ** 51 == pytest.approx(0.999999)


def test_our_mcmc_is_gsplats_but_for_its_cuda_kernels(monkeypatch):
    """Its own operations, with nothing but the two kernels replaced, leave the same parameters and moments."""
    need(MCMC)
    from gsplat.strategy import MCMCStrategy, ops

    from clear_strategies.density import mcmc
    from rasterizers.geometry import rotation_matrix

    def covariances(quats, scales, **_):
        R = rotation_matrix(quats)
        return R @ torch.diag_embed(scales.square()) @ R.mT, None

    monkeypatch.setattr(
        ops, "compute_relocation", lambda opacities, scales, ratios, binoms: mcmc.relocation(opacities, scales, ratios)
    )
    monkeypatch.setattr(ops, "quat_scale_to_covar_preci", covariances)
    left = []
    for kind in (MCMCStrategy, mcmc.MCMC):
        theta = GaussianField.from_cloud(toy.cloud(60))
        g = torch.Generator().manual_seed(1)
        theta.opacities.data[:] = torch.randn(60, generator=g) * 4
        theta.quats.data[:] = torch.randn(60, 4, generator=g)
        optimizer = Adam(theta.raw(), LearningRates(), extent=1.0)
        for name, moments in optimizer.first.items():
            moments[:] = torch.randn(moments.shape, generator=g)
            optimizer.second[name][:] = moments.square()
        made = GsplatDensifier(
            settings(MCMC), kind(refine_start_iter=0, refine_every=1, noise_lr=100.0), 60, extent=1.0, seed=7
        )
        shot = StubShot(torch.zeros(48, 64, 3), torch.zeros(60, 2), torch.ones(60, dtype=torch.bool), [])
        made.accumulate(Update(toy.step(), Grads(), torch.ones(60), torch.ones(60)), shot, 1)
        assert made.step(theta, optimizer, 1, lambda _: None)
        left.append({**theta.raw(), **optimizer.state_dict()})
    assert len(left[0]["means"]) == 63
    assert any(
        float((left[0]["opacities"][i] - left[0]["opacities"][j]).abs()) == 0 for i in range(60) for j in range(i)
    )
    for name, expected in left[0].items():
        assert torch.allclose(left[1][name], expected, rtol=1e-5, atol=1e-6), name


def test_any_class_of_that_shape_is_chosen_by_its_name():
    config = composed("density=gsplat", f"density.strategy._target_={TINY_ONE}", "+density.strategy.wander=3")
    made = build(OmegaConf.to_container(config.density)).densifier(N, extent=1.0, seed=0, white_background=False)
    assert (type(made.strategy).__name__, made.strategy.wander) == ("Tiny", 3)
    assert made.strategy.refine_start_iter == 500


@pytest.mark.slow
def test_from_the_command_line(tmp_path):
    own = ["density=gsplat", f"density.strategy._target_={TINY_ONE}"]
    if find_spec("gsplat") is not None:
        own = ["density=gsplat_default", "+density.strategy.prune_scale3d=100"]  # so few points are large
    result = run("+strategy=clear", *own, *TINY, "hydra.run.dir=here", cwd=tmp_path)
    said = result.stdout + result.stderr
    assert result.returncode == 0, said
    log = (tmp_path / "here" / "run.log").read_text()
    assert "start 1, stop 6, every 1, reset_every 4" in log
    assert " grown, " in log
    assert (tmp_path / "here" / "metrics.json").is_file()
