"""Where the gradient of the colours takes the short way: as factors Y ⊗ ∇rgb, in place of a tensor as wide as the colours.

The rule. In a backward pass, factors are taken only where
    1. the pass has queued the merge of the rendering that it has reached,
    2. it adds to `.grad` of the leaves sh0 and shN, both, and
    3. every node between the drawing and these leaves is known to pass the gradient on unchanged: the tensor that was drawn is
       `cat((sh0, shN), 1)` of the leaves themselves, and no hook looks at it, at sh0 or at shN.
Any other gradient goes the way that autograd gives it, whole. So an offset, a sum, a cast, a scale or a view on the way needs no
thought here: it makes another node, and the rule does not hold. `Attachment` knows 1. All are asked when the pass has reached the
drawing, since a loop may freeze, hook or replace what it likes before.

The gradient of HR is taken by part 3 alone: its pass is this package's own.

Torch shows no hooks of nodes (`tensor.grad_fn.register_hook`); such a hook on the `cat` or on a leaf's node is not called.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import torch
from torch import Tensor

_JOINS: Final = "CatBackward0"


def are_joined(colors: Tensor, params: Mapping[str, Tensor]) -> bool:
    """Part 3: whether the gradient of `colors` is that of the leaves sh0 and shN side by side, and nobody looks at it."""
    leaves = [params[name] for name in ("sh0", "shN") if name in params]
    node: Any = colors.grad_fn
    if node is None or node.name() != _JOINS:  # of their shapes, only along the bands
        return False
    if len(leaves) != 2 or any(not p.requires_grad or p.dtype != colors.dtype for p in leaves):
        return False
    if [before for before, _ in node.next_functions] != [_accumulator(p) for p in leaves]:
        return False
    return not (colors.retains_grad or any(map(is_hooked, (colors, *leaves))))


def are_accumulated(params: Mapping[str, Tensor]) -> bool:
    """Part 2: whether the backward pass under way adds to `.grad` of sh0 and shN."""
    try:
        return all(torch._C._will_engine_execute_node(_accumulator(params[name])) for name in ("sh0", "shN"))
    except RuntimeError:  # what torch does in a pass of `torch.autograd.grad` for one of them
        return False


def is_hooked(x: Tensor) -> bool:
    """Whether a hook looks at the gradient of a tensor, and may change it."""
    return bool(x._backward_hooks or getattr(x, "_post_accumulate_grad_hooks", None))


def _accumulator(leaf: Tensor) -> Any:
    """The node that adds to a leaf's `.grad`."""
    return torch.autograd.graph.get_gradient_edge(leaf).node
