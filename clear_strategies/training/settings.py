"""How long a run is, and what it saves and evaluates on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from clear_strategies.core.checks import refuse, require_whole
from clear_strategies.schedules import REFERENCE_ITERATIONS, milestone
from clear_strategies.training.compiled_step import FusedMode


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of the training loop. Milestones are iterations of a 10,000-iteration run.

    Args:
        iterations: optimizer steps, one view each.
        scale_schedule: stretch every milestone from 10,000 iterations to `iterations`.
        seed: of view order, dropout and splits.
        max_degree: of spherical harmonics, 0 to 3.
        degree_every: iterations after which one more degree becomes active.
        probe_every: iterations between evaluations of the test views; 0: never.
        probe_views: how many test views these evaluate.
        checkpoint_every: iterations between checkpoints; 0: only at the end, or when interrupted.
        keep: how many checkpoints stay, at least 1.
        memory: MiB that training may take, loading included; None: what is free on this machine. More is refused before the
            first iteration.
        fused: "auto" merges, corrects, anchors and steps in one compiled pass where it can, and skips rows that would
            not move; "off" takes the readable path.

    Raises:
        SettingError: a setting is outside its range.
    """

    iterations: int = 10_000
    scale_schedule: bool = True
    seed: int = 0
    max_degree: int = 3
    degree_every: int = milestone(1_000)
    probe_every: int = milestone(1_000)
    probe_views: int = 3
    checkpoint_every: int = milestone(2_500)
    keep: int = 3
    memory: int | None = None
    fused: FusedMode = "auto"

    def __post_init__(self) -> None:
        require_whole("iterations", self.iterations, least=1)
        require_whole("max_degree", self.max_degree, least=0, most=3)
        require_whole("keep", self.keep, least=1)
        for name in ("degree_every", "probe_every", "probe_views", "checkpoint_every"):
            require_whole(name, getattr(self, name), least=0)
        if self.memory is not None and self.memory < 1:
            refuse("memory", "must be at least 1 MiB", self.memory, "null takes what is free")
        if self.fused not in get_args(FusedMode):
            rule = f"must be one of {', '.join(get_args(FusedMode))}"
            refuse("fused", rule, self.fused, "in a YAML file, off is quoted")

    @property
    def stretch(self) -> float:
        """The factor on milestones."""
        return self.iterations / REFERENCE_ITERATIONS if self.scale_schedule else 1.0
