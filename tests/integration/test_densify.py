"""What a host's densifier gets to read."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from integration.densify import Scale, Screen, to_read


def test_a_gradient_in_ndc_is_read_in_pixels():
    screen = Screen(torch.zeros(2, 3), (200, 100), unit=(2 / 200, 2 / 100))
    read = screen.gradient(torch.tensor([[4.0, 0.0, 9.0], [0.0, 3.0, 9.0]]), 2)
    assert torch.allclose(read, torch.tensor([[0.04, 0.0], [0.0, 0.06]]))


@pytest.mark.parametrize("unit", [(1.0, 1.0), (2 / 200, 2 / 100)], ids=["gsplat", "inria"])
def test_what_is_handed_over_has_the_magnitude_in_ndc(unit):
    tensor = torch.zeros(1, 3, 2, requires_grad=True)
    screen = Screen(tensor, (200, 100), unit=unit)
    screen.hand_over(torch.tensor([0.5, 0.0, 2.0]))
    pixels = screen.gradient(tensor.grad, 3)
    assert torch.allclose((pixels * torch.tensor([100.0, 50.0])).norm(dim=1), torch.tensor([0.5, 0.0, 2.0]))


def test_packed_rows_go_to_their_gaussians_and_back():
    tensor = torch.zeros(2, 2, requires_grad=True)
    screen = Screen(tensor, (2, 2), rows=torch.tensor([3, 1]))
    assert screen.gradient(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 4).tolist() == [[0, 0], [3, 4], [0, 0], [1, 2]]
    screen.hand_over(torch.tensor([9.0, 5.0, 9.0, 7.0]))
    assert tensor.grad.tolist() == [[7, 0], [5, 0]]


def test_gsplats_absolute_gradient_is_filled_as_well():
    tensor = torch.zeros(1, 2, 2, requires_grad=True)
    tensor.absgrad = torch.ones(1, 2, 2)
    Screen(tensor, (2, 2)).hand_over(torch.tensor([1.0, 2.0]))
    assert tensor.absgrad[0, :, 0].tolist() == [1, 2]


@given(seed=st.integers(0, 1_000), smaller=st.floats(3, 30))
@settings(max_examples=30, deadline=None)
def test_as_many_pass_as_by_the_ordinary_statistic_and_in_the_scores_order(seed, smaller):
    g = torch.Generator().manual_seed(seed)
    ordinary, score = torch.rand(50, generator=g) * 1e-3, torch.rand(50, generator=g) * 1e-3 / smaller
    scale = Scale(threshold=5e-4)
    read = scale(score, ordinary, torch.ones(50, dtype=torch.bool))
    passing = int((ordinary >= 5e-4).sum())
    assert int((read >= 5e-4).sum()) == passing
    assert set((read >= 5e-4).nonzero()[:, 0].tolist()) == set(score.argsort(descending=True)[:passing].tolist())


def test_nobody_passes_where_nobody_would():
    scale = Scale(threshold=1.0)
    assert float(scale(torch.rand(20) * 100, torch.rand(20) * 0.5, torch.ones(20, dtype=torch.bool)).max()) < 1


def test_the_factor_follows_the_views_and_starts_anew_with_another_structure():
    scale = Scale(threshold=1.0, memory=2)
    seen = torch.ones(4, dtype=torch.bool)
    ordinary, score = torch.tensor([2.0, 2.0, 0.5, 0.5]), torch.tensor([4.0, 3.0, 2.0, 1.0])
    first = scale(score, ordinary, seen)
    assert (first >= 1).tolist() == [True, True, False, False]
    for _ in range(30):  # the scene changes: the score is a hundredth now
        last = scale(score / 100, ordinary, seen)
    assert (last >= 1).tolist() == [True, True, False, False]
    assert len(scale(torch.ones(7), torch.ones(7), torch.ones(7, dtype=torch.bool))) == 7


def test_a_score_of_nothing_stays_nothing():
    scale = Scale(threshold=1.0)
    assert torch.equal(scale(torch.zeros(5), torch.ones(5) * 2, torch.ones(5, dtype=torch.bool)), torch.zeros(5))


def test_the_ordinary_statistic_is_left_as_it_is():
    ordinary, screen = torch.rand(5), Screen(torch.zeros(1, 5, 2), (2, 2))
    assert to_read(screen, ordinary, ordinary, torch.ones(5, dtype=torch.bool), Scale(1.0)) is ordinary


def test_a_host_of_absolute_gradients_keeps_its_own_and_a_score_is_measured_by_them():
    tensor = torch.zeros(1, 4, 2)
    tensor.absgrad = torch.tensor([[[8.0, 0.0], [6.0, 0.0], [1.0, 0.0], [0.0, 0.0]]])  # NDC: the same, of 2x2 pixels
    screen, seen = Screen(tensor, (2, 2)), torch.ones(4, dtype=torch.bool)
    ordinary, score = torch.full((4,), 0.1), torch.tensor([0.4, 0.1, 0.3, 0.2])
    assert to_read(screen, ordinary, ordinary, seen, Scale(5.0)) is None
    read = to_read(screen, score, ordinary, seen, Scale(5.0))
    assert (read >= 5).tolist() == [True, False, True, False]  # two, as by 8 and 6


@pytest.mark.parametrize("wrong", [{"threshold": 0.0}, {"threshold": 1.0, "memory": 0}])
def test_settings_outside_their_range_are_refused(wrong):
    with pytest.raises(ValueError, match="must be"):
        Scale(**wrong)
