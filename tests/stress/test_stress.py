"""A slice of `python -m tests.stress`."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.helpers.backends import CLEAN, EVERY, why_not
from tests.stress import bad_inputs, checkpoints, faults, fuzz, gco, kills, lifecycle, projection, soak
from tests.stress.bad_inputs import BadInput

MUTANTS = {fuzz.binary: 5_000, fuzz.text: 500, fuzz.scenes: 50}  # of each file


def test_single_gaussians_agree_with_float64() -> None:
    drawing = {name: make(**CLEAN) for name, make in EVERY.items() if why_not(name) is None}
    for row in projection.measure(drawing, every=97):
        row.require()


def test_gco_agrees_with_sixty_digits_and_sees_conflicts_beside_an_outlier() -> None:
    for row in gco.measure(rows=40):
        row.require()


def test_the_lifecycle_holds_in_any_order() -> None:
    row = lifecycle.measure(6, steps=12)
    assert row.cases > 50
    row.require()


def test_a_file_cut_by_any_fault_would_be_found_and_is_not_left(tmp_path: Path) -> None:
    row = faults.measure(tmp_path, most=100)
    assert row.cases >= 100
    row.require()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the run that is killed is a forked process")
def test_killed_runs_end_as_one_that_was_not(tmp_path: Path) -> None:
    kills.measure(tmp_path, 5).require()


def test_altered_bits_and_cut_files_are_refused(tmp_path: Path) -> None:
    checkpoints.integrity(tmp_path, 500).require()


@pytest.mark.parametrize("given", bad_inputs.inputs(), ids=lambda given: given.id)
def test_a_bad_input_is_refused_in_one_line(given: BadInput, tmp_path: Path) -> None:
    assert bad_inputs.problem(given, tmp_path) is None


@pytest.mark.slow
@pytest.mark.parametrize("targets", MUTANTS, ids=lambda targets: targets.__name__)
def test_damaged_files_are_refused_or_sound(targets: fuzz.Targets) -> None:
    fuzz.measure(targets, MUTANTS[targets]).require()


@pytest.mark.slow
def test_a_short_soak_stays_finite() -> None:
    _, open_files, finite = soak.run(80)
    open_files.require()
    finite.require()
