"""Numbers that change with the iteration, and the milestones that scale with a run's length.

Every milestone of the method is written for 10,000 iterations (the paper's length). `scaled` stretches them to another
length, so that a short run still passes through each phase: warm-up, densification, decay, anchor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any, Final, Literal, TypeVar, get_args

from clear_strategies.core.checks import refuse, require_choice, require_number

REFERENCE_ITERATIONS: Final = 10_000
_MILESTONE: Final = "milestone"

LARGEST_RATE: Final = 100.0
"""The largest learning rate: a step changes a logit or a log scale by about the rate, and all of their range is 40."""

Settings = TypeVar("Settings")
Decay = Literal["linear", "cosine", "exponential"]
Shape = Literal["linear", "constant"]


def milestone(default: int, *, least: int = 0) -> Any:
    """A dataclass field that holds an iteration number of a 10,000-iteration run; `scaled` stretches it, to no less than
    `least` unless it is 0.
    """
    return field(default=default, metadata={_MILESTONE: least})


def scaled(settings: Settings, factor: float) -> Settings:
    """A copy of a frozen dataclass with its milestones, and those of settings inside it, times `factor` (rounded)."""
    changes: dict[str, Any] = {}
    for f in fields(settings):  # type: ignore[arg-type]
        if not f.init:
            continue
        value = getattr(settings, f.name)
        if _MILESTONE in f.metadata:
            changes[f.name] = max(f.metadata[_MILESTONE], round(value * factor)) if value else value
        elif is_dataclass(value) and not isinstance(value, type):
            changes[f.name] = scaled(value, factor)
    return replace(settings, **changes)  # type: ignore[type-var]


def milestones(settings: Any) -> dict[str, int]:
    """Every milestone of a settings dataclass, with dotted names for those inside it; for the printed plan."""
    named: dict[str, int] = {}
    for f in fields(settings):
        value = getattr(settings, f.name)
        if _MILESTONE in f.metadata:
            named[f.name] = value
        elif f.init and is_dataclass(value) and not isinstance(value, type):
            named |= {f"{f.name}.{name}": t for name, t in milestones(value).items()}
    return named


@dataclass(frozen=True, slots=True)
class WarmupDecay:
    """λ(t): 0 until `start`, linear to `peak` at `full`, flat to `decay_from`, then down to `final` at `end`.

    The paper: 0, warm-up 500 to 3,000, 1.0, decay after 5,000. It gives neither the decay's shape nor where it ends
    (F19); by default λ does not decay, which was measured to be better.

    Args:
        peak: weight between `full` and `decay_from`. final: weight from `end` on; equal to `peak`, there is no decay.
        decay: shape of the decay.
        start, full, decay_from, end: iterations of a 10,000-iteration run.

    Raises:
        SettingError: the milestones are out of order, or a weight is negative.
    """

    peak: float = 1.0
    final: float = 1.0
    decay: Decay = "linear"
    start: int = milestone(500)
    full: int = milestone(3_000)
    decay_from: int = milestone(5_000)
    end: int = milestone(10_000)

    def __post_init__(self) -> None:
        order = (self.start, self.full, self.decay_from, self.end)
        if list(order) != sorted(order):
            refuse("start", "start <= full <= decay_from <= end must hold", order, "put them in this order")
        require_choice("decay", self.decay, get_args(Decay))
        for name in ("peak", "final"):
            require_number(name, getattr(self, name))
            if self.decay == "exponential" and getattr(self, name) == 0:
                refuse(name, "must be above 0 for an exponential decay", 0, "decay=linear ends at 0")

    @property
    def zero_until(self) -> int | None:
        """The iteration after which λ is above 0 for the first time; None: it is 0 throughout."""
        return next((t for t in (self.start, self.decay_from) if self(t + 1) > 0), None)

    def __call__(self, t: int) -> float:
        if t <= self.start:
            return 0.0
        if t < self.full:
            return self.peak * (t - self.start) / (self.full - self.start)
        if t <= self.decay_from:
            return self.peak
        if t >= self.end:
            return self.final
        share = (t - self.decay_from) / (self.end - self.decay_from)
        if self.decay == "exponential":
            return self.peak * math.pow(self.final / self.peak, share)
        if self.decay == "cosine":
            share = (1 - math.cos(math.pi * share)) / 2
        return self.peak + (self.final - self.peak) * share


@dataclass(frozen=True, slots=True)
class Ramp:
    """The dropout rate p_t: linear from 0 to `maximum` at iteration `full` (DropGaussian), or constant.

    Args:
        maximum: share of Gaussians, in [0, 1).
        shape: "linear", or "constant", at `maximum` from the first iteration on (F37).
        full: iteration at which the linear rate reaches `maximum`.

    Raises:
        SettingError: `maximum` is outside [0, 1).
    """

    maximum: float = 0.2
    shape: Shape = "linear"
    full: int = milestone(10_000)

    def __post_init__(self) -> None:
        require_number("maximum", self.maximum, below=1)
        require_choice("shape", self.shape, get_args(Shape))

    def __call__(self, t: int) -> float:
        if self.shape == "constant" or t >= self.full:
            return self.maximum
        return self.maximum * t / self.full


@dataclass(frozen=True, slots=True)
class LogLinear:
    """A learning rate falling from `initial` to `final`, log-linearly, by iteration `end` (3DGS's positions).

    Args:
        initial: at the first iteration; for positions in units of the scene's extent.
        final: from `end` on.
        end: the iteration at which `final` is reached.
    """

    initial: float = 1.6e-4
    final: float = 1.6e-6
    end: int = milestone(10_000)

    def __post_init__(self) -> None:
        for name in ("initial", "final"):
            require_number(name, getattr(self, name), above=0, most=LARGEST_RATE)

    def __call__(self, t: int) -> float:
        share = min(max(t / max(self.end, 1), 0.0), 1.0)
        return self.initial * math.pow(self.final / self.initial, share)
