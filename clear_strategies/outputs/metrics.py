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
import shlex
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import msgspec
import torch
from jaxtyping import Float
from torch import Tensor

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
    "bicubic and prior enlarge the LR photo of the view itself, which a run never sees of a test view: they show what "
    "this photo holds, not what can be learned from the other photos"
)

_LEGEND: Final = (
    "  Higher PSNR and SSIM are better, and lower GMSD, the error of edges. blur is above 0 where the picture is softer than "
    "the photo, and below 0 where it is harder."
)

MOST_TRAIN: Final = 50  # largest number of training views that are scored, evenly spaced
TRAIN_RENDERS: Final = 4  # number of training views whose renders are kept if there are no test views


class Scores(msgspec.Struct):
    """`ImageScores` in the file; null for a number that was not finite."""

    psnr: float | None
    ssim: float | None
    gmsd: float | None
    blur: float | None
    own: dict[str, float | None] = msgspec.field(default_factory=dict)

    @property
    def numbers(self) -> ImageScores:
        *four, own = msgspec.structs.astuple(self)
        return ImageScores(*map(as_float, four), own={name: as_float(x) for name, x in own.items()})


class Part(msgspec.Struct):
    """TABLE of the test or the training views."""

    against: str
    views: dict[str, dict[str, Scores]]
    mean: dict[str, Scores]


class Metrics(msgspec.Struct):
    """The fields of metrics.json that this package reads."""

    scene: str
    strategies: list[str]
    seed: int
    iterations: Count
    gaussians: Count
    seconds: Positive
    conflict: dict[str, float | None]
    synthetic_prior: bool
    test: Part
    train: Part
    provenance: dict[str, Any]
    config: dict[str, Any] = msgspec.field(default_factory=dict)
    overrides: list[str] | None = None

    @property
    def shown(self) -> Part:
        """The test views; the training views if there are none."""
        return self.test if self.test.mean else self.train


def read(path: Path, remedy: str) -> Metrics:
    """Read metrics.json."""
    content = typed(path, read_object(path), Metrics, remedy=remedy)
    content.config = plain_settings(path, content.config)
    return content


def as_float(value: float | None) -> float:
    """A number of the file; NaN for null."""
    return math.nan if value is None else value


Table = dict[str, dict[str, ImageScores]]
"""view -> image ("ours", "bicubic", "prior") -> scores."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Scores of the views, the images that each part was compared with, and the renders of the test views, or of a few training
    views if there are none.

    Args:
        train: scores of at most `MOST_TRAIN` of the `train_views` training views.
    """

    test: Table
    train: Table
    against: Mapping[str, str]
    renders: Mapping[str, Float[Tensor, "H W 3"]]
    train_views: int

    def mean(self, part: str, image: str = "ours") -> ImageScores | None:
        """Mean over the views of a part ("test", "train") that have this image."""
        return mean_scores([row[image] for row in getattr(self, part).values() if image in row])

    def against_lr(self, part: str) -> bool:
        """Return True if views of a part are compared with their LR photos, since their HR photos are unknown."""
        return "LR" in self.against.get(part, "")


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
    tables: dict[str, Table] = {"test": {}, "train": {}}
    against = {"test": _against(scene.test), "train": _against(scene.train)}
    test = [view for view in scene.test if view.lr.shows_something]
    train = spaced([view for view in scene.train if view.lr.shows_something], MOST_TRAIN)
    kept = {view.name for view in test or spaced(train, TRAIN_RENDERS)}
    with ThreadPoolExecutor(n := threads()) as scorers:
        done = Progress("scores", "views", len(test) + len(train))
        scored = deque[tuple[Table, str, Future[dict[str, ImageScores]]]]()

        def take() -> None:
            table, name, scores = scored.popleft()
            table[name] = scores.result()
            done(sum(map(len, tables.values())))

        for part, view in [*(("test", view) for view in test), *(("train", view) for view in train)]:
            image = render(view).clamp(0, 1)
            if not bool(image.isfinite().all()):
                _log.warning("%s: its render is not finite and has no scores.", view.name)
            if view.name in kept:
                renders[view.name] = image
            scored.append((tables[part], view.name, scorers.submit(_scores_of, view, image, down, own)))
            if len(scored) > n:  # bounds the number of renders in memory
                take()
        while scored:
            take()
    for part in tables:
        if "LR" in against[part]:
            _log.debug("%s views: HR is unknown; images reduced by %s were compared with the LR photos.", part, down)
    return Evaluation(tables["test"], tables["train"], against, renders, len(scene.train))


def to_json(evaluation: Evaluation, **facts: Any) -> dict[str, Any]:
    """The content of metrics.json; `facts` are its other keys."""
    content: dict[str, Any] = {**facts, "note": NOTE}
    for part in ("test", "train"):
        table: Table = getattr(evaluation, part)
        shown = sorted({image for row in table.values() for image in row})
        means = {image: evaluation.mean(part, image) for image in shown}
        content[part] = {
            "against": evaluation.against[part],
            "views": {view: {image: _in_file(s) for image, s in row.items()} for view, row in table.items()},
            "mean": {image: _in_file(mean) for image, mean in means.items() if mean is not None},
        }
    content["train"]["of"] = evaluation.train_views
    return content


def _in_file(scores: ImageScores) -> dict[str, Any]:
    return {name: x for name, x in asdict(scores).items() if x != {}}


def _against(views: Sequence[View]) -> str:
    kinds = {"LR" if view.truth is None else "HR" for view in views}
    return f"{' and '.join(sorted(kinds))} photos" if kinds else "nothing"


def _scores_of(
    view: View, image: Float[Tensor, "H W 3"], down: DownKernel, own: Mapping[str, Metric] | None
) -> dict[str, ImageScores]:
    """Score the images of a view."""
    truth, mask, scored = view.truth, view.hr.shown, {"ours": image}
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
    rows = [(part, *row) for part in ("test", "train") for row in _rows(part, evaluation)]
    width = max((len(image) for _, image, _ in rows), default=0)
    told = ", ".join(f"{name} {duration(part)}" for name, part in parts.items() if part >= 1)
    lines = [f"done in {duration(seconds)}{f' ({told})' if told else ''}: {folder}"]
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
    look = f"{folder / 'contact_sheet.jpg'}, or clear-strategies view {shlex.quote(str(folder))}"
    return "\n".join([*lines, f"  look next: {look}"])


def describe_job(number: int, folder: Path, evaluation: Evaluation, seconds: float) -> str:
    """The message at the end of a job of a sweep, one line."""
    means = ((part, mean) for part in ("test", "train") if (mean := evaluation.mean(part)) is not None)
    score = next((f", {part} views {mean.psnr:.2f} dB" for part, mean in means), "")
    return f"job {number}: done in {duration(seconds)}{score}: {_relative(folder)}"


def _relative(folder: Path) -> Path:
    """The path relative to the working directory, if the folder lies in it."""
    return folder.relative_to(Path.cwd()) if Path.cwd() in folder.parents else folder


def _rows(part: str, evaluation: Evaluation) -> Iterator[tuple[str, str]]:
    # bicubic and prior are made from the LR photos, so a comparison with these would be meaningless.
    for image in ("ours",) if evaluation.against_lr(part) else ("ours", "bicubic", "prior"):
        if (mean := evaluation.mean(part, image)) is not None:
            yield image, _numbers(mean)


def _numbers(m: ImageScores) -> str:
    own = "".join(f"   {name} {x:7.4f}" for name, x in m.own.items())
    return f"PSNR {m.psnr:6.2f} dB   SSIM {m.ssim:7.4f}   GMSD {m.gmsd:7.4f}   blur {m.blur:+.4f}{own}"
