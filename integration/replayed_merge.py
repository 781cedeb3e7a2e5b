"""The merge of a host's gradients, recorded and replayed on CUDA.

A host's gradients are new tensors in each step, so a recording reads copies of them, and its result is copied to the host's
tensors. It reads in place the parameters, and what strategies that reconcile or regularize store.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Colour, Grads
from clear_strategies.core.step import Step
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Merged
from clear_strategies.merging.replay import LoggedReplay, logged_replays, merging_strategies
from clear_strategies.strategies.base import stored
from rasterizers.guards import iteration, unread
from rasterizers.recording import running
from rasterizers.replays import ReplayKey, shapes_of, write

_FINITE: Final = "finite"
"""The key of `Merged.finite` among a merge's numbers; the others are conflict ratios."""


class ReplayedMerge:
    """Called as `Conductor.merge` with all its arguments.

    Args:
        device: of the Gaussians. On CUDA a merge in which HR takes part is recorded and replayed.

    Attributes:
        replays: the recordings of merges; None: they are not recorded.
    """

    def __init__(self, conductor: Conductor, device: torch.device) -> None:
        self._conductor, self._device = conductor, device
        self.replays = logged_replays(device, conductor, "the replay of the merge")

    def __call__(
        self, params: Mapping[str, Tensor], g_lr: Grads, g_hr: Grads, step: Step | None, t: int, out: Mapping[str, Tensor]
    ) -> Merged:  # fmt: skip
        """See `Conductor.merge`."""
        conductor, λ = self._conductor, self._conductor.objective.lambda_hr(t)
        if self.replays is None or step is None or not g_hr.tensors or λ == 0:
            return conductor.merge(params, g_lr, g_hr, step, t, out)
        of_lr, of_hr, e, first = _named(g_lr), _named(g_hr), step.evidence, next(iter(out.values()))
        evidence = () if e is None else (e.reliability, e.demand, e.sums)
        λ_there = _on_device(λ, first.dtype, first.device)
        inputs = λ_there, *of_lr.values(), *of_hr.values(), step.visible, *evidence

        def work(given: Iterable[Any], out: Mapping[str, Tensor]) -> tuple[Mapping[str, Tensor], dict[str, Number]]:
            λ, *rest = given
            numbers = iter(rest)
            lr, hr = (_gradient(dict(zip(names, numbers, strict=False))) for names in (of_lr, of_hr))
            visible, seen = next(numbers), None if e is None else Evidence(*numbers)
            view = unread(step.view, "the view")
            known = replace(step, t=iteration(t), view=view, visible=visible, evidence=seen, looked_up=None)
            merged = conductor.merge(params, lr, hr, known, t, out, None if running() is None else λ)
            return out, {_FINITE: merged.finite, **merged.conflict}

        def recorded(copies: Iterable[Any]) -> tuple[Mapping[str, Tensor], dict[str, Number]]:
            contiguous = torch.contiguous_format
            return work(copies, {name: torch.empty_like(x, memory_format=contiguous) for name, x in out.items()})

        def record() -> LoggedReplay[Mapping[str, Tensor]]:
            return LoggedReplay(self._device, conductor, recorded, inputs, t, calls=merging_strategies(conductor))

        called = conductor.owner("reconcile"), *conductor.regularizers
        saved = [x for s in called if s is not None for x in stored(s)]
        addresses = [x.data_ptr() for x in (*params.values(), *step.params.values(), *saved)]
        key = ReplayKey(n := len(first), tuple(addresses), shapes_of(inputs, n), (*of_lr, None, *of_hr, None, *out))
        made, row = self.replays.do(key, t, inputs, live=lambda: work(inputs, out), record=record)
        if made is not out:
            write([*out.values()], [*made.values()])
        return Merged(Grads(out), row, row.pop(_FINITE))


@lru_cache(maxsize=1)
def _on_device(number: float, dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 1"]:
    return torch.full((1,), number, dtype=dtype, device=device)


def _named(g: Grads) -> dict[str, Tensor]:
    """Every tensor of a gradient, its factors included."""
    return {**g, **({} if g.colour is None else g.colour._asdict())}


def _gradient(named: dict[str, Tensor]) -> Grads:
    """The gradient of which `_named` gives these."""
    colour = Colour(named.pop("rgb"), named.pop("basis")) if "rgb" in named else None
    return Grads(named, colour=colour)
