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


class OtherTensor(torch.Tensor):
    """A tensor on the other device."""

    on_cpu: torch.Tensor

    @staticmethod
    def __new__(cls, on_cpu: torch.Tensor) -> OtherTensor:
        options = {"dtype": on_cpu.dtype, "device": f"{NAME}:0", "requires_grad": on_cpu.requires_grad}
        tensor = torch.Tensor._make_wrapper_subclass(
            cls, on_cpu.size(), strides=on_cpu.stride(), storage_offset=on_cpu.storage_offset(), **options
        )
        tensor.on_cpu = on_cpu
        return tensor

    def __repr__(self, **_: Any) -> str:
        return f"OtherTensor({self.on_cpu!r})"

    def tolist(self) -> Any:
        return self.on_cpu.tolist()

    def new_tensor(self, data: Any, **options: Any) -> OtherTensor:
        return OtherTensor(self.on_cpu.new_tensor(data, **options))

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
    on_other = any(isinstance(x, OtherTensor) for x in tensors)
    mixed = on_other and any(not isinstance(x, OtherTensor) and x.dim() > 0 for x in tensors)
    if mixed and func not in _COPIES and func is not torch.ops.aten.index.Tensor:
        raise RuntimeError(f"Expected all tensors to be on the same device, but {func} found at least two devices.")
    args, kwargs = (tree_map(lambda x: x.on_cpu if isinstance(x, OtherTensor) else x, x) for x in (args, kwargs))
    if kwargs.get("device") is not None:
        on_other = torch.device(kwargs["device"]).type == NAME
        kwargs["device"] = "cpu"
    known = {
        id(x.on_cpu): x for x in tensors if isinstance(x, OtherTensor)
    }  # what is changed in place is returned itself

    def sent(x: Any) -> Any:
        return known.get(id(x), OtherTensor(x)) if on_other and isinstance(x, torch.Tensor) else x

    return tree_map(sent, func(*args, **kwargs))
