"""Views: the depth map of a photo at a smaller size."""

from __future__ import annotations

import torch

from clear_strategies.core.view import DepthMap


def test_a_reduced_depth_map_holds_the_median_of_each_block_of_which_enough_is_known():
    depth = torch.full((4, 6), torch.nan)
    confidence = torch.zeros(4, 6)
    depth[:2, 0], depth[0, 1] = torch.tensor([1.0, 2.0]), 9.0  # three of four pixels: a median that no outlier moves
    confidence[:2, 0], confidence[0, 1] = 0.5, 0.8
    depth[2, 2], confidence[2, 2] = 3.0, 1.0  # one of four: too few
    small = DepthMap(depth, confidence).reduced(2)
    assert small.depth.shape == (2, 3)
    assert small.depth[0, 0] == 2.0
    assert torch.isclose(small.confidence[0, 0], torch.tensor(0.6))
    assert int(small.known.sum()) == 1
    assert bool(small.depth.isfinite().sum() == 1)


def test_a_depth_map_is_completed_only_where_it_knows_nothing():
    mine = DepthMap(torch.tensor([[1.0, torch.nan]]), torch.tensor([[0.5, 0.0]]))
    whole = mine.completed_by(DepthMap(torch.tensor([[7.0, 8.0]]), torch.tensor([[0.9, 0.4]])))
    assert whole.depth.tolist() == [[1.0, 8.0]]
    assert torch.equal(whole.confidence, torch.tensor([[0.5, 0.4]]))
