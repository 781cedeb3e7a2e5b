"""Tiles join without seams, and equal the whole image where the overlap covers the receptive field."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies.data.priors.tiling import tiled
from tests.helpers.networks import photo


@given(
    height=st.integers(1, 40), width=st.integers(1, 40), overlap=st.integers(0, 4), more=st.integers(1, 20),
    factor=st.sampled_from([1, 2, 4]), seed=st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=40, deadline=None)
def test_tiles_join_to_the_whole_where_the_overlap_reaches_as_far_as_the_network_sees(
    height: int, width: int, overlap: int, more: int, factor: int, seed: int
) -> None:
    kernel = torch.randn(3, 1, 2 * overlap + 1, 2 * overlap + 1, generator=torch.Generator().manual_seed(seed))
    tile = 4 * overlap + more

    def upscale(lr: Tensor) -> Tensor:
        assert whole_image or max(lr.shape[:2]) <= tile
        blurred = F.conv2d(lr.permute(2, 0, 1)[None], kernel, padding=overlap, groups=3)
        return F.interpolate(blurred, scale_factor=factor)[0].permute(1, 2, 0)

    lr = photo(height, width, seed)
    whole_image = False
    joined = tiled(upscale, lr, factor, tile, overlap)
    whole_image = True
    assert torch.allclose(joined, upscale(lr), atol=1e-4)


def test_tiles_that_differ_are_faded_into_each_other() -> None:
    """Two tiles of different grey: along a row, the result changes by one ramp's slope per pixel."""
    greys = iter([0.0, 1.0])
    joined = tiled(lambda lr: torch.full((4 * lr.shape[0], 4 * lr.shape[1], 3), next(greys)), photo(8, 80), 4, 72, 8)
    row = joined[0, :, 0]
    # The shares meet at LR 40, HR 160; 8 LR pixels on both sides are 64 HR pixels of ramp.
    assert torch.all(row[:128] == 0)
    assert torch.all(row[192:] == 1)
    assert torch.allclose(row[128:192], (torch.arange(64) + 0.5) / 64)
