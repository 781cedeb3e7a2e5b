"""`bench errors`: every part of a squared error is counted once, and belongs to the pixels, waves and cameras it is said to."""

from __future__ import annotations

import math

import pandas as pd
import pytest
import torch

from clear_strategies.bench.__main__ import main
from clear_strategies.bench.errors import HeldOut, budget, by_view, distance_from_hull, waves
from clear_strategies.jobs import job
from tests.helpers.configs import composed

TRIANGLE = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])


def view(error: torch.Tensor, **facts) -> HeldOut:
    truth = torch.rand(*error.shape, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.25
    solid, seen = torch.ones(error.shape[:2]), torch.full(error.shape[:2], 2)
    given = {"alpha": solid, "seen": seen, "distance": 0.0, "factor": 4, **facts}
    return HeldOut("a", truth, {"run": truth + error}, **given)


def rows(*views: HeldOut) -> pd.DataFrame:
    return budget(views).set_index(["group", "part"])


def test_a_constant_error_is_bias_and_the_finest_stripes_are_beyond_the_lr_photos():
    constant = waves(torch.full((48, 64, 3), 0.1), 4)
    assert constant["bias"] == pytest.approx(sum(constant.values())) == pytest.approx(0.01 * 48 * 64 * 3)
    stripes = torch.full((48, 64, 3), 0.1)
    stripes[:, ::2] *= -1
    finest = waves(stripes, 4)
    assert finest["under 8 px, beyond LR"] > 0.95 * sum(finest.values())
    slow = waves((torch.arange(256) / 256 * 2 * math.pi).cos().expand(64, 256)[..., None] * torch.ones(3), 4)
    assert slow["over 128 px"] > 0.95 * sum(slow.values())


def test_the_shares_of_every_group_add_up_to_one():
    noise = [torch.randn(30, 47, 3, generator=torch.Generator().manual_seed(seed)) * 0.1 for seed in (0, 1)]
    some = torch.rand(30, 47, generator=torch.Generator().manual_seed(2))
    shares = rows(view(noise[0], alpha=some, seen=(some * 4).long()), view(noise[1], distance=1.0))["run: share"]
    assert shares.groupby("group").sum().to_list() == pytest.approx([1.0] * 6)
    assert shares[("camera", "outside of it")] == pytest.approx(
        float(noise[1].square().sum() / (noise[0].square().sum() + noise[1].square().sum())), rel=1e-4
    )


def test_what_is_gained_where_all_error_lies_is_everything_and_elsewhere_nothing():
    error, alpha = torch.zeros(20, 20, 3), torch.ones(20, 20)
    error[:10], alpha[:10] = 0.1, 0.5
    table = rows(view(error, alpha=alpha))
    assert table.loc[("alpha", "below 0.9"), "run: if perfect"] == 100
    assert table.loc[("alpha", "below 0.9"), "run: psnr"] == pytest.approx(20, abs=1e-3)
    assert table.loc[("alpha", "from 0.9"), "run: if perfect"] == pytest.approx(23.01, abs=1e-2)
    assert math.isnan(table.loc[("seen by", "one"), "run: psnr"])
    assert by_view([view(error, alpha=alpha)]).loc[0, "run: psnr"] == pytest.approx(23.01, abs=1e-2)


@pytest.mark.parametrize(
    ("center", "hull", "distance"),
    [
        ([0.5, 0.5, 0], TRIANGLE, 0), ([2, 2, 0], TRIANGLE, 0.5), ([0.5, 0.5, 1], TRIANGLE, 1 / 8**0.5),
        ([-1, 0, 0], TRIANGLE, 1 / 8**0.5), ([2, 0, 0], TRIANGLE[:1], math.inf),
    ],
)  # fmt: skip
def test_distance_from_the_hull_is_that_of_its_nearest_point(center, hull, distance):
    assert distance_from_hull(torch.tensor(center, dtype=torch.float32), hull) == pytest.approx(distance, abs=2e-3)


@pytest.mark.slow
def test_the_command_reads_a_run_and_finds_its_own_psnr(tmp_path, capsys):
    small = ["data.reader.width=96", "data.reader.height=64", "fit.iterations=4", "fit.baseline=false", "fit.video=0"]
    psnr = job.run(composed("+strategy=gco", *small), tmp_path / "run")
    asked = ["errors", str(tmp_path / "run"), "--reference", str(tmp_path / "run"), "--out", str(tmp_path / "out")]
    assert main(asked) == 0
    views = pd.read_csv(tmp_path / "out" / "errors_views.csv")
    assert views["run: psnr"].mean() == pytest.approx(psnr, abs=1e-3)
    assert views["run: psnr"].equals(views["reference: psnr"])
    assert len(pd.read_csv(tmp_path / "out" / "errors.csv")) == 15
    assert (tmp_path / "out" / "errors.png").stat().st_size > 5_000
    assert "if perfect" in capsys.readouterr().out
