"""Speckles: small islands of depth, whatever stands beside them."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.geometry.dense_stereo import consistency as module
from clear_strategies.geometry.dense_stereo.consistency import speckles


def map_with_islands() -> torch.Tensor:
    depth = torch.full((12, 16), torch.nan)
    depth[:, :8] = torch.linspace(2.0, 2.6, 8)  # a slanted surface: neighbours differ by 4 %
    depth[4:6, 3:5] = 5.0  # an island of four in it
    depth[8, 12] = 2.0  # one of its own
    return depth


@pytest.mark.parametrize(("fewest", "count"), [(0, 0), (1, 0), (2, 1), (4, 1), (5, 5), (1000, 97)])
def test_islands_of_fewer_pixels_are_found(fewest: int, count: int) -> None:
    found = speckles(map_with_islands(), fewest, 0.05)
    assert int(found.sum()) == count


def test_what_is_alike_depends_on_the_ratio_of_depths_alone() -> None:
    depth = map_with_islands()
    assert torch.equal(speckles(depth, 5, 0.05), speckles(1e-6 * depth, 5, 0.05))
    assert int(speckles(depth, 13, 0.02).sum()) == 97  # each column is an island of twelve


def test_without_scipy_every_depth_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "missing", lambda *_: "scipy")
    assert not speckles(map_with_islands(), 5, 0.05).any()
