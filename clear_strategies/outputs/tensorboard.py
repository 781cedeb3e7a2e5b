"""`fit.log=tensorboard`: the numbers of history.csv and a render of a view, while a run trains."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from clear_strategies.data.scene import Scene
from clear_strategies.errors import SettingError
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import cameras
from clear_strategies.viewing.look import Painter

FOLDER: Final = "tensorboard"
_EVERY: Final = 50  # iterations between two reads of the history, which wait for the device
_LONGEST: Final = 960  # px, of a picture


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

    written, view = len(state.history), (scene.test or scene.train)[0]

    def write_numbers() -> None:
        nonlocal written
        rows = state.history_as_floats()
        for row in rows[written:]:
            for column, value in row.items():
                if column != "t" and math.isfinite(value):
                    writer.add_scalar(
                        column.replace("_", "/", 1), value, int(row["t"])
                    )  # charts are grouped by loss/, psnr/
        written = len(rows)

    def after_step() -> None:
        done, every = state.t - 1, state.settings.probe_every
        if done % _EVERY == 0 or state.ended:
            write_numbers()
        if state.ended or (every and done % every == 0):
            image = painter.color(cameras.at_most(view.hr.camera, _LONGEST))
            writer.add_image(view.name, image.numpy(), done, dataformats="HWC")

    with SummaryWriter(str(folder / FOLDER), purge_step=state.t) as writer:
        try:
            yield after_step
        finally:
            write_numbers()
