"""The memory of training is estimated before it begins, and what cannot fit is refused."""

import logging
import sys
from types import SimpleNamespace

import psutil
import pytest

from clear_strategies.errors import SettingError
from clear_strategies.training import memory
from rasterizers.native import empty
from tests.helpers.backends import needs
from tests.helpers.short_run import start

MIB = 1 << 20


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process holds 100 MiB, and 50 more are free."""
    process = SimpleNamespace(memory_info=lambda: SimpleNamespace(rss=100 * MIB))
    system = SimpleNamespace(available=50 * MIB)
    monkeypatch.setattr(memory, "psutil", SimpleNamespace(Process=lambda: process, virtual_memory=lambda: system))


@pytest.mark.usefixtures("held")
def test_a_run_whose_start_does_not_fit_is_refused_and_one_that_may_outgrow_the_machine_warned_of(caplog):
    state = start(("gco",))
    assert memory.require(state, None).startswith("about 10")
    with pytest.raises(
        SettingError, match=r"^fit\.memory: \d+ Gaussians need about 10\d MiB, and 99 MiB fit\.memory all"
    ):
        memory.require(state, 99)
    assert not caplog.text
    state.density.cap = 100_000
    with caplog.at_level(logging.WARNING):
        memory.require(state, None)
    assert "100000 Gaussians, the most that there may be, need about " in caplog.text
    assert "and 150 MiB is free on this machine" in caplog.text


def test_the_estimate_holds_the_parameters_and_their_moments():
    state, n = start(("gco", "p2g", "svs")), 1_000_000
    tables = (state.field.raw(), state.optimizer.state_dict())
    least = sum(x.nbytes for table in tables for x in table.values()) // len(state.field) * n
    state.density.cap = n
    each = float(memory.require(state, 10**6).split("start, ")[1].split()[0])
    assert least < each * 1024 * n < 10 * least


@needs("cpp")
@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_what_the_kernels_keep_for_their_next_use_is_given_back():
    def resident() -> int:
        return int(psutil.Process().memory_info().rss)

    memory.release()
    before = resident()
    empty((100, MIB // 4)).fill_(1.0)
    assert resident() - before > 90 * MIB  # kept
    memory.release()
    assert resident() - before < 10 * MIB
