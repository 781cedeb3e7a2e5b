"""Floor 1: the contract. A strategy answers questions about the gradients of Gaussians; it knows no rasterizer.

Hooks are phases of the paper, so their order needs no configuration. A hook that nobody overrides is never called; of
the hooks that give *the* answer (gate, observe, route, correct, score) exactly one strategy may override each.
"""

from __future__ import annotations

import inspect
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.deferred import Number
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, Shot

_DEVICE = "device"


@dataclass(frozen=True, slots=True, eq=False)
class ScreenGradients:
    """∇_u of the three losses, [N, 2], in NDC units (pixel gradient × W/2, H/2 of its own image).

    Args:
        base, hf: None while HR is not rendered; hf is also None when λ_HF = 0.
        ordinary: ‖∇_u(L_LR + λ_HR(L_base + λ_HF L_HF))‖, what 3DGS would densify by.
    """

    lr: Float[Tensor, "N 2"]
    base: Float[Tensor, "N 2"] | None
    hf: Float[Tensor, "N 2"] | None
    ordinary: Float[Tensor, " N"]


@dataclass(frozen=True)
class Strategy:
    """A frozen dataclass of settings, plus what it remembers.

    Args:
        state: per-Gaussian tensors [N, …] and nothing else: saved in checkpoints, gathered by `on_resize`.
        cache: whatever can be computed again (patch maps, keyed by view); never saved.
        readings: numbers of the last iteration, for logs only; on a device they are read late (`late.number`).

    Randomness must be a function of (seed, t), so that resuming needs no generator state.
    """

    fused: ClassVar[str | None] = None
    """The name under which the fused per-Gaussian pass knows this class's arithmetic, or None. It is not inherited by a
    class that overrides any method: whoever changes what a strategy does gets the readable path, not the old kernel."""

    state: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)
    cache: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    readings: dict[str, Number] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        declared_by = next(base for base in cls.__mro__ if "fused" in vars(base))
        if declared_by is not cls and any(
            getattr(cls, name) is not method for name, method in _methods(declared_by).items()
        ):
            cls.fused = None

    def on_fit_start(self, n_views: int, seed: int) -> None:
        """Once, before the first iteration, and again before a resumed one. Overriders call `super()`."""
        self.state.clear()
        self.cache.clear()
        self.readings.clear()

    def to(self, device: torch.device | str) -> None:
        """The field lies there: so do `state` from now on, and what is answered."""
        self.cache[_DEVICE] = torch.device(device)
        self.state.update({name: rows.to(device) for name, rows in self.state.items()})

    @property
    def device(self) -> torch.device:
        """Where the field lies."""
        device: torch.device = self.cache.get(_DEVICE, torch.device("cpu"))
        return device

    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | None:
        """Before render: which Gaussians take part? z >= 0 multiplies the opacity; None: all of them.  Eq. 15"""
        raise NotImplementedError

    def observe(self, view: Any, hr: Shot) -> Evidence | None:
        """After render: what does I_HR tell about each Gaussian?  Eq. 9, 10"""
        raise NotImplementedError

    def route(self, evidence: Evidence | None) -> Float[Tensor, " N"]:
        """How much of its high-frequency gradient does each Gaussian get? m in [0, 1].  Eq. 12"""
        raise NotImplementedError

    def correct(self, lr: Grads, hr: Grads, evidence: Evidence | None) -> Grads:
        """How to reconcile the two? The corrected g_HR; g_LR is never changed.  Eq. 6, 7, 11"""
        raise NotImplementedError

    def regularize(self, params: Mapping[str, Tensor], t: int) -> Grads | None:
        """Before the optimizer step: any gradient of your own to add? Several strategies may.  Eq. 16"""
        raise NotImplementedError

    def score(self, evidence: Evidence | None, screens: ScreenGradients) -> Float[Tensor, " N"] | None:
        """For densification: where is more structure needed? None: the ordinary statistic.  Eq. 14"""
        raise NotImplementedError

    def may_densify(self, t: int) -> bool:
        """May the structure change at t? All strategies must agree."""
        return True

    def after_step(self, params: Mapping[str, Tensor], t: int) -> None:
        """After the optimizer step: own state, e.g. the anchor.  Eq. 16"""

    def on_resize(self, parents: Int[Tensor, " M"]) -> None:
        """After the structure changed: row i of every per-Gaussian tensor now comes from row parents[i]."""
        for name, rows in self.state.items():
            self.state[name] = rows[parents]


def _methods(cls: type) -> dict[str, Any]:
    """A class's own and inherited functions, but for those that a dataclass decorator writes anew."""
    return {
        name: getattr(cls, name)
        for base in cls.__mro__
        for name, value in vars(base).items()
        if inspect.isfunction(value) and not (name.startswith("__") and name != "__post_init__")
    }


def answers(strategy: Strategy, hook: str) -> bool:
    """Whether the strategy's class overrides `hook`."""
    return getattr(type(strategy), hook) is not getattr(Strategy, hook)
