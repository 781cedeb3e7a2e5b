"""The parents of Gaussians, found by comparing parameters before and after a change."""

from __future__ import annotations

import torch

from integration.inria.rows import find_change
from integration.lineage import change_of


def gaussians(*x, colours=None, rotation=0.0):
    """Gaussians at (x, 0, 0); their colours are x unless given."""
    means = torch.tensor([[value, 0.0, 0.0] for value in x])
    sh0 = torch.tensor([[[value, 0.0, 0.0]] for value in (x if colours is None else colours)])
    return {"means": means, "quats": torch.tensor([[1.0, rotation, 0.0, 0.0]]).repeat(len(x), 1), "sh0": sh0}


def test_clones_splits_and_pruned_gaussians_are_found():
    before = gaussians(1.0, 2.0, 3.0, 4.0)
    assert find_change(before, gaussians(1.0, 2.0, 3.0, 4.0)) is None
    # 2 is pruned, 3 is cloned, 4 is split in two that keep its colour.
    change = find_change(before, gaussians(1.0, 3.0, 3.0, 3.9, 4.2, colours=(1.0, 3.0, 3.0, 4.0, 4.0)))
    assert change.parents.tolist() == [0, 2, 2, 3, 3]
    assert change.fresh.tolist() == [False, False, True, True, True]


def test_the_nearest_of_equal_colours_is_the_parent():
    before = gaussians(1.0, 2.0, 3.0, colours=(7.0, 7.0, 7.0))
    change = find_change(before, gaussians(1.0, 2.0, 2.9, 1.2, colours=(7.0, 7.0, 7.0, 7.0)))
    assert change.parents.tolist() == [0, 1, 2, 0]
    assert change.fresh.tolist() == [False, False, True, True]


def test_a_new_colour_or_rotation_has_no_parent():
    assert find_change(gaussians(1.0), gaussians(1.0, 5.0)).parents.tolist() == [0, -1]
    assert find_change(gaussians(1.0), gaussians(1.0, rotation=0.5)).parents.tolist() == [-1]


def test_empty_sets_can_be_compared():
    empty = {name: tensor[:0] for name, tensor in gaussians(1.0).items()}
    assert find_change(empty, gaussians(1.0)).parents.tolist() == [-1]
    assert find_change(gaussians(1.0), empty).parents.tolist() == []


def test_of_rows_with_one_parent_the_one_that_kept_its_place_is_the_old_gaussian():
    relocated = change_of(torch.tensor([2, 1, 2, 3]), 4)  # row 0 was moved onto 2
    assert relocated.fresh.tolist() == [True, False, False, False]
    pruned_and_split = change_of(torch.tensor([1, 3, 3]), 4)
    assert pruned_and_split.fresh.tolist() == [False, False, True]
    assert change_of(torch.arange(4), 4) is None
    assert change_of(torch.arange(3), 4).fresh.tolist() == [False, False, False]
