"""Which implementation computes a function of `reference`: torch, or a function of the same name and arguments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from types import ModuleType
from typing import Final, ParamSpec, TypeVar

import torch
from torch import Tensor

from clear_strategies.core.evidence import Evidence
from clear_strategies.kernels import native
from clear_strategies.kernels.per_gaussian import cpp
from rasterizers.warp_runtime import runs_warp

P = ParamSpec("P")
T = TypeVar("T")

DEVICES: Final = {"cuda"}
"""Where Warp's kernels are used; tests add the CPU."""


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """C++ or Warp computes it where they have a function of that name, and take the tensors among the arguments."""

    @wraps(function)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> T:
        kernels = _kernels([x for arg in args for x in _tensors(arg)])
        fastest: Callable[P, T] = getattr(kernels, function.__name__, function)
        return fastest(*args, **kwargs)

    return chosen


def _tensors(argument: object) -> Sequence[Tensor]:
    if isinstance(argument, Evidence):  # a strategy's, of any type
        return argument.reliability, argument.demand
    return [argument] if isinstance(argument, Tensor) else []


def _kernels(given: Sequence[Tensor]) -> ModuleType | None:
    """C++ for contiguous tensors on a CPU, Warp on CUDA, both for float32; None: torch."""
    if any(x.is_floating_point() and x.dtype != torch.float32 for x in given):
        return None
    if native.available() and all(x.device.type == "cpu" and x.is_contiguous() for x in given):
        return cpp
    if all(x.device.type in DEVICES for x in given) and runs_warp(given[0].device.type):
        from clear_strategies.kernels.per_gaussian import warp

        return warp
    return None
