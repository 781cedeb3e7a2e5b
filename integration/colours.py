"""Conditions under which the gradient of the colours may stay the factors Y ⊗ ∇rgb, instead of a tensor as wide as the colours.

In a backward pass, all of these conditions must hold:
    1. the pass has queued the merge of the rendering that it has reached,
    2. it adds to `.grad` of both leaves, sh0 and shN, and
    3. every node between the drawing and these leaves passes the gradient on unchanged: the drawn tensor is
       `cat((sh0, shN), 1)` of the leaves themselves, and neither it nor sh0 nor shN has a hook.
Any other gradient takes autograd's path, in full. An offset, a sum, a cast, a scale or a view between the two makes another node,
so condition 3 does not hold. `Attachment` checks condition 1. All are checked when the pass has reached the drawing, since until
then a loop may freeze, hook or replace tensors.

The gradient of HR needs only condition 3, since its backward pass is this package's own.

Torch does not list hooks of nodes (`tensor.grad_fn.register_hook`); such a hook on the `cat` or on a leaf's node is not called.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from rasterizers.torch_internals import accumulates, accumulator, is_cat, is_hooked


def are_joined(colors: Tensor, params: Mapping[str, Tensor]) -> bool:
    """Condition 3: whether the gradient of `colors` is that of the leaves sh0 and shN side by side, without any hook."""
    leaves = [params[name] for name in ("sh0", "shN") if name in params]
    node: Any = colors.grad_fn
    if node is None or not is_cat(node):  # with these shapes, it can only join bands
        return False
    if len(leaves) != 2 or any(not p.requires_grad or p.dtype != colors.dtype for p in leaves):
        return False
    if [before for before, _ in node.next_functions] != [*map(accumulator, leaves)]:
        return False
    return not (colors.retains_grad or any(map(is_hooked, (colors, *leaves))))


def are_accumulated(params: Mapping[str, Tensor]) -> bool:
    """Condition 2: whether the running backward pass adds to `.grad` of sh0 and shN."""
    return accumulates(params["sh0"]) and accumulates(params["shN"])
