"""The merge of a host's gradients, which is recorded and replayed on CUDA: 22 of the kernels that it launches are GCO's.

A host's gradients are new tensors in each step, so a recording reads copies of them, and its result is copied to the host's
tensors. It reads in place the parameters, and what strategies that reconcile or regularize store.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import Colour, Grads
from clear_strategies.core.step import Step
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Merged
from clear_strategies.merging.recorded_work import RecordedWork, merging_strategies, replays_on
from clear_strategies.strategies.base import stored
from rasterizers.guards import iteration, unread
from rasterizers.replays import GraphKey, write

_FINITE: Final = "finite"
_CONFLICT: Final = "conflict of "
"""Keys of a replay's numbers; a group's name follows the second."""


@dataclass(frozen=True, slots=True, eq=False)
class _MergeInputs:
    """The arguments of `Conductor.merge_routed` where HR takes part."""

    params: Mapping[str, Tensor]
    lr: Grads
    hr: Grads
    step: Step
    out: Mapping[str, Tensor]

    @property
    def tensors(self) -> dict[str, Tensor | None]:
        """The tensors that a recording copies, each by a name."""
        found = dict[str, Tensor | None](visible=self.step.visible)
        for side, g in {"lr": self.lr, "hr": self.hr}.items():
            found |= {f"{side} {name}": x for name, x in g.items()}
            if g.colour is not None:
                found |= {f"{side} {name}": x for name, x in g.colour._asdict().items()}
        if (e := self.step.evidence) is not None:
            found |= {"reliability": e.reliability, "demand": e.demand, "sums": e.sums}
        return found

    def copied(self) -> _MergeInputs:
        """Copies, whose view must not be read, since each replay has another one."""
        own = replace(self.step.copied(), view=unread(self.step.view, "the view"), looked_up=None)
        return _MergeInputs(self.params, _copied(self.lr), _copied(self.hr), own, self.out)


def _recorded(conductor: Conductor, inputs: _MergeInputs) -> RecordedWork[_MergeInputs, Merged]:
    """The recording of a merge, which reads its inputs from static tensors."""
    static, first, lambda_hr = inputs.copied(), next(iter(inputs.out.values())), conductor.objective.lambda_hr
    tensors, λ = [*static.tensors.values()], first.new_empty(1)
    λ_now = -1.0  # the value on the device

    def work() -> tuple[list[Tensor], dict[str, Number]]:
        step = replace(static.step, t=iteration(inputs.step.t))
        out = {name: torch.empty_like(x, memory_format=torch.contiguous_format) for name, x in inputs.out.items()}
        merged = conductor.merge_routed(static.params, static.lr, static.hr, step, inputs.step.t, out, λ)
        conflict = {f"{_CONFLICT}{group}": share for group, share in merged.conflict.items()}
        return [*out.values()], {_FINITE: merged.finite, **conflict}

    def write_static(new: _MergeInputs) -> None:
        nonlocal λ_now
        write(tensors, [*new.tensors.values()])
        if (λ_new := lambda_hr(new.step.t)) != λ_now:
            λ_now = λ_new
            λ.fill_(λ_new)

    def outcome(new: _MergeInputs, made: list[Tensor], row: dict[str, Number]) -> Merged:
        write([*new.out.values()], made)
        conflict = {name.removeprefix(_CONFLICT): x for name, x in row.items() if name.startswith(_CONFLICT)}
        return Merged(Grads(new.out), conflict, row[_FINITE])

    write_static(inputs)
    return RecordedWork(
        first.device, conductor, work, write=write_static, outcome=outcome, calls=merging_strategies(conductor)
    )


class ReplayedMerge:
    """Called as `Conductor.merge_routed` with all its arguments.

    Args:
        device: of the Gaussians. On CUDA a merge in which HR takes part is recorded and replayed.
    """

    def __init__(self, conductor: Conductor, device: torch.device) -> None:
        self._conductor = conductor
        self._replays = replays_on(device, conductor.work_log, "the replay of the merge")

    def __call__(
        self, params: Mapping[str, Tensor], g_lr: Grads, g_hr: Grads, step: Step | None, t: int, out: Mapping[str, Tensor]
    ) -> Merged:  # fmt: skip
        """See `Conductor.merge_routed`."""
        conductor = self._conductor

        def live() -> Merged:
            return conductor.merge_routed(params, g_lr, g_hr, step, t, out)

        if self._replays is None or step is None or not g_hr.tensors or conductor.objective.lambda_hr(t) == 0:
            return live()
        inputs = _MergeInputs(params, g_lr, g_hr, step, out)
        return self._replays.do(self._key(inputs), t, inputs, live=live, record=lambda: _recorded(conductor, inputs))

    def _key(self, inputs: _MergeInputs) -> GraphKey:
        called = self._conductor.owner("reconcile"), *self._conductor.regularizers
        saved = [x for s in called if s is not None for x in stored(s)]
        addresses = [x.data_ptr() for x in (*inputs.params.values(), *inputs.step.params.values(), *saved)]
        shapes = [(name, None if x is None else x.shape) for name, x in inputs.tensors.items()]
        return GraphKey((len(next(iter(inputs.out.values()))), *addresses), tuple(shapes), tuple(inputs.out))


def _copied(g: Grads) -> Grads:
    colour = None if g.colour is None else Colour(*(x.clone() for x in g.colour))
    return Grads({name: x.clone() for name, x in g.items()}, colour=colour)
