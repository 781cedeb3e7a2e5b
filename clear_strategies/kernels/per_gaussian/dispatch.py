"""Which implementation computes a function of `reference`: torch, or a function of the same name and arguments."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from typing import Any, Final, ParamSpec, TypeVar

import torch
from torch import Tensor

from clear_strategies.kernels import native
from clear_strategies.kernels.per_gaussian import cpp
from rasterizers.warp_runtime import runs_warp

P = ParamSpec("P")
T = TypeVar("T")

DEVICES: Final = {"cuda"}
"""Where Warp's kernels are used; tests add the CPU."""


def by_cpp(function: Callable[P, T]) -> Callable[P, T]:
    """C++ computes it where it takes the tensors among the arguments as they lie."""
    compiled: Callable[P, T] = getattr(cpp, function.__name__)

    @wraps(function)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> T:
        given = _tensors(args)
        takes = native.takes(*filter(torch.is_floating_point, given)) and all(x.is_contiguous() for x in given)
        return (compiled if takes else function)(*args, **kwargs)

    return chosen


def by_warp(function: Callable[P, T]) -> Callable[P, T]:
    """Warp computes it where it takes the tensors among the arguments: float32 on CUDA, with Warp installed."""

    @wraps(function)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> T:
        given = _tensors(args)
        takes = all(x.device.type in DEVICES and (x.dtype == torch.float32 or not x.is_floating_point()) for x in given)
        if not takes or not runs_warp(given[0].device.type):
            return function(*args, **kwargs)
        from clear_strategies.kernels.per_gaussian import warp

        compiled: Callable[P, T] = getattr(warp, function.__name__)
        return compiled(*args, **kwargs)

    return chosen


def _tensors(arguments: Iterable[Any]) -> list[Tensor]:
    return [x for x in arguments if isinstance(x, Tensor)]
