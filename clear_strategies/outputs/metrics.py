"""Scores of a whole scene, the content of metrics.json, and the messages about them at the end of a run.

metrics.json: {"scene", "method", "strategies", "overrides", "seed", "iterations", "gaussians", "seconds", "conflict",
"synthetic_prior", "config", "provenance", "note", "test": TABLE, "train": TABLE}, where TABLE is {"against", "views":
{view: {image: scores}}, "mean": {image: scores}}.

- "method" is the name of a published baseline (`+method=`), null where none was chosen.
- "overrides" are those of the command line, null if they are unknown. Hydra's own file of them is no record of the run, since a
  later command rewrites it even if that command is refused.
- The images are "ours", "bicubic" (U of the view's own LR photo) and "prior" (the view's SR image). "bicubic" is missing if the
  HR photo is unknown, both are if the HR side is photos (`photos_are=both`).
- "against" names the images of the comparison: "HR photos"; "LR photos", after D, if the HR photos are unknown; "HR and LR
  photos" if that differs between views.
- The training TABLE has another key, "of": the number of training views, of which at most 50 are scored.
- The scores are "psnr", "ssim", "gmsd" and "blur", and if the run has metrics of its own, "own": {name: number}.
- A number that is not finite is null.
"""

from __future__ import annotations

import logging
import math
import re
import shlex
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Final

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.progress import Progress, duration
from clear_strategies.core.view import View
from clear_strategies.data.scene import Scene
from clear_strategies.data.strict_json import Count, Positive, plain_settings, read_object, typed
from clear_strategies.outputs.figures import spaced
from clear_strategies.outputs.image_scores import ImageScores, Metric, Truth, mean_scores
from rasterizers.native import threads

_log = logging.getLogger(__name__)

NOTE: Final = (
    "bicubic and prior are the LR photo of the scored view itself, enlarged by interpolation and by the prior; a run does not "
    "see the photos of test views"
)

_LEGEND: Final = (
    "  Higher PSNR and SSIM are better, and lower GMSD, the error of edges. A blur above 0 means that the picture is softer than "
    "the photo, below 0 that it is sharper."
)

MOST_TRAIN: Final = 50  # largest number of training views that are scored, evenly spaced
TRAIN_RENDERS: Final = 4  # number of training views whose renders are kept if there are no test views


Table = dict[str, dict[str, ImageScores]]
"""view -> image ("ours", "bicubic", "prior") -> scores."""


class Part(msgspec.Struct, omit_defaults=True):
    """TABLE of the test or the training views.

    Args:
        mean: over the views that have the image; without views, there is none.
        of: the number of training views, of which `views` has at most `MOST_TRAIN`; None for test views.
    """

    against: str
    views: Table
    mean: dict[str, ImageScores]
    of: Count | None = None

    @property
    def against_lr(self) -> bool:
        """True if views are compared with their LR photos, since their HR photos are unknown."""
        return "LR" in self.against


class Scored(msgspec.Struct):
    """The scores of both parts."""

    test: Part
    train: Part

    @property
    def shown(self) -> Part:
        """The test views; the training views if there are none."""
        return self.test if self.test.mean else self.train

    @property
    def psnr(self) -> float | None:
        """The mean PSNR of the shown views, dB; None if there is none."""
        mean = self.shown.mean.get("ours")
        return None if mean is None else mean.psnr


class Evaluation(Scored):
    """Scores, and the renders of the test views, or of a few training views if there are none."""

    renders: Mapping[str, Float[Tensor, "H W 3"]]


class Metrics(Scored):
    """The fields of metrics.json that this package reads."""

    scene: str
    strategies: list[str]
    seed: int
    iterations: Count
    gaussians: Count
    seconds: Positive
    conflict: dict[str, float]
    synthetic_prior: bool
    provenance: dict[str, Any]
    config: dict[str, Any] = msgspec.field(default_factory=dict)
    method: str | None = None
    overrides: list[str] | None = None


def read(path: Path, remedy: str) -> Metrics:
    content = read_object(path)
    numbers = {key: _with_nan(content[key]) for key in ("test", "train", "conflict") if key in content}
    metrics = typed(path, content | numbers, Metrics, remedy=remedy)
    metrics.config = plain_settings(path, metrics.config)
    return metrics


def write(path: Path, evaluation: Evaluation, **facts: Any) -> None:
    """Write metrics.json; `facts` are its other keys."""
    files.write_json(path, {**facts, "note": NOTE, "test": evaluation.test, "train": evaluation.train})


def _with_nan(value: Any) -> Any:
    """Replace null, which stands for a number that was not finite, by NaN."""
    if isinstance(value, dict):
        return {key: _with_nan(inner) for key, inner in value.items()}
    return math.nan if value is None else value


def evaluate(
    scene: Scene, render: Callable[[View], Float[Tensor, "H W 3"]], *, down: DownKernel = "bicubic",
    own: Mapping[str, Metric] | None = None,
) -> Evaluation:  # fmt: skip
    """Render and score the views, or a sample of many training views. Pixels that a mask hides do not count. Views are scored
    while the next ones are rendered, each by one thread, since scikit-image uses one.

    If the HR photo is unknown, D of the render is compared with the LR photo.

    Args:
        own: as of `Truth`; called in several threads.
    """
    renders: dict[str, Tensor] = {}
    test, train = Table(), Table()
    of_test = [view for view in scene.test if view.lr.visible.any()]
    of_train = spaced([view for view in scene.train if view.lr.visible.any()], MOST_TRAIN)
    kept = {view.name for view in of_test or spaced(of_train, TRAIN_RENDERS)}
    with ThreadPoolExecutor(n := threads()) as scorers:
        done = Progress("scores", "views", len(of_test) + len(of_train))
        scored = deque[tuple[Table, str, Future[dict[str, ImageScores]]]]()

        def take() -> None:
            table, name, scores = scored.popleft()
            table[name] = scores.result()
            done(len(test) + len(train))

        for table, view in [*((test, view) for view in of_test), *((train, view) for view in of_train)]:
            image = render(view).clamp(0, 1)
            if not bool(image.isfinite().all()):
                _log.warning("%s: its render is not finite and has no scores.", view.name)
            if view.name in kept:
                renders[view.name] = image
            scored.append((table, view.name, scorers.submit(_scores_of, view, image, down, own)))
            if len(scored) > n:  # bounds the number of renders in memory
                take()
        while scored:
            take()
    parts = {"test": _part(scene.test, test), "train": _part(scene.train, train, of=len(scene.train))}
    for name, part in parts.items():
        if part.against_lr:
            _log.debug("%s views: HR is unknown; images reduced by %s were compared with the LR photos.", name, down)
    return Evaluation(**parts, renders=renders)


def _part(views: Sequence[View], table: Table, of: int | None = None) -> Part:
    """The scores of some or all of the views, and their means."""
    kinds = {"LR" if view.true_hr is None else "HR" for view in views}
    scored = sorted({image for row in table.values() for image in row})
    means = {image: mean_scores([row[image] for row in table.values() if image in row]) for image in scored}
    return Part(f"{' and '.join(sorted(kinds))} photos" if kinds else "nothing", table, means, of)


def _scores_of(
    view: View, image: Float[Tensor, "H W 3"], down: DownKernel, own: Mapping[str, Metric] | None
) -> dict[str, ImageScores]:
    truth, mask, scored = view.true_hr, view.hr.shown, {"ours": image}
    if truth is None:
        if mask is not None:  # else D would mix hidden pixels into shown ones
            scored["ours"] = torch.where(mask[..., None], image, view.hr.image)
        truth, mask, scored["prior"] = view.lr.image, view.lr.shown, view.hr.image
        scored = {name: images.downsample(i, view.factor, down) for name, i in scored.items()}
    elif not view.hr_is_photo:  # else there is no SR image
        scored |= {"bicubic": images.upsample(view.lr.image, view.factor), "prior": view.hr.image}
    against = Truth(truth, mask, own)
    return {name: against.score(image) for name, image in scored.items()}


def describe(folder: Path, evaluation: Evaluation, seconds: float, parts: Mapping[str, float]) -> str:
    """The message at the end of a run: its duration, and the mean scores of its views, of bicubic and of the prior.

    Args:
        seconds: of the whole command. parts: of its stages, by name; those of a second or more are shown.
    """
    folder = _relative(folder)
    test, train = evaluation.test, evaluation.train
    rows = [(name, *row) for name, part in (("test", test), ("train", train)) for row in _rows(part)]
    width = max((len(image) for _, image, _ in rows), default=0)
    told = ", ".join(f"{name} {duration(part)}" for name, part in parts.items() if part >= 1)
    lines = [f"done in {duration(seconds)}{f' ({told})' if told else ''}: {folder}"]
    lines += [f"  {name:<5}  {image:<{width}}  {numbers}" for name, image, numbers in rows]
    if rows:
        lines.append(_LEGEND)
    if any(image in ("bicubic", "prior") for _, image, _ in rows):
        lines.append(f"  {NOTE}.")
    if unknown := " and ".join(["test"] * test.against_lr + ["train"] * train.against_lr):
        lines.append(f"  {unknown}: the HR photos are unknown, so reduced images are compared with the LR photos.")
    if train.views and len(train.views) < (train.of or 0):
        lines.append(f"  train: {len(train.views)} of the {train.of} views, evenly spaced, are scored.")
    run = shlex.quote(re.sub("^-", "./-", str(folder)))  # else it would be read as an option
    look = f"{folder / 'contact_sheet.jpg'}, or clear-strategies view {run}"
    return "\n".join([*lines, f"  look next: {look}"])


def describe_job(number: int, folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """The message at the end of a job of a sweep, one line."""
    kind, psnr = "test" if evaluation.test.mean else "train", evaluation.psnr
    score = "" if psnr is None else f", {kind} views {psnr:.2f} dB"
    return f"job {number}: done in {duration(seconds)}{score}: {_relative(folder)}"


def _relative(folder: Path) -> Path:
    """The path relative to the working directory, if the folder lies in it."""
    return folder.relative_to(Path.cwd()) if Path.cwd() in folder.parents else folder


def _rows(part: Part) -> Iterator[tuple[str, str]]:
    # bicubic and prior are made from the LR photos, so a comparison with these would be meaningless.
    for image in ("ours",) if part.against_lr else ("ours", "bicubic", "prior"):
        if image in part.mean:
            yield image, _numbers(part.mean[image])


def _numbers(m: ImageScores) -> str:
    own = "".join(f"   {name} {x:7.4f}" for name, x in m.own.items())
    return f"PSNR {m.psnr:6.2f} dB   SSIM {m.ssim:7.4f}   GMSD {m.gmsd:7.4f}   blur {m.blur:+.4f}{own}"
