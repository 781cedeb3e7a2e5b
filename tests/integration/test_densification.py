"""The end of a host's densification, as strategies ask for it."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from clear_strategies import SVS, Conductor
from clear_strategies.errors import SettingError
from clear_strategies.strategies.base import Strategy
from integration.densification import end_with_strategies, require_end
from tests.helpers import gsplat_host


@dataclass(frozen=True)
class Late(Strategy):
    """Forbids densification outside of [first, last)."""

    first: int
    last: int

    def may_densify(self, t):
        return self.first <= t < self.last


@pytest.mark.parametrize("first", [0, 1])
def test_it_is_the_first_iteration_after_the_last_that_is_allowed(first, caplog):
    settings = SimpleNamespace(until=100)
    with caplog.at_level("INFO"):
        end_with_strategies(Conductor(Late(20, 60)), settings, "until", first)
    assert settings.until == 59 + first
    assert f"densification ends at until={59 + first} instead of 100 (Late)" in caplog.text
    assert (
        f"Late forbids densification at 19 of the iterations before {59 + first}, the first is {first}" in caplog.text
    )


def test_without_such_a_strategy_nothing_changes(caplog):
    settings = SimpleNamespace(until=100)
    end_with_strategies(Conductor(SVS()), settings, "until")
    require_end(Conductor(Late(0, 1_000)), 100, "until")
    assert settings.until == 100
    assert not caplog.text


@pytest.mark.parametrize("host", ["gsplat", "inria"])
def test_a_host_that_would_densify_after_the_anchor_is_refused_before_the_first_step(host, request):
    early = SVS(anchor_start=5, anchor_strength=0.01)
    if host == "gsplat":
        strategy = SimpleNamespace(refine_stop_iter=24, grow_grad2d=2e-4)
        with pytest.raises(SettingError, match=r"before the anchor is taken, got 24. Set refine_stop_iter=4"):
            gsplat_host.started(early, strategy=strategy)
    else:
        with pytest.raises(SettingError, match=r"before the anchor is taken, got 24. Set densify_until_iter=5"):
            request.getfixturevalue("inria_attached")(early, densify_until=24)
