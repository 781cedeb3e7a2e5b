"""Checks of the strategies' answers, by hook; each returns the answer. An error names strategy, hook, rule, and what was found.

Types and shapes are checked, and with `finite` also numbers in the CPU's memory; to read those of a device, the host would wait.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from numbers import Real
from typing import Any, NoReturn, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import is_color
from clear_strategies.core.conflicts import Weights
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.finite import is_finite, rows_not_finite
from clear_strategies.core.gradients import Grads
from clear_strategies.core.step import Losses, Step
from clear_strategies.core.view import ExtraView, Photo
from clear_strategies.errors import AnswerError
from clear_strategies.strategies.base import RunFacts, Scale, Strategy
from rasterizers.interface import Color

T = TypeVar("T")


def require_started(s: Strategy, of_last_run: RunFacts) -> None:
    if s.of_run is of_last_run:
        raise AnswerError(f"{_named(s, 'on_fit_start')} must call super().on_fit_start(n_views, seed).")


def require_stored(s: Strategy, params: Mapping[str, Tensor]) -> None:
    """Check that `state` and `run_state` are what a checkpoint can give back."""
    if not (s.state or s.run_state):
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
            if not isinstance(x, Tensor) or (where == "run_state" and x.requires_grad):
                raise AnswerError(
                    f"{entry} must be a tensor that requires no gradient, got {_shown(x)}. Hooks turn autograd on for a copy, "
                    "x.detach().requires_grad_()."
                )
            address = x.data_ptr()  # 0: the tensor has no memory
            if address and (address in taken or any(address in memory for memory in of_parameters)):
                raise AnswerError(
                    f"{entry} must be a tensor of its own, got the memory of a parameter or of another tensor that is stored, "
                    "which changes with it. Store its clone()."
                )
            taken.add(address)


def compared(
    s: Strategy,
    scale: Scale,
    photo: Photo,
    step: Step,
    losses: Callable[[Tensor], Losses],
    image: Float[Tensor, "H W 3"],
) -> Losses:
    """The answer of `compare`."""
    inner: list[Losses] = []

    def noted(image: Float[Tensor, "H W 3"]) -> Losses:
        if inner:  # the memory of the first cotangents is used again
            raise AnswerError(f"{_named(s, 'compare')} must call losses(image) once, but calls it again.")
        inner.append(losses(image))
        return inner[0]

    found = s.compare(scale, image, photo, step, noted)
    if not inner or not isinstance(found, Losses):
        _refuse(s, "compare", "the Losses that losses(image) returns, or these with changes", found)
    shape = inner[0].cotangents.shape
    if not _is_real(found.cotangents, tuple(shape)):
        _refuse(
            s,
            "compare",
            f"Losses whose cotangents are a tensor {[*shape]}; add a loss to one of them",
            found.cotangents,
        )
    return found


def gate(s: Strategy, z: T, n: int) -> T:
    shape = (n,) if s.shares_gate else (2, n)
    if z is not None and not _is_real(z, shape):
        scales = "" if s.shares_gate else ", a row for LR and one for HR,"
        _refuse(s, "gate", f"a tensor {[*shape]}{scales} or None", z)
    _require_numbers(s, "gate", "z", z)
    return z


def background(s: Strategy, color: Any) -> Color | None:
    if color is not None and not is_color(color):
        _refuse(s, "background", "three numbers in [0, 1] or None", color)
    return None if color is None else (color[0], color[1], color[2])


def evidence(s: Strategy, e: T, n: int) -> T:
    if not (e is None or isinstance(e, Evidence)):
        _refuse(s, "observe", "an Evidence or None", e)
    for name in () if e is None else ("reliability", "demand"):
        if not _is_real(getattr(e, name), (n,)):
            _refuse(s, "observe", f"an Evidence whose {name} is a tensor [{n}]", getattr(e, name))
    return e


def route(s: Strategy, m: T, n: int) -> T:
    if not (isinstance(m, Real) or _is_real(m, (n,))):
        _refuse(s, "route", f"a number or a tensor [{n}]", m)
    if not isinstance(m, Tensor):
        _require_finite(s, "route", {"m": m})
    return m


def weights(s: Strategy, answer: Any, n: int, groups: int, *, finite: bool) -> Weights:
    if not isinstance(answer, Weights):
        _refuse(s, "reconcile", "Weights(keep, remove)", answer)
    for name, w in answer._asdict().items():
        if not (isinstance(w, Real) or _is_real(w, (), (n,), (n, groups))):
            _refuse(s, "reconcile", f"Weights whose {name} is a number or a tensor [{n}] or [{n}, {groups}]", w)
    if finite:
        _require_finite(s, "reconcile", answer._asdict())
    return answer


def corrected(s: Strategy, answer: Any, g_hr: Mapping[str, Tensor], *, finite: bool) -> Grads:
    """By attributes of g_HR; those that it leaves out are 0."""
    return _rows_like(s, "correct", answer, g_hr, "of g_HR", finite)


def regularized(s: Strategy, answer: Any, params: Mapping[str, Tensor], *, finite: bool) -> Grads | None:
    return None if answer is None else _rows_like(s, "regularize", answer, params, "of the parameters", finite)


def score(s: Strategy, answer: T, n: int) -> T:
    """Its numbers are always checked: a Gaussian whose score is NaN never grows."""
    if answer is not None and not _is_real(answer, (n,)):
        _refuse(s, "score", f"a tensor [{n}] or None", answer)
    _require_finite(s, "score", {"S": answer})
    return answer


def extra_views(s: Strategy, answer: Any) -> list[ExtraView]:
    extras = [*answer] if isinstance(answer, Iterable) else _refuse(s, "extra_views", "a sequence of ExtraView", answer)
    for extra in extras:
        if not isinstance(extra, ExtraView):
            _refuse(s, "extra_views", "a sequence of ExtraView", extra)
        shape = extra.photo.image.shape[:2]
        if not _is_real(extra.weight, shape):
            _refuse(s, "extra_views", f"an ExtraView whose weight is a tensor {[*shape]}, as its photo", extra.weight)
        _require_numbers(s, "extra_views", "the weight", extra.weight)
    return extras


def may_densify(s: Strategy, answer: Any) -> bool:
    if answer is None:  # a forgotten return would end densification
        _refuse(s, "may_densify", "True or False", answer)
    return bool(answer)


def _require_finite(s: Strategy, hook: str, numbers: Mapping[str, Any]) -> None:
    for name, x in numbers.items():
        if not _may_be_finite(x):
            found = rows_not_finite(x) if isinstance(x, Tensor) and x.dim() else f"is {float(x)}"
            raise AnswerError(f"{_named(s, hook)} must give finite numbers, but {name} {found}.")


def _may_be_finite(x: Any) -> bool:
    """False only if it has been read and is not finite."""
    if isinstance(x, Tensor):
        return not deferred.is_immediate(x) or is_finite(x)
    return not isinstance(x, Real) or math.isfinite(x)


def _require_numbers(s: Strategy, hook: str, name: str, x: Any) -> None:
    """Finite numbers >= 0."""
    if x is None or x.numel() == 0 or not deferred.is_immediate(x):
        return
    least, most = torch.stack(x.float().aminmax()).tolist()
    if not (least >= 0 and most < math.inf):
        raise AnswerError(f"{_named(s, hook)} must give finite numbers >= 0, but {name} has {least:.3g} to {most:.3g}.")


def _is_real(x: Any, *shapes: tuple[int, ...]) -> bool:
    """Return True if it is a tensor of one of the shapes. A conversion of complex numbers drops their imaginary part."""
    return isinstance(x, Tensor) and x.shape in shapes and not x.is_complex()


def _rows_like(
    s: Strategy, hook: str, answer: Any, like: Mapping[str, Tensor], whose: str, finite: bool
) -> Grads:  # fmt: skip
    if not isinstance(answer, Mapping):
        _refuse(s, hook, "Grads, or a mapping from attributes to tensors", answer)
    for name, x in answer.items():
        if name not in like:
            _refuse(s, hook, f"attributes {whose}, {', '.join(like)}", name)
        if not _is_real(x, like[name].shape):
            _refuse(s, hook, f"{name} as a tensor {[*like[name].shape]}", x)
    if finite:
        _require_finite(s, hook, answer)
    return answer if isinstance(answer, Grads) else Grads(answer)


def _named(s: Strategy, hook: str) -> str:
    return f"{type(s).__name__}.{hook}()"


def _refuse(s: Strategy, hook: str, rule: str, found: Any) -> NoReturn:
    raise AnswerError(f"{_named(s, hook)} must give {rule}, got {_shown(found)}.")


def _shown(found: Any) -> str:
    if isinstance(found, Tensor):
        return f"a {'complex ' if found.is_complex() else ''}tensor {[*found.shape]}"
    return f"{found!r:.80}"
