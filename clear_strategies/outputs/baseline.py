"""The baseline that trained beside a run (`fit.baseline`), read from its folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from clear_strategies.data.view_names import file_stem
from clear_strategies.errors import DataError
from clear_strategies.outputs import metrics
from clear_strategies.outputs.image_scores import ImageScores

FOLDER: Final = "baseline"
"""Its name in the folder of the run."""
_TRAIN_AGAIN: Final = "remove this baseline's metrics.json: it is then trained again"


def overrides_of(run: Iterable[str]) -> list[str]:
    """The overrides of the baseline beside a run with these overrides: all but those of its strategies."""
    return [override for override in run if not override.lstrip("+~").startswith(("strategy=", "strategies."))]


@dataclass(frozen=True, slots=True)
class Baseline:
    """A finished baseline.

    Args:
        means: part ("test", "train") -> mean scores of its renders; a part without views is missing.
        views: test view -> scores of its render.
        seconds: of training.
    """

    folder: Path
    means: Mapping[str, ImageScores]
    views: Mapping[str, ImageScores]
    seconds: float

    @classmethod
    def read(cls, folder: Path) -> Baseline:
        """Read a run's folder.

        Raises:
            DataError: metrics.json is missing or damaged, or the render of a test view is missing.
        """
        path = folder / "metrics.json"
        content = metrics.read(path, _TRAIN_AGAIN)
        parts = {"test": content.test, "train": content.train}
        try:
            baseline = cls(
                folder=folder,
                means={name: part.mean["ours"].numbers for name, part in parts.items() if part.mean},
                views={view: row["ours"].numbers for view, row in content.test.views.items()},
                seconds=content.seconds,
            )
        except KeyError as error:
            raise DataError(path, str(error), "is missing", _TRAIN_AGAIN) from error
        for render in map(baseline.render_of, baseline.views):
            if not render.is_file():
                raise DataError(render, "file", "is not there", _TRAIN_AGAIN)
        return baseline

    def render_of(self, view: str) -> Path:
        """The file of its render of a test view."""
        return self.folder / "renders" / f"{file_stem(view)}.png"

    def to_json(self) -> dict[str, Any]:
        """Its entry in metrics.json of the run."""
        means = {part: asdict(mean) for part, mean in self.means.items()}
        return {"folder": self.folder.name, "seconds": self.seconds, **means}
