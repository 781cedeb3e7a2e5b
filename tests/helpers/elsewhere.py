"""A device that is not the CPU, on the CPU: operations on tensors of both fail, as they do on CUDA.

Tensors there wrap tensors of the CPU. Modules that take memory without asking torch (numpy, compiled kernels) refuse them.
"""

from __future__ import annotations

from typing import Any, Final

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME: Final = "elsewhere"
_COPIES: Final = {torch.ops.aten.copy_.default, torch.ops.aten._to_copy.default}


class There(torch.Tensor):
    """A tensor of the other device."""

    here: torch.Tensor

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> There:
        options = {"dtype": here.dtype, "device": f"{NAME}:0", "requires_grad": here.requires_grad}
        made = torch.Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), storage_offset=here.storage_offset(), **options
        )
        made.here = here
        return made

    def __repr__(self, **_: Any) -> str:
        return f"There({self.here!r})"

    def tolist(self) -> Any:
        return self.here.tolist()

    def new_tensor(self, data: Any, **options: Any) -> There:
        return There(self.here.new_tensor(data, **options))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


class Elsewhere(TorchDispatchMode):
    """A scope in which torch knows the other device. It stays registered: use it in a process of its own."""

    def __enter__(self) -> Elsewhere:
        from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

        _setup_privateuseone_for_python_backend(NAME)
        super().__enter__()
        return self

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or {})


def _run(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [x for x in tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
    there = any(isinstance(x, There) for x in tensors)
    mixed = there and any(not isinstance(x, There) and x.dim() > 0 for x in tensors)
    if mixed and func not in _COPIES and func is not torch.ops.aten.index.Tensor:
        raise RuntimeError(f"Expected all tensors to be on the same device, but {func} found at least two devices.")
    args, kwargs = (tree_map(lambda x: x.here if isinstance(x, There) else x, x) for x in (args, kwargs))
    if kwargs.get("device") is not None:
        there = torch.device(kwargs["device"]).type == NAME
        kwargs["device"] = "cpu"
    known = {id(x.here): x for x in tensors if isinstance(x, There)}  # what is changed in place is returned itself

    def sent(x: Any) -> Any:
        return known.get(id(x), There(x)) if there and isinstance(x, torch.Tensor) else x

    return tree_map(sent, func(*args, **kwargs))
