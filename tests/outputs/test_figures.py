"""What the figures share."""

from __future__ import annotations

import numpy as np
import pytest

from clear_strategies.outputs import figures


def test_error_is_the_mean_difference_over_rgb() -> None:
    image = np.array([[[0.5, 0.5, 0.5], [1.0, 0.0, 0.0]]])
    truth = np.array([[[0.5, 0.5, 0.5], [0.4, 0.3, 0.0]]])
    assert figures.error_map(image, truth) == pytest.approx(np.array([[0.0, 0.3]]))


@pytest.mark.parametrize(
    ("count", "expected"),
    [(0, []), (1, [0]), (3, [0, 4, 8]), (4, [0, 3, 6, 9]), (10, [*range(10)]), (99, [*range(10)])],
)
def test_spaced_items_are_at_most_as_many_as_asked_for(count: int, expected: list[int]) -> None:
    assert list(figures.spaced(range(10), count)) == expected
    assert list(figures.spaced([], count)) == []
