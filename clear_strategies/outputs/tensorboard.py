"""`fit.log=tensorboard`: the numbers of history.csv and a few pictures, while a run trains."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

from clear_strategies.data.scene import Scene
from clear_strategies.errors import SettingError
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import cameras
from clear_strategies.viewing.look import Painter

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

FOLDER: Final = "tensorboard"
_EVERY: Final = 50  # iterations between two reads of the history, which wait for the device
_LONGEST: Final = 960  # px, of a picture

# Prefix of a column of the history -> group of charts. Other columns are numbers of a strategy.
_GROUPS: Final = {
    "loss_": "loss/", "psnr_": "psnr/", "conflict": "conflict/", "corrected": "corrected/", "n_gaussians": "field/",
    "detail_abs": "field/", "lambda_hr": "schedule/", "seconds": "schedule/", "processor_seconds": "schedule/",
    "probe_": "schedule/",
}  # fmt: skip


def require_tensorboard() -> None:
    """Raise a SettingError where TensorBoard is not installed."""
    if find_spec("tensorboard") is None:
        raise SettingError("fit.log: tensorboard is not installed: pip install 'clear-strategies[log]'.")


@contextmanager
def logged(folder: Path, state: TrainState, scene: Scene, painter: Painter) -> Iterator[Callable[[], None]]:
    """A log in a run's folder. Yields a function to call after each iteration; the last numbers are written at the end.

    A resumed run continues the log; entries beyond its checkpoint are hidden.
    """
    from torch.utils.tensorboard import SummaryWriter

    with SummaryWriter(str(folder / FOLDER), purge_step=state.t) as writer:
        log = _Log(writer, state, scene, painter)
        try:
            yield log
        finally:
            log.write_numbers()


class _Log:
    """Writes the rows of the history as they come, and a picture now and then."""

    def __init__(self, writer: SummaryWriter, state: TrainState, scene: Scene, painter: Painter) -> None:
        self._writer, self._state, self._painter = writer, state, painter
        self._written = len(state.history)
        self._view = (scene.test or scene.train)[0]
        for name, image in {
            "LR photo": self._view.lr.image,
            "SR image": self._view.hr.image,
            "HR photo": self._view.truth,
        }.items():
            if image is not None:
                writer.add_image(f"{self._view.name}/{name}", image.cpu().numpy(), state.t - 1, dataformats="HWC")

    def __call__(self) -> None:
        done = self._state.t - 1
        if done % _EVERY == 0 or self._state.ended:
            self.write_numbers()
        every = self._state.settings.probe_every
        if self._state.ended or (every and done % every == 0):
            self._write_picture(done)

    def write_numbers(self) -> None:
        rows = self._state.history_as_floats()
        for row in rows[self._written :]:
            self._write_row(int(row["t"]), row)
        self._written = len(rows)

    def _write_row(self, t: int, row: Mapping[str, float]) -> None:
        for column, value in row.items():
            if column != "t" and math.isfinite(value):
                self._writer.add_scalar(_tag(column), value, t)
        optimizer = self._state.optimizer
        for name, rate in optimizer.rates.at(t, optimizer.extent).items():
            self._writer.add_scalar(f"learning rate/{name}", rate, t)

    def _write_picture(self, t: int) -> None:
        image = self._painter.color(cameras.at_most(self._view.hr.camera, _LONGEST))
        self._writer.add_image(f"{self._view.name}/render", image.numpy(), t, dataformats="HWC")


def _tag(column: str) -> str:
    """The name of a column in TensorBoard, which groups charts by the part before the slash."""
    for prefix, group in _GROUPS.items():
        if column.startswith(prefix):
            return group + (column.removeprefix(prefix).strip("_") or prefix)
    return f"strategies/{column}"
