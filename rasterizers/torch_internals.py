"""All that this package uses of torch without a public name.

torch has each since 2.6, the oldest version that is supported, or longer, unless a later one is named; up to 2.13, none has a
public name. Where a torch has changed what an entry says, tests/rasterizers/test_torch_internals.py fails under the entry's name.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from typing import Any

import torch
from torch import Tensor
from torch.utils import _python_dispatch, _pytree

TorchDispatchMode = _python_dispatch.TorchDispatchMode
"""A context that sees every operation of its thread below autograd. torch's tutorials name it."""

tree_leaves = _pytree.tree_leaves
"""The values in nested tuples, lists and dictionaries."""


def current_pass() -> int:
    """The number of the backward pass that runs in this thread, another one for each pass; -1: none runs."""
    number: int = torch._C._current_graph_task_id()
    return number


def when_pass_ends(call: Callable[[], None]) -> None:
    """Have the running backward pass call this once, after all of its gradients and what others have it call, and before
    `backward()` returns: DistributedDataParallel then writes `.grad`. A pass that fails does not call it.
    """
    queue = torch.autograd.Variable._execution_engine.queue_callback
    queue(lambda: queue(call))


def accumulator(leaf: Tensor) -> Any:
    """The node that adds to a leaf's `.grad`."""
    return torch.autograd.graph.get_gradient_edge(leaf).node


def leaf_of(node: Any) -> Tensor | None:
    """The leaf of an `accumulator`; None: another node."""
    leaf: Tensor | None = getattr(node, "variable", None)
    return leaf


def of_gradient(edge: torch.autograd.graph.GradientEdge) -> tuple[torch.Size, torch.dtype]:
    """The shape and the type of the gradient that arrives at an edge."""
    metadata: Any = edge.node._input_metadata[edge.output_nr]
    return torch.Size(metadata.shape), metadata.dtype


def base_of(x: Tensor) -> Tensor:
    """The tensor in the graph whose memory a view shows; itself if there is none. A view that is written in place gets another
    node, that of the tensor stays in the graph. What a node of one's own returns as a view has a base outside of the graph.
    """
    return x if x._base is None or x._base.grad_fn is None else x._base


def is_cat(node: Any) -> bool:
    """Whether a node is that of `torch.cat`."""
    return bool(node.name() == "CatBackward0")


def accumulates(leaf: Tensor) -> bool:
    """Whether the running backward pass adds to a leaf's `.grad`."""
    try:
        return torch._C._will_engine_execute_node(accumulator(leaf))
    except RuntimeError:  # raised in a pass of `torch.autograd.grad` for this leaf
        return False


def is_hooked(x: Tensor) -> bool:
    """Whether the gradient of a tensor has a hook, which may change it."""
    return bool(hooks_on_gradient(x) or hooks_after_accumulation(x))


def hooks_on_gradient(x: Tensor) -> MutableMapping[int, Callable[[Tensor], Any]]:
    """The hooks of `register_hook`, by their handles' numbers; torch calls what it finds in the mapping."""
    return x._backward_hooks or {}


def hooks_after_accumulation(leaf: Tensor) -> MutableMapping[int, Callable[[Tensor], Any]]:
    """The hooks of `register_post_accumulate_grad_hook`, by their handles' numbers; torch calls what it finds in the mapping."""
    return getattr(leaf, "_post_accumulate_grad_hooks", None) or {}


def version(x: Tensor) -> int:
    """How often a tensor was written in place, by itself or by a view of it; 0 in inference mode, where torch does not count."""
    return 0 if x.is_inference() else x._version


def is_transformed() -> bool:
    """Whether a transform of torch.func runs: grad, vmap, jvp …."""
    return torch._C._functorch.peek_interpreter_stack() is not None


def copy_each(pairs: Sequence[tuple[Tensor, Tensor]]) -> None:
    """`x.copy_(y)` of each pair, on a device by one kernel for those of one type and layout."""
    torch._foreach_copy_([x for x, _ in pairs], [y for _, y in pairs])


def writes(operation: Any) -> bool:
    """Whether an operation, as a `TorchDispatchMode` gets it, writes to one of its arguments."""
    return bool(operation._schema.is_mutable)


def reads_number(operation: Any) -> bool:
    """Whether an operation, as a `TorchDispatchMode` gets it, is that of `item()`, `bool()`, `int()`, `float()`."""
    return operation.overloadpacket is torch.ops.aten._local_scalar_dense


def end_failed_pool(device: int, pool: Any) -> None:
    """Have torch's allocator leave the pool of a capture that CUDA has ended with an error (2.8; earlier, it has left it)."""
    with suppress(AttributeError, RuntimeError):
        torch._C._cuda_endAllocateToPool(device, pool)
        torch._C._cuda_releasePool(device, pool)
