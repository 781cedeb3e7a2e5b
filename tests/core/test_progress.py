"""Long work says how far it is, and short work nothing."""

from __future__ import annotations

import logging

from clear_strategies.core import progress
from clear_strategies.core.progress import EVERY, Progress


def test_a_line_now_and_then_and_only_where_something_has_happened(monkeypatch, caplog):
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    counter = Progress("features", "photos", 10)
    with caplog.at_level(logging.INFO):
        for seconds, done in ((0, 1), (EVERY / 2, 2), (EVERY / 2, 3), (EVERY, 3), (1, 4), (EVERY, 5), (EVERY, 10)):
            clock[0] += seconds
            counter(done)
    assert caplog.messages == ["features: 3 of 10 photos", "features: 4 of 10 photos", "features: 5 of 10 photos"]
