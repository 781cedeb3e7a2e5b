"""The progress bar of a run."""

from __future__ import annotations

import io
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Final

from clear_strategies.training.loop import Progress
from clear_strategies.training.state import TrainState

_LINES: Final = 20  # in a file, which shows no bar
_READ_EVERY: Final = 0.25  # seconds; reading the history's numbers waits for the device


@contextmanager
def progress_bar(
    state: TrainState, after_step: Callable[[], None] | None = None, name: str | None = None, *, shown: bool = True
) -> Iterator[Progress]:
    """A bar with loss, PSNR, number of Gaussians, conflict ratio and remaining time; where stderr is no terminal, 20 lines of it.
    Yields the function that advances it.

    Args:
        after_step: called after each iteration.
        name: of the training, in front of the bar.
        shown: False where several jobs share the terminal.
    """
    from tqdm import tqdm

    numbers: dict[str, str] = {}
    total, done, in_lines = state.settings.iterations, state.t - 1, shown and not sys.stderr.isatty()
    between = max(1, total // _LINES)
    screen = io.StringIO() if in_lines else sys.stderr
    with tqdm(
        desc=name,
        total=total,
        initial=done,
        unit="it",
        dynamic_ncols=True,
        mininterval=0.5,
        disable=not shown,
        file=screen,
    ) as bar:
        last_read = -math.inf

        def show(row: Mapping[str, float]) -> None:
            λ_lr, λ_hr = state.conductor.objective.lambda_lr, row["lambda_hr"]
            numbers["loss"] = f"{λ_lr * row['loss_lr'] + λ_hr * row.get('loss_base', 0.0):.4f}"
            numbers["N"] = f"{int(row['n_gaussians']):,}"
            if not math.isnan(row.get("conflict", math.nan)):
                numbers["conflict"] = f"{row['conflict']:.2f}"
            if "psnr_test" in row:
                numbers["psnr"] = f"{row['psnr_test']:.2f} dB"
            bar.set_postfix(numbers, refresh=False)

        def update(state: TrainState) -> None:
            nonlocal last_read
            ran = state.t - 1 - bar.n  # more than one where a plateau was skipped
            line = in_lines and (state.ended or (bar.n + ran) // between > bar.n // between)
            at_once = line or state.ended or "psnr_test" in state.history[-1]
            if at_once or time.monotonic() - last_read >= _READ_EVERY:
                show(state.history_as_floats()[-1])
                last_read = time.monotonic()
            bar.update(ran)
            if line:
                sys.stderr.write(f"{bar}\n")
            if after_step is not None:
                after_step()

        yield update
