"""The table of scores at the end of a run."""

from __future__ import annotations

from pathlib import Path

import pytest

from clear_strategies.outputs.baseline import Baseline
from clear_strategies.outputs.image_scores import ImageScores
from clear_strategies.outputs.metrics import NOTE, Evaluation, Table
from clear_strategies.outputs.score_table import describe, describe_baseline

OURS, THEIRS, BICUBIC = (
    ImageScores(23.5, 0.7, 0.1, 0.01), ImageScores(23.09, 0.687, 0.12, -0.02), ImageScores(22.0, 0.5, 0.16, 0.2),
)  # fmt: skip
TABLE: Table = {"view": {"ours": OURS, "bicubic": BICUBIC, "prior": BICUBIC}}
BASELINE = Baseline(Path("run/baseline"), {"test": THEIRS}, {"view": THEIRS}, 11.2)


def rows(text: str) -> dict[str, str]:
    return {line[:25].strip(): line[25:].strip() for line in text.splitlines()[1:]}


def test_the_baseline_and_the_difference_stand_beside_ours() -> None:
    text = describe(Path("run"), Evaluation(TABLE, {}, {}, {}, 0), 12.7, BASELINE)
    assert text.startswith("done in 13 s (the baseline in 11 s): run\n")
    found = rows(text)
    assert list(found)[:5] == [f"test   {n}" for n in ("baseline", "ours", "ours − baseline", "bicubic", "prior")]
    assert found["test   ours − baseline"].split() == [
        "PSNR", "+0.41", "dB", "SSIM", "+0.0130", "GMSD", "-0.0200", "blur", "+0.0300",
    ]  # fmt: skip
    *_, meanings, note, look_next = text.splitlines()
    assert "GMSD" in meanings
    assert note == f"  {NOTE}."
    assert look_next == "  look next: run/contact_sheet.png, or clear-strategies view run"


def test_what_is_missing_has_no_row_and_no_note() -> None:
    def told(*tables: Table, against: str = "HR photos", baseline: Baseline | None = None) -> str:
        return describe(Path("run"), Evaluation(*tables, {"train": against}, {}, 200), 12.7, baseline)

    def images(text: str) -> list[str]:
        return [line.split()[1] for line in text.splitlines() if line.startswith("  train ")]

    # Of the baseline only test views are known.
    assert images(told({}, TABLE, baseline=BASELINE)) == ["ours", "bicubic", "prior"]
    assert "baseline" not in told(TABLE, {})
    assert NOTE not in told({"view": {"ours": OURS}}, {})
    # An SR image is not compared with the photo that it is made of.
    reduced = told({}, TABLE, against="LR photos")
    assert images(reduced) == ["ours"]
    assert NOTE not in reduced
    assert "train: the HR photos are unknown" in reduced
    assert "train: 1 of the 200 views" in reduced


@pytest.mark.parametrize(("means", "said"), [({"test": THEIRS}, ", test views 23.09 dB"), ({}, "")])
def test_the_baseline_is_told_in_one_line(means: dict[str, ImageScores], said: str) -> None:
    told = describe_baseline(Baseline(Path("run/baseline"), means, {}, 11.2))
    assert told == f"the baseline: done in 11 s{said}: run/baseline"
