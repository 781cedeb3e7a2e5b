"""Completed depth: planes go on, surfaces end where colours change, outliers do not count."""

from __future__ import annotations

import torch
from torch import Tensor

from clear_strategies.geometry.completion import completed

H, W = 24, 32
V, U = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
PLANE = 0.5 + 0.004 * U - 0.006 * V


def grey(values: Tensor) -> Tensor:
    return values[..., None].expand(-1, -1, 3).float()


def complete(known: Tensor, image: Tensor | None = None) -> Tensor:
    return completed(known, torch.ones(H, W), grey(torch.full((H, W), 0.5)) if image is None else image)


def test_a_plane_is_completed_inside_and_continued_outside() -> None:
    known = PLANE.clone()
    known[8:16, 10:20] = torch.nan
    known[:, 26:] = torch.nan
    error = (complete(known) / PLANE - 1).abs()
    assert error[:, :26].max() < 1e-3
    assert error.max() < 0.03


def test_two_surfaces_meet_where_the_colour_changes() -> None:
    right = U >= 18
    image = grey(right.double())
    known = torch.where(right, 1.0, 0.2).double()
    known[:, 6:26] = torch.nan  # the edge itself is not known
    result = complete(known, image)
    assert (result[:, :17] - 0.2).abs().max() < 0.01
    assert (result[:, 19:] - 1.0).abs().max() < 0.01


def test_an_outlier_does_not_count() -> None:
    known = PLANE.clone()
    known[U % 3 > 0] = torch.nan
    wrong = known.clone()
    wrong[12, 15] = 3.0
    assert (complete(wrong) - complete(known)).abs().max() < 0.01


def test_one_known_pixel_is_the_depth_of_all_of_a_photo_of_any_size() -> None:
    for h, w in ((1, 1), (1, 2), (2, 2), (2, 5), (H, W)):
        known = torch.full((h, w), torch.nan, dtype=torch.float64)
        known[h // 2, w // 2] = 0.25
        result = completed(known, torch.ones(h, w), torch.rand(h, w, 3))
        assert torch.allclose(result, torch.tensor(0.25, dtype=torch.float64), rtol=1e-6)
