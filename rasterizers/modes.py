"""Decorators that turn off modes of torch in which a loop may call this package: `torch.compile`, `torch.autocast`, autograd, and
the default device.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final, ParamSpec, TypeVar

import torch

_P = ParamSpec("_P")
_R = TypeVar("_R")
_NO_AUTOGRAD: Final = "Autograd is off here: compute under torch.enable_grad(), from x.detach().requires_grad_()."


def in_full_precision(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function with torch's autocast off, which would multiply matrices in half precision."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        cast = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
        if not cast:
            return function(*args, **kwargs)
        with ExitStack() as exact:
            for device in cast:
                exact.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return called


def apart_from_the_loop(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function with torch's autocast and autograd off, so that it runs in the same modes in each loop and stores no graph.

    If code that it calls, such as a strategy's, needs autograd, the error says how to turn it on.
    """
    apart = in_full_precision(torch.no_grad()(function))

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        try:
            return apart(*args, **kwargs)
        except RuntimeError as error:
            if "does not require grad" in str(error) and not hasattr(error, "__notes__"):
                error.add_note(_NO_AUTOGRAD)
            raise

    return called


def on_cpu_by_default(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function with the CPU as torch's default device, which a loop may have changed: photos are worked on there.

    Each operation inside takes some microseconds longer, so this is for work that is done once.
    """

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with torch.device("cpu"):
            return function(*args, **kwargs)

    return called


def uncompiled(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """The function, called outside of the graph by code that `torch.compile` compiles: kernels take memory, not traces."""

    @functools.wraps(function)
    def called(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if torch.compiler.is_compiling():
            apart: Callable[_P, _R] = torch.compiler.disable(function)  # type: ignore[no-untyped-call]
            return apart(*args, **kwargs)  # not at import, where it would take a second
        return function(*args, **kwargs)

    return called
