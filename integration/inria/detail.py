"""The detail feature f_det beside a GaussianModel, which has no such parameter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.errors import HostError
from clear_strategies.merging.detail import DetailRates
from integration.detail import detail_adam
from integration.inria.rows import CarriedRows, Change
from integration.structure import composed


class DetailFeature:
    """f_det and its Adam beside the host's parameters, for hosts that look parameters up by name and allow no other.

    Its rows follow the host's Gaussians.

    Args:
        means: returns the host's current positions.
        rows: finds the host's changes of structure.
        rates: of the run's conductor.
    """

    def __init__(self, means: Callable[[], Tensor], rows: CarriedRows, rates: DetailRates) -> None:
        self._means, self._rows, self._rates = means, rows, rates
        self._parents: Int[Tensor, " M"] | None = None  # since the last `poll_parents`
        self._value = torch.nn.Parameter(torch.zeros_like(means(), requires_grad=False))
        self._adam = detail_adam(self._value, self._rates)

    @property
    def value(self) -> Float[Tensor, "N 3"]:
        """f_det, one row per Gaussian of the host."""
        self._follow_host()
        return self._value

    def poll_parents(self) -> Int[Tensor, " M"] | None:
        """parents[M] of the changes since the last call, -1 where there is none; None: there were no changes."""
        self._follow_host()
        parents, self._parents = self._parents, None
        return parents

    def step(self) -> None:
        """One optimizer step, if there is a gradient; called when the host steps."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def forget_gradient(self) -> None:
        """Before the first pass of a step: the host's `zero_grad`, of one that it has left out, does not reach this Adam."""
        self._adam.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """f_det and the moments of its Adam, for the host's checkpoint."""
        return {"value": self.value.detach().clone(), "adam": self._adam.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a state; the host has loaded its parameters already.

        Raises:
            HostError: the state holds another number of Gaussians.
        """
        self._rows.restart()
        self._parents = None
        means = self._means()
        if len(state["value"]) != len(means):
            raise HostError(
                f"the checkpoint holds f_det of {len(state['value']):,} Gaussians, but {len(means):,} Gaussians were loaded. "
                "Load both from one checkpoint."
            )
        self._value = torch.nn.Parameter(state["value"].to(means))
        self._adam = detail_adam(self._value, self._rates)
        self._adam.load_state_dict(state["adam"])

    @torch.no_grad()
    def _follow_host(self) -> None:
        """Apply a change of the host's structure to f_det, and add it to the parents to report."""
        change = self._rows.poll()
        if change is not None:
            self._gather(change)
            self._parents = change.parents if self._parents is None else composed(change.parents, self._parents)
        if len(now := self._means()) != len(self._value):
            raise HostError(
                f"the host changed the number of Gaussians from {len(self._value):,} to {len(now):,} inside its parameters. A "
                "changed set must be a new parameter, as in 3DGS."
            )

    def _gather(self, change: Change) -> None:
        """Give each row its parent's f_det, or 0 without a parent; only old rows keep their Adam moments."""
        rows, unknown = change.parents.clamp_min(0), change.parents < 0
        state = self._adam.state.pop(self._value, {})
        value = self._value[rows]
        value[unknown] = 0
        self._value = torch.nn.Parameter(value)
        self._adam.param_groups[0]["params"] = [self._value]
        for name, moment in state.items():
            if moment.dim():  # Adam's step count has no rows
                state[name] = moment[rows]
                state[name][change.fresh | unknown] = 0
        if state:
            self._adam.state[self._value] = state
