"""gsplat's own densification strategies in its loop, with CLEAR attached: everything follows them, and the score decides."""

from __future__ import annotations

import logging

import pytest

from clear_strategies import GCO, P2G, SVS, Conductor
from clear_strategies.errors import SettingError
from clear_strategies.schedules import Ramp
from integration.rows import ROWS
from tests.helpers import gsplat_host
from tests.helpers.inria import HR_FROM_START

pytest.importorskip("gsplat.strategy", reason="pip install gsplat")


def run(*chosen, steps=30):
    """Gsplat's DefaultStrategy for so many steps: the host, and CLEAR in it."""
    return gsplat_host.densified(Conductor(*chosen, objective=HR_FROM_START), steps=steps)


def test_all_parameters_and_states_follow_the_densifier():
    host, clear = run(GCO(), P2G(patch=4), SVS(dropout=Ramp(full=50), anchor_start=25, anchor_strength=0.01))
    n = len(host.splats["means"])
    assert n > 40
    assert {len(p) for p in host.splats.values()} == {n}
    assert ROWS not in host.splats
    counts = clear.attachment.counts
    assert counts["structure changes"] >= 3
    assert counts["scores written"] == counts["merges"] == 30
    assert float(host.splats["detail"].abs().max()) > 0


def test_densification_after_the_anchor_is_refused_before_the_first_step():
    with pytest.raises(SettingError, match=r"must end before the anchor is taken, got 24. Set refine_stop_iter=4"):
        run(SVS(anchor_start=5, anchor_strength=0.01))


def test_densification_beyond_a_strategys_end_is_warned_of_at_the_start(caplog):
    with caplog.at_level(logging.WARNING):
        run(SVS(anchor_start=10), steps=1)
    assert "densifies until refine_stop_iter=24" in caplog.text
