"""The scores that a run logs at its end."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from clear_strategies.outputs.image_scores import ImageScores
from clear_strategies.outputs.metrics import NOTE, Evaluation

_LEGEND: Final = (
    "  PSNR, SSIM: more is better; GMSD, the error of edges: less; blur, above 0 softer than the photo and below it harder: "
    "closer to 0."
)


def describe(folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """The mean scores of the test and training views: of the run, and of the images that it is compared with."""
    folder = _relative(folder)
    rows = [(part, *row) for part in ("test", "train") for row in _rows(part, evaluation)]
    width = max((len(image) for _, image, _ in rows), default=0)
    lines = [f"done in {seconds:.0f} s: {folder}"]
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
    look = f"{folder / 'contact_sheet.png'}, or clear-strategies view {shlex.quote(str(folder))}"
    return "\n".join([*lines, f"  look next: {look}"])


def describe_job(number: int, folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """One line, of a job among many."""
    means = ((part, mean) for part in ("test", "train") if (mean := evaluation.mean(part)) is not None)
    score = next((f", {part} views {mean.psnr:.2f} dB" for part, mean in means), "")
    return f"job {number}: done in {seconds:.0f} s{score}: {_relative(folder)}"


def _relative(folder: Path) -> Path:
    """Relative to the working directory, where the folder lies in it."""
    return folder.relative_to(Path.cwd()) if Path.cwd() in folder.parents else folder


def _rows(part: str, evaluation: Evaluation) -> Iterator[tuple[str, str]]:
    # bicubic and prior are made from the LR photos, so they are not compared with these.
    for image in ("ours",) if evaluation.against_lr(part) else ("ours", "bicubic", "prior"):
        if (mean := evaluation.mean(part, image)) is not None:
            yield image, _numbers(mean)


def _numbers(m: ImageScores) -> str:
    return f"PSNR {m.psnr:6.2f} dB   SSIM {m.ssim:7.4f}   GMSD {m.gmsd:7.4f}   blur {m.blur:+.4f}"
