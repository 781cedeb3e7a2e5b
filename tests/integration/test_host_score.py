"""The densification score at the scale of a host's threshold."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies.errors import SettingError
from integration.autograd_shot import ScreenGradientSlot
from integration.host_score import ScoreScaler, score_for_host


def everyone(n):
    return torch.ones(n, dtype=torch.bool)


@given(seed=st.integers(0, 1_000), smaller=st.floats(3, 30))
@settings(max_examples=30, deadline=None)
def test_as_many_pass_as_by_the_ordinary_statistic_and_in_the_scores_order(seed, smaller):
    g = torch.Generator().manual_seed(seed)
    ordinary, score = torch.rand(50, generator=g) * 1e-3, torch.rand(50, generator=g) * 1e-3 / smaller
    scaled = ScoreScaler(threshold=5e-4)(score, ordinary, everyone(50))
    passing = int((ordinary >= 5e-4).sum())
    assert int((scaled >= 5e-4).sum()) == passing
    assert set((scaled >= 5e-4).nonzero()[:, 0].tolist()) == set(score.argsort(descending=True)[:passing].tolist())


def test_none_passes_where_none_passes_by_the_ordinary_statistic_or_has_a_score():
    scaled = ScoreScaler(threshold=1.0)(torch.rand(20) * 100, torch.rand(20) * 0.5, everyone(20))
    assert float(scaled.max()) < 1
    zeros = torch.zeros(5)
    assert torch.equal(ScoreScaler(threshold=1.0)(zeros, torch.ones(5) * 2, everyone(5)), zeros)


def test_the_factor_follows_recent_views_and_restarts_when_the_number_of_gaussians_changes():
    scaler = ScoreScaler(threshold=1.0, half_life=2)
    ordinary, score = torch.tensor([2.0, 2.0, 0.5, 0.5]), torch.tensor([4.0, 3.0, 2.0, 1.0])
    first = scaler(score, ordinary, everyone(4))
    assert (first >= 1).tolist() == [True, True, False, False]
    for _ in range(30):  # the score falls to a hundredth
        last = scaler(score / 100, ordinary, everyone(4))
    assert (last >= 1).tolist() == [True, True, False, False]
    assert len(scaler(torch.ones(7), torch.ones(7), everyone(7))) == 7


def test_a_restored_factor_continues():
    views = [(torch.rand(9) / 9, torch.rand(9)) for _ in range(25)]
    whole, first, resumed = (ScoreScaler(threshold=0.5) for _ in range(3))
    for score, ordinary in views[:15]:
        first(score, ordinary, everyone(9))
    resumed.load_state_dict(first.state_dict())
    last = [
        [scaler(*view, everyone(9)) for view in part][-1] for scaler, part in ((whole, views), (resumed, views[15:]))
    ]
    assert torch.equal(*last)
    assert resumed.factor != 1


def test_the_ordinary_statistic_is_not_scaled():
    ordinary, slot = torch.rand(5), ScreenGradientSlot(torch.zeros(1, 5, 2), (2, 2))
    assert score_for_host(slot, ordinary, ordinary, everyone(5), ScoreScaler(1.0)) is ordinary


def test_absolute_gradients_stay_without_a_score_and_decide_how_many_pass_with_one():
    tensor = torch.zeros(1, 4, 2)
    tensor.absgrad = torch.tensor([[[8.0, 0.0], [6.0, 0.0], [1.0, 0.0], [0.0, 0.0]]])  # 2x2 pixels: the same in NDC
    slot = ScreenGradientSlot(tensor, (2, 2))
    ordinary, score = torch.full((4,), 0.1), torch.tensor([0.4, 0.1, 0.3, 0.2])
    assert score_for_host(slot, ordinary, ordinary, everyone(4), ScoreScaler(5.0)) is None
    written = score_for_host(slot, score, ordinary, everyone(4), ScoreScaler(5.0))
    assert (written >= 5).tolist() == [True, False, True, False]  # two pass, as by 8 and 6


@pytest.mark.parametrize("setting", [{"threshold": 0.0}, {"threshold": 1.0, "half_life": 0}])
def test_settings_outside_their_range_are_refused(setting):
    with pytest.raises(SettingError, match="must be"):
        ScoreScaler(**setting)
