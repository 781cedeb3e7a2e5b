"""The end of a host's densification, which a strategy may bring forward (SVS: anchor_start)."""

from __future__ import annotations

import logging
from typing import Any

from clear_strategies.errors import SettingError
from clear_strategies.merging.conductor import Conductor

_log = logging.getLogger(__name__)


def end_with_strategies(conductor: Conductor, settings: Any, name: str, first: int = 1) -> None:
    """Lower `settings.<name>`, from which on the host no longer densifies, to the iteration at which a strategy ends it.

    Args:
        settings: an object of the host that its loop reads at every iteration; without such a field nothing is done.
        first: the host's number of its first iteration, 0 or 1.
    """
    until = getattr(settings, name, None)
    if until is not None and (end := _end_of_densification(conductor, int(until), first)) < until:
        _log.info(
            "densification ends at %s=%d instead of %d (%s).", name, end, until, _forbidding(conductor, end + 1 - first)
        )
        setattr(settings, name, end)


def require_end(conductor: Conductor, until: int | None, name: str, first: int = 1) -> None:
    """Refuse, or warn, where the host's densification outlasts the strategies' and cannot be ended from here.

    Args:
        until: the host's setting `name`, from which on it no longer densifies; None: unknown.

    Raises:
        SettingError: a strategy takes an anchor before the structure stops changing.
    """
    if until is None or (end := _end_of_densification(conductor, until, first)) >= until:
        return
    if any(getattr(s, "anchor_strength", 0.0) > 0 for s in conductor.strategies):  # SVS keeps a copy of every row
        raise SettingError(
            f"{name}: densification must end before the anchor is taken, got {until}. Set {name}={end}, or raise "
            "strategies.svs.anchor_start."
        )
    _log.warning(
        "the host densifies until %s=%d, but %s ends densification at %d. Lower %s to that iteration.",
        name, until, _forbidding(conductor, end + 1 - first), end, name,
    )  # fmt: skip


def _end_of_densification(conductor: Conductor, until: int, first: int) -> int:
    """The first iteration, in the host's count, from which on the strategies no longer allow densification; at most `until`.

    A host has an end, but cannot be asked at each iteration: it densifies where a strategy forbids it earlier, with a warning.
    """
    allowed = [i for i in range(first, until) if conductor.may_densify(i + 1 - first)]
    end = allowed[-1] + 1 if allowed else first
    if gaps := sorted({*range(first, end)} - {*allowed}):
        _log.warning(
            "%s forbids densification at %d of the iterations before %d, the first is %d, but the host densifies there: "
            "only the end can be set from here.", _forbidding(conductor, gaps[0] + 1 - first), len(gaps), end, gaps[0],
        )  # fmt: skip
    return end


def _forbidding(conductor: Conductor, t: int) -> str:
    """The strategies that forbid densification at iteration t."""
    return ", ".join(type(s).__name__ for s in conductor.strategies if not s.may_densify(t))
