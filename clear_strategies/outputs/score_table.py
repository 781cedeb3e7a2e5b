"""The scores that a run logs at its end."""

from __future__ import annotations

import operator
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import astuple
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
    folder, of_baseline = _relative(folder), "" if baseline is None else f" (the baseline in {baseline.seconds:.0f} s)"
    rows = [(part, *row) for part in ("test", "train") for row in _rows(part, evaluation, baseline)]
    width = max((len(image) for _, image, _ in rows), default=0)
    lines = [f"done in {seconds:.0f} s{of_baseline}: {folder}"]
    lines += [f"  {part:<5}  {image:<{width}}  {numbers}" for part, image, numbers in rows]
    if rows:
        lines.append(_LEGEND)
    if any(image in ("bicubic", "prior") for _, image, _ in rows):
        lines.append(f"  {NOTE}.")
    if unknown := " and ".join(part for part in ("test", "train") if evaluation.against_lr(part)):
        lines.append(f"  {unknown}: the HR photos are unknown, so reduced images are compared with the LR photos.")
    if evaluation.train and len(evaluation.train) < evaluation.train_views:
        lines.append(
            f"  train: {len(evaluation.train)} of the {evaluation.train_views} views, evenly spaced, are scored."
        )
    page = f"{folder / 'splat.html'} in a browser, " if (folder / "splat.html").exists() else ""
    look = f"{page}{folder / 'contact_sheet.png'}, or clear-strategies view {shlex.quote(str(folder))}"
    return "\n".join([*lines, f"  look next: {look}"])


def describe_baseline(baseline: Baseline) -> str:
    """One line."""
    return f"the baseline: {_in_short(baseline.seconds, baseline.means)}: {_relative(baseline.folder)}"


def describe_job(number: int, folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """One line, of a job among many."""
    means = {part: mean for part in ("test", "train") if (mean := evaluation.mean(part)) is not None}
    return f"job {number}: {_in_short(seconds, means)}: {_relative(folder)}"


def _in_short(seconds: float, means: Mapping[str, ImageScores]) -> str:
    part = next(iter(means), None)
    return f"done in {seconds:.0f} s" + ("" if part is None else f", {part} views {means[part].psnr:.2f} dB")


def _relative(folder: Path) -> Path:
    """Relative to the working directory, where the folder lies in it."""
    return folder.relative_to(Path.cwd()) if Path.cwd() in folder.parents else folder


def _rows(part: str, evaluation: Evaluation, baseline: Baseline | None) -> Iterator[tuple[str, str]]:
    ours, base = evaluation.mean(part), None if baseline is None else baseline.means.get(part)
    if base is not None:
        yield "baseline", _numbers(base)
    if ours is not None:
        yield "ours", _numbers(ours)
    if ours is not None and base is not None:
        difference = map(operator.sub, astuple(ours), astuple(base))
        yield OURS_MINUS_BASELINE, _numbers(ImageScores(*difference), "+")
    if evaluation.against_lr(part):
        return  # bicubic and prior are made from the photos that they would be compared with
    for image in ("bicubic", "prior"):
        if (mean := evaluation.mean(part, image)) is not None:
            yield image, _numbers(mean)


def _numbers(m: ImageScores, sign: str = "") -> str:
    return f"PSNR {m.psnr:{sign}6.2f} dB   SSIM {m.ssim:{sign}7.4f}   GMSD {m.gmsd:{sign}7.4f}   blur {m.blur:+.4f}"
