"""A host's Gaussians as a strategy's densifier changes them (`Strategy.densifier`)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor

_log = logging.getLogger(__name__)


class HostField:
    """The raw parameters of a host, whose rows are gathered together with everything else that has a row per Gaussian.

    Args:
        rows: returns every tensor of the host with a row per Gaussian, by the host's names.
        names: gsplat's parameter name -> the host's.
        optimizers: returns those of the parameters.
        put: replaces the host's tensors; row i of each new one is row parents[i] of the old one.

    Attributes:
        moments: the per-Gaussian state of its optimizers.
    """

    def __init__(
        self,
        rows: Callable[[], Mapping[str, Tensor]],
        names: Mapping[str, str],
        optimizers: Callable[[], Sequence[torch.optim.Optimizer]],
        put: Callable[[Mapping[str, Tensor], Int[Tensor, " M"]], None],
    ) -> None:
        self._rows, self._names, self._put = rows, names, put
        self.moments = HostMoments(optimizers)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def means(self) -> Float[Tensor, "N 3"]:
        return self.raw()["means"]

    @property
    def quats(self) -> Float[Tensor, "N 4"]:
        return self.raw()["quats"]

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        return self.raw()["scales"]

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """Logits; hosts that hold them as [N, 1] get what is written to these."""
        return self.raw()["opacities"].flatten()

    def raw(self) -> dict[str, Tensor]:
        """The current leaves by gsplat's names, without a gradient."""
        rows = self._rows()
        return {name: rows[host_name].detach() for name, host_name in self._names.items()}

    def take(self, parents: Int[Tensor, " M"], fresh: Bool[Tensor, " M"]) -> None:
        """Row i of everything becomes a copy of row parents[i]. Parameters are replaced, as densifiers of hosts do it."""
        old = self._rows()
        new = {name: _gathered(tensor, parents) for name, tensor in old.items()}
        self.moments.move({id(old[name]): new[name] for name in old})
        self._put(new, parents)


class HostMoments:
    """The per-Gaussian state of a host's optimizers, e.g. Adam's moments."""

    def __init__(self, optimizers: Callable[[], Sequence[torch.optim.Optimizer]]) -> None:
        self.optimizers = optimizers
        self._moved: list[tuple[dict[str, Any], int]] = []  # states whose rows are still to be gathered, and how many

    def move(self, new: Mapping[int, Tensor]) -> None:
        """Let the optimizers step the new parameters, by the id of the old ones."""
        for optimizer in self.optimizers():
            for group in optimizer.param_groups:
                for i, p in enumerate(group["params"]):
                    if id(p) in new:
                        group["params"][i] = new[id(p)]
                        if (state := optimizer.state.pop(p, None)) is not None:
                            optimizer.state[new[id(p)]] = state
                            self._moved.append((state, len(p)))

    def take(self, parents: Int[Tensor, " M"], fresh: Bool[Tensor, " M"]) -> None:
        """Gather the rows of every moment; fresh ones start at 0."""
        for state, n in self._moved:
            for name, moment in state.items():
                if isinstance(moment, Tensor) and moment.shape[:1] == (n,):  # Adam's step count has no rows
                    state[name] = moment[parents]
                    state[name][fresh] = 0
        self._moved.clear()


def _gathered(tensor: Tensor, parents: Int[Tensor, " M"]) -> Tensor:
    rows, trained = tensor.detach()[parents], isinstance(tensor, torch.nn.Parameter)
    return torch.nn.Parameter(rows, requires_grad=tensor.requires_grad) if trained else rows


class HostDensity:
    """A strategy's densifier in place of the host's own. It acts once all optimizers have stepped that step at an iteration.

    Args:
        field: the host's Gaussians; None: the host densifies by itself.
        views: all training views. seed: of the run.
    """

    def __init__(self, conductor: Conductor, field: HostField | None, views: Sequence[View], seed: int) -> None:
        owner = conductor.owner("densifier")
        self._densifier: Any = None if owner is None or field is None else owner.densifier(field, views, seed)
        self._conductor, self._field = conductor, field
        optimizers = [] if field is None else field.moments.optimizers()
        self._expected = {id(o) for o in optimizers}  # later those that stepped before the last rendering
        self._stepped: set[int] = set()  # since the last rendering
        self._t = 0  # of the last action
        if self._densifier is not None:
            marks = ", ".join(f"{mark} {t:,}" for mark, t in self._densifier.marks.items())
            _log.info("%s densifies in place of the host: %s.", self._densifier.name, marks)

    def before_rendering(self) -> None:
        """A training view is rendered: the optimizers that have stepped will step again."""
        if self._stepped:
            self._expected, self._stepped = self._stepped, set()

    def after_step(self, optimizer: torch.optim.Optimizer, t: int) -> None:
        """An optimizer has stepped at t."""
        self._stepped.add(id(optimizer))
        if self._field is None or self._densifier is None or t == self._t or self._expected - self._stepped:
            return
        self._t = t
        if self._conductor.may_densify(t):
            self._densifier.step(self._field, self._field.moments, t, lambda parents: None)

    def state_dict(self) -> dict[str, Tensor]:
        """Of the densifier; empty where the host densifies."""
        return {} if self._densifier is None else self._densifier.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        if self._densifier is not None and state:
            self._densifier.load_state_dict(state)
