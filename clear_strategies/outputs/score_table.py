"""The scores that a run logs at its end."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Final

from clear_strategies.outputs.baseline import Baseline
from clear_strategies.outputs.image_scores import ImageScores
from clear_strategies.outputs.metrics import NOTE, Evaluation

OURS_MINUS_BASELINE: Final = "ours − baseline"
_LEGEND: Final = (
    "  PSNR, SSIM: more is better; GMSD, the error of edges: less; blur, above 0 softer than the photo and below it harder: "
    "closer to 0."
)


def describe(folder: Path, evaluation: Evaluation, seconds: float, baseline: Baseline | None = None) -> str:
    """The mean scores of the test and training views: of the run, of what it is compared with, and the difference."""
    beside = "" if baseline is None else f" (the baseline in {baseline.seconds:.0f} s)"
    rows = [(part, *row) for part in ("test", "train") for row in _rows(part, evaluation, baseline)]
    width = max((len(image) for _, image, _ in rows), default=0)
    lines = [f"  {part:<5}  {image:<{width}}  {numbers}" for part, image, numbers in rows]
    note = f"  {NOTE}." if any(image in ("bicubic", "prior") for _, image, _ in rows) else ""
    unknown = [part for part in ("test", "train") if evaluation.against_lr(part)]
    reduced = (
        f"  {' and '.join(unknown)}: nobody knows the HR photos, so reduced images are compared with the LR photos."
    )
    notes = filter(None, [_LEGEND if lines else "", note, reduced if unknown else ""])
    return "\n".join([f"done in {seconds:.0f} s{beside}: {_near(folder)}", *lines, *notes, _look_next(_near(folder))])


def describe_baseline(baseline: Baseline) -> str:
    return f"the baseline: {_in_short(baseline.seconds, baseline.means)}: {_near(baseline.folder)}"


def describe_job(number: int, folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """One line, of a job among many."""
    means = {part: mean for part in ("test", "train") if (mean := evaluation.mean(part)) is not None}
    return f"job {number}: {_in_short(seconds, means)}: {_near(folder)}"


def _in_short(seconds: float, means: Mapping[str, ImageScores]) -> str:
    part = next(iter(means), None)
    return f"done in {seconds:.0f} s" + ("" if part is None else f", {part} views {means[part].psnr:.2f} dB")


def _near(folder: Path) -> Path:
    """The folder as it is called from here."""
    here = Path.cwd()
    return folder.relative_to(here) if here in folder.parents else folder


def _look_next(folder: Path) -> str:
    pages = [f"{page} in a browser" for page in (folder / "splat.html",) if page.exists()]
    shown = ", ".join([*pages, str(folder / "contact_sheet.png")])
    return f"  look next: {shown}, or clear-strategies view {shlex.quote(str(folder))}"


def _rows(part: str, evaluation: Evaluation, baseline: Baseline | None) -> Iterator[tuple[str, str]]:
    ours, theirs = evaluation.mean(part), None if baseline is None else baseline.means.get(part)
    if theirs is not None:
        yield "baseline", _numbers(theirs)
    if ours is not None:
        yield "ours", _numbers(ours)
    if ours is not None and theirs is not None:
        difference = (getattr(ours, f.name) - getattr(theirs, f.name) for f in fields(ImageScores))
        yield OURS_MINUS_BASELINE, _numbers(ImageScores(*difference), "+")
    if evaluation.against_lr(part):
        return  # they are made from the very photos that they would be compared with
    for image in ("bicubic", "prior"):
        if (mean := evaluation.mean(part, image)) is not None:
            yield image, _numbers(mean)


def _numbers(m: ImageScores, sign: str = "") -> str:
    return f"PSNR {m.psnr:{sign}6.2f} dB   SSIM {m.ssim:{sign}7.4f}   GMSD {m.gmsd:{sign}7.4f}   blur {m.blur:+.4f}"
