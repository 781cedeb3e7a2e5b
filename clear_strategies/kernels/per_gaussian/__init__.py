"""The computations of an iteration for each Gaussian, apart from rendering and the optimizer's step.

`reference` specifies them in torch. `warp` has functions of the same names and arguments for CUDA, in a few kernels instead of
one for each operation, and `cpp` those in which torch is slow on a CPU. This module chooses one;
tests/kernels/test_per_gaussian.py compares them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import ParamSpec, TypeVar

from torch import Tensor

from clear_strategies.core.evidence import Evidence
from clear_strategies.kernels import native
from clear_strategies.kernels.per_gaussian import cpp, reference

P = ParamSpec("P")
T = TypeVar("T")


def _fastest(function: Callable[P, T]) -> Callable[P, T]:
    """The function, computed by C++ or Warp if they have a function of its name that takes the tensors of the arguments."""

    @wraps(function)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> T:
        tensors = [x for arg in args for x in _tensors(arg)]
        kernels = native.implementation(__name__, *tensors)
        if kernels is cpp and not all(x.is_contiguous() for x in tensors):
            return function(*args, **kwargs)
        fastest: Callable[P, T] = getattr(kernels, function.__name__, function)
        return fastest(*args, **kwargs)

    return chosen


def _tensors(argument: object) -> Sequence[Tensor]:
    if isinstance(argument, Evidence):  # a strategy's, of any type
        return argument.reliability, argument.demand
    return [argument] if isinstance(argument, Tensor) else []


accumulate = _fastest(reference.accumulate)
activate = _fastest(reference.activate)
evidence = _fastest(reference.evidence)
evidence_score = _fastest(reference.evidence_score)
nearest_depths = _fastest(reference.nearest_depths)
route = _fastest(reference.route)
screens = _fastest(reference.screens)
wander = _fastest(reference.wander)
