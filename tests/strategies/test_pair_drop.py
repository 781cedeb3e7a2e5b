"""Two dropped subsets of a field, compared at a size that shows low frequencies alone."""

from __future__ import annotations

import pytest
import torch

from clear_strategies import PairDrop
from clear_strategies.core.seeds import dropout_mask
from clear_strategies.strategies.base import Drawn
from clear_strategies.training.loop import EXTRA_LOSS, iterate
from tests.helpers import toy
from tests.helpers.short_run import SCENE, start


def test_a_subset_is_a_function_of_seed_and_draw_and_keeps_the_mean_opacity():
    def mask(seed: int, draw: int) -> torch.Tensor:
        return dropout_mask(4_000, p=0.25, seed=seed, t=draw)

    assert sorted(set(mask(0, 1).tolist())) == pytest.approx([0, 1 / 0.75])
    assert float(mask(0, 1).mean()) == pytest.approx(1, abs=0.03)
    assert torch.equal(mask(0, 1), mask(0, 1))
    assert not torch.equal(mask(0, 1), mask(0, 2))


def test_one_subset_learns_what_another_shows_of_a_training_view():
    state = start(("gco",), more=[PairDrop(share=0.5, start=4)])
    for _ in range(8):
        iterate(state, toy.RASTERIZER)
    rows = state.history_as_floats()
    assert [int(row["t"]) for row in rows if EXTRA_LOSS in row] == [4, 6, 8]
    assert all(row[EXTRA_LOSS] > 0 for row in rows if EXTRA_LOSS in row)
    strategy, gates = state.conductor.strategies[-1], []

    def draw(camera, gate):
        gates.append(gate)
        assert camera.width == SCENE.train[0].lr.camera.width // 2
        return torch.zeros(camera.height, camera.width, 3)

    (extra,) = strategy.drawn_views(4, Drawn(state.field.means.data, draw, lambda image, factor: image))
    assert not torch.equal(extra.gate(50), gates[0](50))


@pytest.mark.parametrize("changed", [{"share": 1.0}, {"weight": 0.0}, {"reduced": 0}, {"every": 0}])
def test_settings_outside_their_range_are_refused(changed):
    with pytest.raises(ValueError, match=next(iter(changed))):
        PairDrop(**changed)
