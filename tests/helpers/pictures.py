"""A run without its pictures, which matplotlib draws in nine tenths of so short a run, by the function that writes all files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

NAMES = ("write_curves", "write_contact_sheet", "write_coverage")


@contextmanager
def not_drawn() -> Iterator[None]:
    from clear_strategies.outputs import results

    with pytest.MonkeyPatch.context() as patch:
        for name in NAMES:
            patch.setattr(results, name, lambda *_: None)
        yield
