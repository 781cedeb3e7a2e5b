"""A slice of `python -m tests.stress`, and proof that each of its measurements can fail."""

import os
from pathlib import Path

import pytest

from clear_strategies import files
from clear_strategies.errors import SettingError
from clear_strategies.training import checkpoint
from clear_strategies.training.optim import Adam
from clear_strategies.training.state import TrainState
from rasterizers.reference import ReferenceRasterizer
from tests.helpers.backends import CLEAN, EVERY, why_not
from tests.stress import bad_inputs, faults, fuzz, gco, kills, lifecycle, projection, soak
from tests.stress.__main__ import main
from tests.stress.bad_inputs import BadInput
from tests.stress.rows import Worst

MUTANTS = {fuzz.binary: 5_000, fuzz.text: 500, fuzz.scenes: 50}  # of each file


def test_single_gaussians_agree_with_float64() -> None:
    drawing = {name: make(**CLEAN) for name, make in EVERY.items() if why_not(name) is None}
    for row in projection.measure(drawing, every=97):
        row.require()


def test_an_image_that_is_off_is_found() -> None:
    class Darker(ReferenceRasterizer):
        def __call__(self, *arguments, **options):
            rendering = super().__call__(*arguments, **options)
            rendering.image = rendering.image * 0.99
            return rendering

    image, gradient, *_ = projection.measure({"darker": Darker(**CLEAN)}, every=997)
    assert not image.met
    assert gradient.met


def test_gco_agrees_with_sixty_digits_and_sees_conflicts_beside_an_outlier() -> None:
    for row in gco.measure(rows=40):
        row.require()


def test_the_lifecycle_holds_in_any_order() -> None:
    row = lifecycle.measure(6, steps=12)
    assert row.cases > 50
    row.require()


def test_moments_that_stay_behind_and_a_save_of_nan_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def careless(self, parents, fresh):
        self.first = {name: rows[parents] for name, rows in self.first.items()}

    with monkeypatch.context() as patch:
        patch.setattr(Adam, "take", careless)
        assert not lifecycle.measure(30, steps=12).met
    monkeypatch.setattr(TrainState, "require_finite", lambda self: None)
    row = lifecycle.measure(30, steps=12)
    assert not row.met
    assert "DID NOT RAISE" in row.where


def test_a_file_cut_by_any_fault_would_be_found_and_is_not_left(tmp_path: Path) -> None:
    row = faults.measure(tmp_path, most=100)
    assert row.cases >= 100
    row.require()


def remove_before_saving(folder, saved, *, keep=3, save=checkpoint.save):
    for old in checkpoint.saved(folder):
        old.unlink()
    return save(folder, saved, keep=keep)


def write_in_place(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(data)


@pytest.mark.parametrize(
    ("module", "name", "careless"),
    [(checkpoint, "save", remove_before_saving), (files, "write_bytes", write_in_place)],
    ids=["save", "export"],
)
def test_a_careless_save_or_export_would_be_found(tmp_path: Path, monkeypatch, module, name, careless) -> None:
    monkeypatch.setattr(module, name, careless)
    assert not faults.measure(tmp_path, most=100).met


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the run that is killed is a forked process")
def test_killed_runs_end_as_one_that_was_not(tmp_path: Path) -> None:
    kills.measure(tmp_path, 3).require()


def test_altered_bits_and_cut_files_are_refused(tmp_path: Path) -> None:
    faults.integrity(tmp_path, 500).require()


@pytest.mark.parametrize("given", list(bad_inputs.inputs()), ids=lambda given: given.id)
def test_a_bad_input_is_refused_in_one_line(given: BadInput, tmp_path: Path) -> None:
    assert bad_inputs.problem(given, tmp_path) is None


def test_an_input_that_is_accepted_or_refused_otherwise_would_be_found(tmp_path: Path) -> None:
    def fails(folder: Path) -> None:
        raise ZeroDivisionError

    def lines(folder: Path) -> None:
        raise SettingError("a\nb")

    def runs(folder: Path) -> None:
        (folder / "canary").mkdir()
        raise SettingError("no")

    for give, says in (
        (lambda folder: None, "it is accepted"), (fails, "ZeroDivisionError"), (lines, "several lines"), (runs, "was run"),
    ):  # fmt: skip
        assert says in (bad_inputs.problem(BadInput("x", "y", give, ""), tmp_path) or "")


@pytest.mark.slow
@pytest.mark.parametrize("targets", MUTANTS, ids=lambda targets: targets.__name__)
def test_damaged_files_are_refused_or_sound(targets: fuzz.Targets) -> None:
    fuzz.measure(targets, MUTANTS[targets]).require()


def test_a_reader_with_an_untyped_error_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    read, sizes = fuzz.ply.read_gaussians, list[int]()

    def careless(path: Path):
        sizes.append(path.stat().st_size)
        return read(path) if sizes[-1] == sizes[0] else {}[path]

    monkeypatch.setattr(fuzz.ply, "read_gaussians", careless)
    failed, first = fuzz.damaged(fuzz.binary, "PLY", 50)
    assert failed == sum(size != sizes[0] for size in sizes) > 0
    assert first.startswith("mutant ")


@pytest.mark.slow
def test_a_short_soak_stays_finite() -> None:
    _, open_files, finite = soak.run(80)
    open_files.require()
    finite.require()


def test_a_row_that_is_not_a_number_or_has_no_case_is_not_met() -> None:
    worst = Worst()
    assert not worst.row("nothing", "none", 1.0).met
    worst.add(float("nan"), "here")
    worst.add(0.5, "there")
    row = worst.row("nan", "none", 1.0)
    assert not row.met
    assert row.where == "here"


def test_the_command_prints_a_table(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["stress", "--only", "gco"])
    assert main() == 0
    assert "| GCO: conflicts that an outlier hides | readable | 2 | 0 | 0 | none |" in capsys.readouterr().out
