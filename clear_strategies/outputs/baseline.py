"""The baseline that trained beside a run (`fit.baseline`), as its folder shows it."""

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
"""Its name, in the folder of the run that it trained beside."""
_STRATEGIES: Final = ("strategy=", "strategies.")  # how the overrides begin that a baseline does not have
_TRAIN_AGAIN: Final = "remove this baseline's metrics.json: it is then trained again"


def overrides_of(run: Iterable[str]) -> list[str]:
    """The overrides of the baseline beside a run with these: all but those of its strategies."""
    return [override for override in run if not override.lstrip("+~").startswith(_STRATEGIES)]


@dataclass(frozen=True, slots=True)
class Baseline:
    """A finished baseline.

    Args:
        means: part ("test", "train") -> mean scores of its renders; a part without views is not there.
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
            DataError: metrics.json is not there or damaged, or a render of a test view is not there.
        """
        path = folder / "metrics.json"
        content = metrics.read(path, _TRAIN_AGAIN)
        parts = {"test": content.test, "train": content.train}
        try:
            found = cls(
                folder=folder,
                means={name: part.mean["ours"].numbers for name, part in parts.items() if part.mean},
                views={view: row["ours"].numbers for view, row in content.test.views.items()},
                seconds=content.seconds,
            )
        except KeyError as error:
            raise DataError(path, str(error), "is missing", _TRAIN_AGAIN) from error
        for view in found.views:
            if not found.render_of(view).is_file():
                raise DataError(found.render_of(view), "file", "is not there", _TRAIN_AGAIN)
        return found

    def render_of(self, view: str) -> Path:
        """The file of its render of a test view."""
        return self.folder / "renders" / f"{file_stem(view)}.png"

    def to_json(self) -> dict[str, Any]:
        """What metrics.json of the run holds of it."""
        means = {part: asdict(mean) for part, mean in self.means.items()}
        return {"folder": self.folder.name, "seconds": self.seconds, **means}
