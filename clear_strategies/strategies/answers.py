"""Checks of the strategies' answers. An error names strategy, hook, rule, and what was found.

Numbers are checked in the CPU's memory only; to read those of a device, the host would wait.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NoReturn

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.finite import is_finite, pixels_not_finite, rows_not_finite
from clear_strategies.core.gradients import Grads, in_our_shapes
from clear_strategies.core.step import Losses
from clear_strategies.errors import AnswerError
from clear_strategies.strategies.base import Scale, Strategy
from rasterizers.torch_internals import version


def require_stored(s: Strategy, params: Mapping[str, Tensor]) -> None:
    """Check that `state` and `run_state` are what a checkpoint can give back."""
    if not (s.state or s.run_state):  # without an address of each parameter in each iteration
        return
    n = {len(p) for p in params.values()}
    of_parameters = [range(p.data_ptr(), p.data_ptr() + p.nbytes) for p in params.values() if p.data_ptr()]
    taken = set[int]()
    for where, tensors in (("state", s.state), ("run_state", s.run_state)):
        for name, x in tensors.items():
            entry = f"{type(s).__name__}.{where}[{name!r}]"
            if not isinstance(name, str):
                raise AnswerError(
                    f"{entry} must have a text as its key, which is what checkpoints keep, got {name!r:.80}."
                )
            if where == "state" and (not isinstance(x, Tensor) or (n and x.dim() > 0 and len(x) not in n)):
                raise AnswerError(
                    f"{entry} must be a tensor with a row for each Gaussian, {min(n, default=0)}, or without dimensions, got "
                    f"{_shown(x)}. Other tensors belong in run_state, and what can be computed again in cache."
                )
            if not isinstance(x, Tensor) or x.layout is not torch.strided or (where == "run_state" and x.requires_grad):
                raise AnswerError(
                    f"{entry} must be a tensor that requires no gradient, got {_shown(x)}. Hooks turn autograd on for a copy, "
                    "x.detach().requires_grad_()."
                )
            address = x.data_ptr()  # 0: the tensor has no memory
            shares = any(size > 1 and step == 0 for size, step in zip(x.shape, x.stride(), strict=True))
            if address and (shares or address in taken or any(address in memory for memory in of_parameters)):
                raise AnswerError(
                    f"{entry} must be a tensor of its own, got the memory of a parameter, of another tensor that is stored, or "
                    "of other rows (expand), which changes with it. Store its clone()."
                )
            taken.add(address)


@contextmanager
def unchanged(s: Strategy, hook: str, shown: Mapping[str, Tensor], remedy: str) -> Iterator[None]:
    """A scope in which a hook may write to none of the tensors that it is shown."""
    before = {name: version(x) for name, x in shown.items()}
    yield
    if written := [name for name, x in shown.items() if version(x) != before[name]]:
        raise AnswerError(f"{_named(s, hook)} must not change {written[0]} in place: {remedy}.")


def require_finite(s: Strategy, hook: str, numbers: Mapping[str, float | Tensor]) -> None:
    for name, x in numbers.items():
        # No tensor is made of a number, which a recording could not copy to the device.
        finite = math.isfinite(x) if not isinstance(x, Tensor) else not deferred.is_immediate(x) or is_finite(x)
        if not finite:
            found = rows_not_finite(x) if isinstance(x, Tensor) and x.dim() else f"is {float(x)}"
            raise AnswerError(f"{_named(s, hook)} must give finite numbers, but {name} {found}.")


def require_finite_cotangents(s: Strategy, scale: Scale, given: Losses, cotangents: Float[Tensor, "K H W 3"]) -> None:
    """Finite numbers, unless the losses that the strategy was given are not finite, of which another error tells."""
    from_others = any(isinstance(x, float) and not math.isfinite(x) for x in given.values.values())
    if not from_others and deferred.is_immediate(cotangents) and not is_finite(cotangents):
        found = f"at {scale.upper()} its gradient of the image {pixels_not_finite(cotangents)}"
        raise AnswerError(f"{_named(s, 'compare')} must give finite cotangents, but {found}.")


def require_not_negative(s: Strategy, hook: str, name: str, x: Tensor) -> None:
    """Finite numbers >= 0."""
    if x.numel() == 0 or not deferred.is_immediate(x):
        return
    least, most = torch.stack(x.float().aminmax()).tolist()  # comparisons of each number take ten times as long
    if not (least >= 0 and most < math.inf):
        raise AnswerError(f"{_named(s, hook)} must give finite numbers >= 0, but {name} has {least:.3g} to {most:.3g}.")


def is_real(x: Any, *shapes: tuple[int, ...]) -> bool:
    """Return True if it is a dense tensor of one of the shapes. A conversion of complex numbers drops their imaginary part."""
    return isinstance(x, Tensor) and x.shape in shapes and not x.is_complex() and x.layout is torch.strided


def rows_like(
    s: Strategy, hook: str, answer: Any, like: Mapping[str, Tensor], whose: str, *, finite: bool = False
) -> Grads:  # fmt: skip
    """A gradient by attributes of `like`, in the types in which these are merged: kernels would read the memory of whole numbers
    as floats, and half precision would lose small gradients.

    Args:
        whose: these attributes, as in "of g_HR". finite: check also that its numbers are finite.
    """
    if not isinstance(answer, Mapping):
        refuse(s, hook, "Grads, or a mapping from attributes to tensors", answer)
    for name, x in answer.items():
        if name not in like:
            refuse(s, hook, f"attributes {whose}, {', '.join(like)}", name)
        shape, at = in_our_shapes(like)[name].shape, like[name].device
        if not (fits := is_real(x, shape)) or x.device != at:
            refuse(s, hook, f"{name} as a tensor {[*shape]}" + f" on {at}, not on {x.device}" * fits, x)
    typed = {k: x.double() if like[k].dtype == torch.float64 else x.float() for k, x in answer.items()}
    g = Grads({k: x.view_as(like[k]) for k, x in typed.items()})
    if finite:
        require_finite(s, hook, g)
    return g


def _named(s: Strategy, hook: str) -> str:
    return f"{type(s).__name__}.{hook}()"


def refuse(s: Strategy, hook: str, rule: str, found: Any) -> NoReturn:
    raise AnswerError(f"{_named(s, hook)} must give {rule}, got {_shown(found)}.")


def _shown(found: Any) -> str:
    if isinstance(found, Tensor):
        kind = "complex " if found.is_complex() else "meta " if found.is_meta else ""
        if found.layout is not torch.strided:
            return f"a tensor {[*found.shape]} of layout {found.layout}; convert it by to_dense()"
        return f"a {kind}tensor {[*found.shape]}{', which has no numbers' * found.is_meta}"
    return f"{found!r:.80}"
