"""The scores that a run logs at its end."""

from __future__ import annotations

from collections.abc import Iterator
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
    next_ = f"  look next: {folder / 'contact_sheet.png'}, or clear-strategies view {folder}"
    return "\n".join(
        [f"done in {seconds:.0f} s{beside}: {folder}", *lines, *filter(None, [_LEGEND if lines else "", note]), next_]
    )


def describe_baseline(baseline: Baseline) -> str:
    """One line."""
    part = next(iter(baseline.means), None)
    scores = "" if part is None else f", {part} views {baseline.means[part].psnr:.2f} dB"
    return f"the baseline: done in {baseline.seconds:.0f} s{scores}: {baseline.folder}"


def _rows(part: str, evaluation: Evaluation, baseline: Baseline | None) -> Iterator[tuple[str, str]]:
    ours, theirs = evaluation.mean(part), None if baseline is None else baseline.means.get(part)
    if theirs is not None:
        yield "baseline", _numbers(theirs)
    if ours is not None:
        yield "ours", _numbers(ours)
    if ours is not None and theirs is not None:
        yield OURS_MINUS_BASELINE, _numbers(_difference(ours, theirs), "+")
    for image in ("bicubic", "prior"):
        if (mean := evaluation.mean(part, image)) is not None:
            yield image, _numbers(mean)


def _difference(a: ImageScores, b: ImageScores) -> ImageScores:
    return ImageScores(*(getattr(a, f.name) - getattr(b, f.name) for f in fields(ImageScores)))


def _numbers(m: ImageScores, sign: str = "") -> str:
    return f"PSNR {m.psnr:{sign}6.2f} dB   SSIM {m.ssim:{sign}7.4f}   GMSD {m.gmsd:{sign}7.4f}   blur {m.blur:+.4f}"
