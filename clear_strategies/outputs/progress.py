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

    total, in_lines = state.settings.iterations, shown and not sys.stderr.isatty()
    between, last_read, numbers = max(1, total // _LINES), -math.inf, dict[str, str]()
    with tqdm(
        desc=name, total=total, initial=state.t - 1, unit="it", dynamic_ncols=True, mininterval=0.5, disable=not shown,
        file=io.StringIO() if in_lines else sys.stderr,
    ) as bar:  # fmt: skip

        def update(state: TrainState) -> None:
            nonlocal last_read
            ran = state.t - 1 - bar.n  # more than one where a plateau was skipped
            line = in_lines and (state.ended or (bar.n + ran) // between > bar.n // between)
            at_once = line or state.ended or "psnr_test" in state.history[-1]
            if at_once or time.monotonic() - last_read >= _READ_EVERY:
                numbers.update(_numbers(state.history_as_floats()[-1], state.conductor.objective.lambda_lr))
                bar.set_postfix(numbers, refresh=False)
                last_read = time.monotonic()
            bar.update(ran)
            if line:
                sys.stderr.write(f"{bar}\n")
            if after_step is not None:
                after_step()

        yield update


def _numbers(row: Mapping[str, float], lambda_lr: float) -> dict[str, str]:
    """What the bar shows of a row of the history."""
    loss = lambda_lr * row["loss_lr"] + row["lambda_hr"] * row.get("loss_base", 0.0)
    numbers = {"loss": f"{loss:.4f}", "N": f"{int(row['n_gaussians']):,}"}
    if not math.isnan(row.get("conflict", math.nan)):
        numbers["conflict"] = f"{row['conflict']:.2f}"
    return numbers | ({"psnr": f"{row['psnr_test']:.2f} dB"} if "psnr_test" in row else {})
