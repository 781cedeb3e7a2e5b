"""The rule of integration/colours.py where test_any_loop.py does not tell: of leaves as torch has them, before a pass."""

import pytest
import torch
from torch.nn import Parameter

from integration.colours import are_joined

CHANGES = {
    "none": lambda p, colors: None,
    "a hook that keeps the gradient": lambda p, colors: colors.retain_grad(),
    "other leaves": lambda p, colors: p.update(sh0=Parameter(torch.ones(3, 1, 3))),
    "one leaf": lambda p, colors: p.pop("shN"),
}


def joined(dtype=torch.float32, dim=1):
    p = {"sh0": Parameter(torch.ones(3, 1, 3, dtype=dtype)), "shN": Parameter(torch.ones(3, 15, 3))}
    return p, torch.cat((p["sh0"], p["shN"]), dim)


@pytest.mark.parametrize("changed", CHANGES)
@pytest.mark.parametrize("dim", [1, -2])
def test_factors_are_the_whole_gradient_where_two_leaves_lie_side_by_side_and_nowhere_else(changed, dim):
    p, colors = joined(dim=dim)
    CHANGES[changed](p, colors)
    assert are_joined(colors, p) == (changed == "none")


def test_the_two_have_the_type_that_was_drawn():
    p, colors = joined(torch.float16)  # torch joins them in the wider
    assert not are_joined(colors, p)
