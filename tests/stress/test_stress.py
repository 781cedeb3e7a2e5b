"""A slice of `python -m tests.stress`, and proof that each of its measurements can fail."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from clear_strategies.training import checkpoint
from rasterizers.reference import ReferenceRasterizer
from tests.helpers.backends import BACKENDS, why_not
from tests.stress import checkpoints, fuzz, gco, projection
from tests.stress.__main__ import _CLEAN, main
from tests.stress.rows import Row, Worst, table

EVERY = {"torch": 97, "warp": 499}


@pytest.mark.parametrize("name", ["torch", *BACKENDS])
def test_single_gaussians_agree_with_float64(name: str) -> None:
    if name != "torch" and (reason := why_not(name)):
        pytest.skip(str(reason))
    make = ReferenceRasterizer if name == "torch" else BACKENDS[name]
    for row in projection.measure(name, make(**_CLEAN), every=EVERY.get(name, 61)):
        row.require()


def test_an_image_that_is_off_is_found() -> None:
    class Darker(ReferenceRasterizer):
        def __call__(self, *arguments, **options):
            rendering = super().__call__(*arguments, **options)
            rendering.image = rendering.image * 0.99
            return rendering

    image, gradient = projection.measure("darker", Darker(**_CLEAN), every=997)
    assert not image.met
    assert gradient.met


def test_gco_agrees_with_sixty_digits_and_sees_conflicts_beside_an_outlier() -> None:
    for row in gco.measure(rows=40):
        row.require()


def test_no_fault_of_a_save_loses_a_checkpoint(tmp_path: Path) -> None:
    row = checkpoints.faults(tmp_path)
    assert row.cases > 100
    row.require()


def test_a_save_that_removes_before_it_writes_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save = checkpoint.save

    def careless(folder, saved, *, keep=3):
        for old in checkpoint.saved(folder):
            checkpoint._remove(old)
        return save(folder, saved, keep=keep)

    monkeypatch.setattr(checkpoint, "save", careless)
    assert not checkpoints.faults(tmp_path).met


def test_altered_bits_and_cut_files_are_refused(tmp_path: Path) -> None:
    checkpoints.integrity(tmp_path, 150).require()


def test_damaged_files_are_refused_or_sound(tmp_path: Path) -> None:
    for row in fuzz.measure(tmp_path, 250):
        row.require()


def test_a_reader_with_an_untyped_error_would_be_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        fuzz.ply, "read_gaussians", lambda path: torch.frombuffer(path.read_bytes()[:7], dtype=torch.float32)
    )
    rows = {row.what: row for row in fuzz.measure(tmp_path, 3)}
    assert not rows["damaged PLY: unsound, untyped or slow"].met


def test_a_row_that_is_not_a_number_or_has_no_case_is_not_met() -> None:
    worst = Worst()
    assert not worst.row("nothing", "none", 1.0).met
    worst.add(float("nan"), "here")
    worst.add(0.5, "there")
    row = worst.row("nan", "none", 1.0)
    assert not row.met
    assert row.where == "here"
    assert "**no**" in table([row, Row("fine", "none", 1, 0.0, 0.0, "none")])


def test_the_command_writes_the_page(tmp_path: Path) -> None:
    assert main(["--only", "gco", "--out", str(tmp_path / "stability.md")]) == 0
    assert "| GCO: conflicts that an outlier hides | readable |" in (tmp_path / "stability.md").read_text()
