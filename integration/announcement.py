"""Messages in a host's log: about the strategies when they are attached, at the end of a loop without HR, and once."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.base import hooks_of, overrides
from integration.host import Host

_log = logging.getLogger(__name__)
_STRETCH: Final = "Make the conductor for the length of the loop: conductor(…, iterations=…)."


class Once:
    """Logs each message once, whatever its values.

    Args:
        log: a method of a logger.
    """

    def __init__(self, log: Callable[..., None]) -> None:
        self._log, self._told = log, set[str]()

    def __call__(self, message: str, *values: Any) -> None:
        if message not in self._told:
            self._told.add(message)
            self._log(message, *values)


def announce(conductor: Conductor, views: Sequence[View], host: Host) -> None:
    """After `on_fit_start`, log what each strategy will do, and which have no effect."""
    iterations = host.iterations
    if (start := conductor.objective.lambda_hr.zero_until) is not None:
        _log.info("HR takes part after step %d (objective.lambda_hr).", start)
        if iterations is not None and start >= iterations:
            _log.warning("HR takes part after step %d, but the loop has %d steps. %s", start, iterations, _STRETCH)
    for s in conductor.strategies:
        if (prepared := s.summary()) is not None:
            _log.info("%s: %s.", type(s).__name__, prepared)
    λ = conductor.objective.lambda_hr
    conductor.warn_without_effect(0.0 if start is None else max(λ.peak, λ.final))
    if not conductor.decorated and any(view.factor > 1 for view in views):
        _log.warning(
            "%s has no effect: the views were made without it. Make them with sr=conductor.prior(sr).",
            ", ".join(getattr(getattr(d, "func", d), "__name__", str(d)) for d in conductor.decorators),
        )
    hr_from = conductor.hr_from(scored=host.threshold is not None)
    for phrase in conductor.skips.descriptions(views, hr_from=hr_from, in_host=True):
        _log.info("Skipped: %s.", phrase)
    for hook, reason in {
        "densifier": "keeps its own density control",
        "draw": "draws no picture for it",
        **({"background": "chooses its background itself"} if host.own_background else {}),
    }.items():
        for owner in (s for s in conductor.strategies if overrides(s, hook)):
            part = f".{hook}()" * bool(hooks_of(type(owner)) - {hook, "draw", "extra_views"})
            _log.warning("%s%s has no effect here: the host %s.", type(owner).__name__, part, reason)
    for s in conductor.comparing:
        _log.warning("%s.compare() is called at HR alone: the host has the loss at LR.", type(s).__name__)
    if not conductor.strategies:
        summed = (
            "both losses are summed, as in the paper's baseline" if conductor.uses_hr else "the host trains as alone"
        )
        _log.info("no strategy is attached: %s.", summed)


def last_error() -> int | None:
    """The `id` of the error that is on its way, or else of the last that ended a program or a notebook's cell. The error itself
    would keep alive what was computed where it was raised.
    """
    error = sys.exc_info()[1] or getattr(sys, "last_value", None)
    return None if error is None else id(error)


def warn_without_hr(conductor: Conductor, counts: Mapping[str, int], known: int | None) -> None:
    """At the end of a loop, warn if HR took no part in it, unless an error has ended the loop.

    Args:
        counts: `Attachment.counts`. known: `last_error` before the loop.
    """
    start, merges = conductor.objective.lambda_hr.zero_until, counts["merges"]
    is_short = start is not None and 0 < merges <= start and not counts["HR renders"]
    if is_short and last_error() in (None, known):
        _log.warning(
            "HR took no part in the %d steps of this loop: it would after step %d. %s", merges, start, _STRETCH
        )
