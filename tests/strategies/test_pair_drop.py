"""Two dropped subsets of a field, compared at a size that shows low frequencies alone."""

from __future__ import annotations

import torch

from clear_strategies import PairDrop
from clear_strategies.strategies.base import Drawn
from clear_strategies.training.loop import EXTRA_LOSS, iterate
from tests.helpers import toy
from tests.helpers.short_run import SCENE, start


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
