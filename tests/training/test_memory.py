"""The predicted peak of memory: what it counts, and what it refuses."""

from __future__ import annotations

import logging
from dataclasses import replace

import pytest

import rasterizers
from clear_strategies.errors import SettingError
from clear_strategies.training import memory
from clear_strategies.training.memory import Needs
from rasterizers.cpp import CppRasterizer
from rasterizers.interface import CountsLists
from tests.helpers import toy
from tests.helpers.short_run import start

MIB = 1 << 20
NEEDS = Needs(
    now=100 * MIB, reached=150 * MIB, gaussians=1000, held=800, worked=700, lists=500, most_lists=40 * MIB,
    pixels=MIB,
)  # fmt: skip


def test_the_peak_is_that_of_loading_or_what_training_adds():
    assert NEEDS.peak(1000) == 150 * MIB
    assert NEEDS.peak(100_000) == 100 * MIB + 99_000 * 800 + 100_000 * 700 + 40 * MIB + MIB
    assert replace(NEEDS, most_lists=400 * MIB).peak(100_000) - NEEDS.peak(100_000) == 100_000 * 500 - 40 * MIB
    assert replace(NEEDS, kept=MIB).peak(100_000) - NEEDS.peak(100_000) == MIB


@pytest.mark.parametrize("budget", [151, 300, 4000])
def test_as_many_gaussians_fit_as_the_budget_holds(budget):
    fits = NEEDS.fits(budget * MIB)
    assert NEEDS.peak(fits) <= budget * MIB < NEEDS.peak(fits + 1)


def test_a_run_whose_start_is_over_the_budget_is_refused_and_one_that_may_outgrow_it_warned_of(caplog):
    assert NEEDS.fits(149 * MIB) == 0
    with pytest.raises(SettingError, match=r"^fit\.memory: 1,000 Gaussians need 150 MiB, and 149 MiB fit\.memory all"):
        memory.require(NEEDS, 149 * MIB, None)
    with caplog.at_level(logging.WARNING):
        memory.require(NEEDS, 4000 * MIB, 100_000)
    assert not caplog.text
    memory.require(NEEDS, 200 * MIB, 100_000)
    assert f"and 200 MiB fit.memory allows: {NEEDS.fits(200 * MIB)} fit" in caplog.text


def test_a_run_holds_parameters_moments_statistics_and_the_anchor():
    state = start(("gco", "p2g", "svs"))
    found, n = memory.needs(state, toy.RASTERIZER), len(state.field)
    tables = (state.field.raw(), state.optimizer.state_dict(), state.density.state_dict())
    size = sum(x.nbytes for table in tables for x in table.values()) + state.field.filter_3d.nbytes
    anchored = sum(state.field.raw()[name].nbytes for name in ("means", "scales", "sh0", "detail"))
    assert found.held == (size + anchored) // n
    assert found.gaussians == n
    assert found.lists == 0  # the reference keeps none
    assert memory.needs(start(("gco",)), toy.RASTERIZER).held == size // n


@pytest.mark.skipif(rasterizers.available()["cpp"] is not None, reason="not compiled")
def test_cpp_counts_the_pairs_of_its_lists():
    rasterizer, splats = CppRasterizer(), toy.splats(40)
    assert isinstance(rasterizer, CountsLists)
    size = rasterizer.list_bytes(splats, toy.camera(0.0))
    assert size % (16 + 2 * 64) == 0
    bins = 3 * 2  # of 32 px, in 96 x 64 px
    assert 40 <= size // (16 + 2 * 64) <= 40 * bins


def test_the_plan_has_what_the_start_and_the_cap_need():
    line = memory.summary(NEEDS, 100_000)
    assert line.startswith("150 MiB at the start (150 MiB were taken until now), ")
    assert line.endswith(f"{memory.mebibytes(NEEDS.peak(100_000))} MiB with 100,000, the most that there may be")


def test_the_system_tells_what_the_process_holds():
    assert 0 < memory.resident() <= memory.peak()
    assert memory.available(NEEDS) > NEEDS.now
