"""The scalars that the strategies log in an iteration."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from clear_strategies.core.deferred import Number
from clear_strategies.errors import AnswerError
from clear_strategies.strategies.base import Logged, Strategy, by_class


class IterationLogs:
    """The scalars that the strategies have logged in an iteration, including those that `keep` took out of `Strategy.logs`."""

    def __init__(self, strategies: Sequence[Strategy]) -> None:
        self._strategies = strategies
        self._kept: list[dict[str, Logged]] = [{} for _ in strategies]
        self._t: int | None = None

    def begin(self, t: int) -> None:
        """Drop the scalars of an earlier iteration than t."""
        if t != self._t:
            self._t = t
            self.keep()
            for kept in self._kept:
                kept.clear()

    def keep(self) -> None:
        """Take all scalars out of `Strategy.logs`, which then hold only what is logged from now on."""
        for kept, s in zip(self._kept, self._strategies, strict=True):
            kept.update(s.logs)
            s.logs.clear()

    def scalars(self, columns: Collection[str] = ()) -> dict[str, Logged]:
        """The scalars as they were logged, see `computed`. A name that another strategy has logged too is prefixed by the class.

        Args:
            columns: of the row that the scalars are added to.

        Raises:
            AnswerError: one of these columns was logged.
        """
        logged: dict[str, Logged] = {}
        for owner, kept, s in zip(by_class(self._strategies), self._kept, self._strategies, strict=True):
            logged |= {f"{owner}.{name}" if name in logged else name: x for name, x in (kept | s.logs).items()}
        if taken := logged.keys() & columns:
            raise AnswerError(
                f"a strategy logs {min(taken)!r}, a column that the row has already. Give it another name."
            )
        return logged


def computed(logged: Mapping[str, Logged]) -> dict[str, Number]:
    """The scalars, some of which were logged as functions that compute them."""
    return {name: x() if callable(x) else x for name, x in logged.items()}
