"""Scores of a whole scene, and the content of metrics.json.

metrics.json: {"scene", "method", "strategies", "seed", "iterations", "gaussians", "seconds", "conflict",
"synthetic_prior", "baseline", "config", "provenance", "note", "test": TABLE, "train": TABLE}, where TABLE is {"against", "views":
{view: {image: scores}}, "mean": {image: scores}}.

- "method" is the name of a published baseline (`+method=`), null where none was chosen.
- The images are "ours", "bicubic" (U of the view's own LR photo) and "prior" (the view's SR image). "bicubic" is missing where
  the HR photo is unknown, both where the HR side is photos (`photos_are=both`).
- "baseline" is the one that trained beside the run (`fit.baseline`), null where none did: {"folder", "seconds", "test":
  scores, "train": scores}, the means of its renders. A part without views is not there.
- "against" says what they are compared with: "HR photos"; "LR photos", after D, where the HR photos are unknown; "HR and
  LR photos" where that differs between views.
- A number that is not finite is null.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.view import View
from clear_strategies.data import json_shapes as shapes
from clear_strategies.data.scene import Scene
from clear_strategies.data.strict_json import read_object
from clear_strategies.outputs.figures import spaced
from clear_strategies.outputs.image_scores import ImageScores, mean_scores, score
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

NOTE: Final = (
    "bicubic and prior are made from the view's own LR photo, which a run never sees of a test view: they show what "
    "that photo allows, not what view synthesis can reach"
)

TRAIN_RENDERS: Final = 4  # training views whose renders are kept where there are no test views
_TABLE: Final = shapes.table(shapes.number(null=True))
_PART: Final = shapes.record(against=shapes.text(), views=shapes.table(shapes.table(_TABLE)), mean=shapes.table(_TABLE))
SHAPE: Final = shapes.record(
    scene=shapes.text(),
    strategies=shapes.each(shapes.text()),
    seed=shapes.whole(-shapes.LARGEST),
    iterations=shapes.whole(),
    gaussians=shapes.whole(),
    seconds=shapes.number(least=0),
    conflict=_TABLE,
    synthetic_prior=shapes.flag,
    test=_PART,
    train=_PART,
    provenance=shapes.record({"date": shapes.text(), "plan": shapes.table(shapes.anything)}),
    optional={"config": shapes.table(shapes.anything), "method": shapes.text(null=True)},
)
"""What metrics.json of a finished run holds, for everybody who reads one."""


def read(path: Path, remedy: str) -> dict[str, Any]:
    """The content of metrics.json.

    Raises:
        DataError: it cannot be read, or is not that of a finished run; the message ends with `remedy`.
    """
    content = read_object(path)
    shapes.require(path, content, SHAPE, remedy)
    return content


Table = dict[str, dict[str, ImageScores]]
"""view -> image ("ours", "bicubic", "prior") -> scores."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Scores of all views, what each part was compared with, and the renders of the test views; where there are none, those of
    a few training views.
    """

    test: Table
    train: Table
    against: Mapping[str, str]
    renders: Mapping[str, Float[Tensor, "H W 3"]]

    def mean(self, part: str, image: str = "ours") -> ImageScores | None:
        """Mean over the views of a part ("test", "train") that have this image."""
        return mean_scores([row[image] for row in getattr(self, part).values() if image in row])

    def against_lr(self, part: str) -> bool:
        """Whether views of a part are compared with their LR photos, since their HR photos are unknown."""
        return "LR" in self.against.get(part, "")


def evaluate(
    scene: Scene, render: Callable[[Camera], Float[Tensor, "H W 3"]], *, down: DownKernel = "bicubic"
) -> Evaluation:
    """Render and score every view. Where the HR photo is unknown, D of the render is compared with the LR photo."""
    renders: dict[str, Tensor] = {}
    tables: dict[str, Table] = {"test": {}, "train": {}}
    against = {"test": _against(scene.test), "train": _against(scene.train)}
    kept = {view.name for view in scene.test or spaced(scene.train, TRAIN_RENDERS)}
    for part, views in (("test", scene.test), ("train", scene.train)):
        for view in views:
            image = render(view.hr.camera).clamp(0, 1)
            if not bool(image.isfinite().all()):
                _log.warning("%s: its render is not finite and has no scores.", view.name)
            if view.name in kept:
                renders[view.name] = image
            tables[part][view.name] = _scores_of(view, image, down)
        if "LR" in against[part]:
            _log.debug("%s views: HR is unknown; images reduced by %s were compared with the LR photos.", part, down)
    return Evaluation(tables["test"], tables["train"], against, renders)


def to_json(evaluation: Evaluation, **facts: Any) -> dict[str, Any]:
    """The content of metrics.json; `facts` are its other keys."""
    content: dict[str, Any] = {**facts, "note": NOTE}
    for part in ("test", "train"):
        table: Table = getattr(evaluation, part)
        shown = sorted({image for row in table.values() for image in row})
        means = {image: evaluation.mean(part, image) for image in shown}
        content[part] = {
            "against": evaluation.against[part],
            "views": {view: {image: asdict(s) for image, s in row.items()} for view, row in table.items()},
            "mean": {image: asdict(mean) for image, mean in means.items() if mean is not None},
        }
    return content


def _against(views: Sequence[View]) -> str:
    kinds = {"LR" if view.truth is None else "HR" for view in views}
    return f"{' and '.join(sorted(kinds))} photos" if kinds else "nothing"


def _scores_of(view: View, image: Float[Tensor, "H W 3"], down: DownKernel) -> dict[str, ImageScores]:
    if view.truth is None:
        shown = {"ours": image, "prior": view.hr.image}
        return {name: score(images.downsample(i, view.factor, down), view.lr.image) for name, i in shown.items()}
    shown = {"ours": image}
    if not view.hr_is_photo:  # else no SR has a part
        shown |= {"bicubic": images.upsample(view.lr.image, view.factor), "prior": view.hr.image}
    return {name: score(i, view.truth) for name, i in shown.items()}
