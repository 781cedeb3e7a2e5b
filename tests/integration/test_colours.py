"""The rule of integration/colours.py, by what torch says of a graph: a version that names its nodes otherwise fails here."""

import pytest
import torch
from torch.nn import Parameter

from integration.colours import are_joined
from tests.helpers.loops import COLOURS


def params():
    """Of three Gaussians; the others are what `COLOURS` may add."""
    shapes = {"sh0": (3, 1, 3), "shN": (3, 15, 3), "means": (3, 3), "offset": (1, 1, 3), "gain": (1,)}
    shapes |= {"bands": (3, 16, 3)}
    return {name: Parameter(torch.ones(shape)) for name, shape in shapes.items()}


@pytest.mark.parametrize("how", COLOURS)
def test_factors_are_the_whole_gradient_where_two_leaves_lie_side_by_side_and_nowhere_else(how):
    p = params()
    assert are_joined(COLOURS[how](p), p) == (how in ("joined", "negative dimension"))


def test_the_two_have_the_type_that_was_drawn():
    p = params()
    p["sh0"] = Parameter(torch.ones(3, 1, 3, dtype=torch.float16))
    assert not are_joined(COLOURS["joined"](p), p)


CHANGES = [
    lambda p, colors: colors.retain_grad(),
    lambda p, colors: colors.register_hook(lambda g: None),
    lambda p, colors: p["sh0"].register_hook(lambda g: None),
    lambda p, colors: p["shN"].register_post_accumulate_grad_hook(lambda q: None),
    lambda p, colors: p["shN"].requires_grad_(False),
    lambda p, colors: p.update(sh0=Parameter(torch.ones(3, 1, 3))),
    lambda p, colors: p.pop("shN"),
]


@pytest.mark.parametrize("changes", CHANGES)
def test_no_hook_looks_at_them_and_the_leaves_are_those_that_train(changes):
    p = params()
    colors = COLOURS["joined"](p)
    assert are_joined(colors, p)
    changes(p, colors)
    assert not are_joined(colors, p)
