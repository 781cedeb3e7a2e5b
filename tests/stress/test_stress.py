"""A slice of `python -m tests.stress`, and proof that each of its measurements can fail."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest

from clear_strategies import files
from clear_strategies.errors import SettingError
from clear_strategies.training import checkpoint
from clear_strategies.training.optim import Adam
from clear_strategies.training.state import TrainState
from rasterizers.reference import ReferenceRasterizer
from tests.helpers.backends import CLEAN, EVERY, needs
from tests.stress import attacks, bad_inputs, checkpoints, faults, fuzz, gco, kills, lifecycle, projection, soak
from tests.stress.__main__ import main
from tests.stress.bad_inputs import BadInput
from tests.stress.rows import Row, Worst, read, table, write

THINNED = {"torch": 97, "warp": 499}
MUTANTS = {fuzz.binary: 10_000, fuzz.text: 1_000, fuzz.scenes: 100}  # of each format


@pytest.mark.parametrize("name", [pytest.param(name, marks=needs(name)) for name in EVERY])
def test_single_gaussians_agree_with_float64(name: str) -> None:
    for row in projection.measure({name: EVERY[name](**CLEAN)}, every=THINNED.get(name, 61)):
        row.require()


def test_an_image_that_is_off_is_found() -> None:
    class Darker(ReferenceRasterizer):
        def __call__(self, *arguments, **options):
            rendering = super().__call__(*arguments, **options)
            rendering.image = rendering.image * 0.99
            return rendering

    image, gradient = projection.measure({"darker": Darker(**CLEAN)}, every=997)
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
    assert "DivergedError was not raised" in row.where


def test_a_file_cut_by_any_fault_would_be_found_and_is_not_left(tmp_path: Path) -> None:
    row = faults.measure(tmp_path, most=250)
    assert row.cases > 200
    row.require()


def remove_before_saving(folder, saved, *, keep=3, save=checkpoint.save):
    for old in checkpoint.saved(folder):
        checkpoint._remove(old)
    return save(folder, saved, keep=keep)


def write_in_place(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        file.write(data)


@pytest.mark.parametrize(
    ("module", "name", "careless"), [(checkpoint, "save", remove_before_saving), (files, "write_bytes", write_in_place)]
)
def test_a_careless_save_or_export_would_be_found(tmp_path: Path, monkeypatch, module, name, careless) -> None:
    monkeypatch.setattr(module, name, careless)
    assert not faults.measure(tmp_path, most=250).met


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="the run that is killed is a forked process")
def test_killed_runs_end_as_one_that_was_not(tmp_path: Path) -> None:
    kills.measure(tmp_path, 5).require()


def test_altered_bits_and_cut_files_are_refused(tmp_path: Path) -> None:
    checkpoints.integrity(tmp_path, 150).require()


@pytest.mark.parametrize("given", bad_inputs.inputs(), ids=lambda given: given.id)
def test_a_bad_input_is_refused_in_one_line(given: BadInput, tmp_path: Path) -> None:
    assert bad_inputs.problem(given, tmp_path) is None


@pytest.mark.parametrize("given", attacks.attacks(), ids=lambda given: given.name)
def test_an_attack_is_refused_and_leaves_no_trace(given: BadInput, tmp_path: Path) -> None:
    assert attacks.trace(given, tmp_path) is None


def test_there_are_as_many_bad_inputs_and_attacks_as_a_release_asks_for() -> None:
    named = [given.id for given in bad_inputs.inputs()]
    assert len(named) == len(set(named)) >= 300
    attacked = [given.name for given in attacks.attacks()]
    assert len(attacked) == len(set(attacked)) >= 40


def test_an_input_that_is_accepted_or_refused_otherwise_would_be_found(tmp_path: Path) -> None:
    def fails(folder: Path) -> None:
        raise ZeroDivisionError

    def lines(folder: Path) -> None:
        raise SettingError("a\nb")

    for give, says in ((lambda folder: None, "it is accepted"), (fails, "ZeroDivisionError"), (lines, "several lines")):
        assert says in (bad_inputs.problem(BadInput("x", "y", give, ""), tmp_path) or "")


def test_a_program_a_secret_and_a_file_outside_would_be_found(tmp_path: Path) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    (tmp_path / "secret.txt").write_text("s")

    def trace_of(act: Callable[[], object]) -> str:
        def give(_: Path) -> None:
            act()
            raise SettingError("no")

        return attacks.trace(BadInput("x", "y", give, "no"), folder) or ""

    assert trace_of(lambda: None) == ""
    assert "subprocess" in trace_of(lambda: subprocess.run(["true"], check=True))
    assert "outside" in trace_of(lambda: (tmp_path / "outside").write_text("x"))
    assert "secret" in trace_of((tmp_path / "secret.txt").read_text)
    assert "canary" in trace_of((folder / "canary").mkdir)


@pytest.mark.slow
@pytest.mark.parametrize("targets", MUTANTS, ids=lambda targets: targets.__name__)
def test_damaged_files_are_refused_or_sound(targets: fuzz.Targets) -> None:
    """In a process of its own, without the checks of types that tests run with."""
    for row in fuzz.measure(targets, MUTANTS[targets], processes=1):
        assert row.cases == MUTANTS[targets]
        row.require()


def test_a_reader_with_an_untyped_error_would_be_found(monkeypatch: pytest.MonkeyPatch) -> None:
    read, sizes = fuzz.ply.read_gaussians, list[int]()

    def careless(path: Path):
        sizes.append(path.stat().st_size)
        return read(path) if sizes[-1] == sizes[0] else {}[path]

    monkeypatch.setattr(fuzz.ply, "read_gaussians", careless)
    [row] = fuzz.measure(fuzz.binary, 50, only=["PLY"])
    assert not row.met
    assert row.worst == sum(size != sizes[0] for size in sizes) < 50
    assert row.where.startswith("mutant ")


def test_mutants_are_the_same_in_any_number_of_processes() -> None:
    first = [list(islice(fuzz.mutants("PLY", block, [bytes(100)]), 50)) for block in (0, 0, 1)]
    assert first[0] == first[1] != first[2]


@pytest.mark.slow
def test_a_short_soak_stays_finite() -> None:
    _, open_files, finite = soak.run(80)
    open_files.require()
    finite.require()


def test_a_row_that_is_not_a_number_or_has_no_case_is_not_met_and_one_with_few_cases_so_far() -> None:
    worst = Worst()
    assert not worst.row("nothing", "none", 1.0).met
    worst.add(float("nan"), "here")
    worst.add(0.5, "there")
    row = worst.row("nan", "none", 1.0)
    assert not row.met
    assert row.where == "here"
    few, enough = (Row("fine", "none", cases, 0.0, 0.0, "none", goal=100) for cases in (10, 100))
    assert ["**no**" in line for line in table([row, few, enough]).splitlines()[2:]] == [True, False, False]
    assert "| so far |" in table([few])
    assert "| yes |" in table([enough])


def test_the_command_writes_the_page_and_keeps_what_it_did_not_measure(tmp_path: Path) -> None:
    page = tmp_path / "stability.md"
    kept, replaced = (
        Row(what, "all", 1, 0.0, 0.0, "none", part=part) for what, part in (("old soak", "soak"), ("old", "gco"))
    )
    write(tmp_path / "stability.csv", [kept, replaced])
    assert main(["--only", "gco", "--out", str(page)]) == 0
    written = page.read_text()
    assert "| GCO: conflicts that an outlier hides | readable |" in written
    assert [row.what for row in read(tmp_path / "stability.csv")][-1] == "old soak"
    assert "| old |" not in written


def test_a_row_is_written_when_it_is_there(tmp_path: Path) -> None:
    """Some formats of the damaged files, measured one after the other, are one table."""
    page, few = tmp_path / "stability.md", ["--only", "fuzz", "--processes", "0", "--out"]
    write(tmp_path / "stability.csv", [Row("an old format", "all", 1, 0.0, 0.0, "none", part="fuzz")])
    formats = ["PLY", "COLMAP cameras.bin"]
    for name in formats:
        main([*few, str(page), "--formats", name, "--mutants", "20"])
    found = [row.what for row in read(tmp_path / "stability.csv")]
    assert found == ["an old format", *(f"damaged {name}: unsound, untyped or slow" for name in formats)]


def test_inputs_and_attacks_are_listed_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list"]) == 0
    listed = capsys.readouterr().out
    assert "PLY: count of 2^63\n" in listed
    assert "attack: llff: npy of objects\n" in listed
