"""Outliers: small cases by hand."""

from __future__ import annotations

import torch

from clear_strategies.geometry.cleaning import remove_outliers


def test_a_stray_point_is_removed() -> None:
    # Mean distance to the 2 nearest, itself included: 1/2 four times and 96/2 once. Average 10, deviation 21.2.
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [99, 0, 0]])
    assert remove_outliers(line, 2, 1.7).tolist() == [0, 1, 2, 3]  # the limit is 46.1
    assert remove_outliers(line, 2, 1.8).tolist() == [0, 1, 2, 3, 4]  # 48.3


def test_a_point_on_its_nearest_one_is_removed() -> None:
    line = torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert remove_outliers(line, 2, 3.0).tolist() == [2, 3]


def test_tiny_clouds_are_left_alone() -> None:
    for n in (0, 1):
        assert len(remove_outliers(torch.zeros(n, 3), 16, 3.0)) == n
