"""The plan that a run prints before it trains, and its progress bar."""

from __future__ import annotations

import io
import logging
import math
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import torch

from clear_strategies.data.scene import Scene
from clear_strategies.merging.conductor import Conductor
from clear_strategies.schedules import milestones
from clear_strategies.training.loop import Progress
from clear_strategies.training.state import TrainState

_log = logging.getLogger(__name__)

# The facts on the console; the others are for `-v` and run.log.
_SHORT: Final[Sequence[str]] = (
    "scene", "poses", "HR side", "train views", "test views", "masks", "LR", "HR", "the SR images add",
    "initial points", "rasterizer", "memory", "time", "skipped",
)  # fmt: skip
_LINES: Final = 20  # lines of progress if stderr is no terminal
_READ_EVERY: Final = 0.25  # seconds; reading the history's numbers waits for the device


OF_STRATEGY: Final = re.compile(r"strategies\.(\w+)(?:\._target_)?")
"""The key of an override that adds or removes a strategy."""


@dataclass(frozen=True, slots=True)
class Chosen:
    """The choices of the command line.

    Args:
        method: a published baseline (`+method=`).
        strategies: their names.
        overrides: all of them, as written; None: unknown.
    """

    method: str | None
    strategies: Sequence[str]
    overrides: Sequence[str] | None = None

    @property
    def title(self) -> str:
        """The names on the command line, as "best" or "best - p2g"; if there are none, those of the strategies."""
        given, left_out = [self.method] if self.method else [], list[str]()
        for override in self.overrides or ():
            key, _, value = override.lstrip("+~").partition("=")
            if key == "method" and value != "[]":  # replaces the strategies before it
                given = [value]
            elif key == "strategy" and value == "baseline" and given:  # no strategy, beside a method
                continue
            elif key == "strategy":  # without a plus, it replaces the choice before it
                given = [*(given if override.startswith("+") else []), value.strip("[]").replace(",", " + ")]
            elif (name := OF_STRATEGY.fullmatch(key)) is not None:
                (left_out if override.startswith("~") else given).append(name[1])
        if not given:
            return " + ".join(self.strategies) or "baseline"
        return " - ".join([" + ".join(given), *left_out])


def describe_choices(chosen: Chosen, conductor: Conductor, data: str, iterations: int, seed: int) -> str:
    """The part of the plan that needs no photo, so that the console shows it at once."""
    named = zip(chosen.strategies, conductor.strategies, strict=True)
    none = "none (the paper's baseline)" if chosen.method is None else "none"
    return _table({
        "data": data,
        **({} if chosen.method is None else {"method": f"{chosen.method}; strategies named before it take no part"}),
        "strategies": ", ".join(f"{name} ({type(s).__name__})" for name, s in named) or none,
        "iterations": f"{iterations}, seed {seed}",
    })  # fmt: skip


def describe(scene: Scene, state: TrainState, chosen: Chosen, machine: Mapping[str, str]) -> tuple[str, str]:
    """The rest of the plan, a line for each fact: (the lines for the console, the details for `-v` and run.log). Warns of
    strategies without effect.

    Args:
        machine: label -> fact: the rasterizer, the threads, the memory.
    """
    settings, conductor = state.settings, state.conductor
    named = list(zip(chosen.strategies, conductor.strategies, strict=True))
    on_cuda = state.device.type == "cuda"
    lines = {
        **scene.notes,
        "device": f"cuda, {torch.cuda.get_device_name(state.device)}" if on_cuda else state.device.type,
        **machine,
        "per-Gaussian pass": "readable" if state.compiled_step is None else "compiled",
        "milestones": _listed(_marks(state)) or "none",
    }
    if iterations := milestones(state.density.settings):
        lines[f"milestones of {state.density.name}"] = _listed(iterations)
    for name, s in named:
        if (summary := s.summary()) is not None:
            lines[name.replace("_", " ")] = summary
    lines["skipped"] = "; ".join(_skipped(state)) or "nothing"
    conductor.warn_without_effect(max(map(conductor.objective.lambda_hr, range(1, settings.iterations + 1))))
    short = {label: lines[label] for label in _SHORT if label in lines}
    details = {label: text for label, text in lines.items() if label not in short}
    short["more"] = f"{len(details)} lines in run.log, or here with -v"
    return _table(short), _table(details)


def _table(lines: Mapping[str, str]) -> str:
    width = max(map(len, lines))
    return "\n".join(f"  {label:<{width}}  {text}" for label, text in lines.items())


def _skipped(state: TrainState) -> Iterator[str]:
    """Phrases for the work that this configuration never does."""
    conductor, objective, collecting = state.conductor, state.conductor.objective, state.conductor.statistics_from
    hr_from = conductor.hr_from(scored=collecting is not None and state.density.collects(collecting + 1))
    if not conductor.wants_lr:
        used = "is the area mean of the HR render" if objective.lambda_lr > 0 else "plays no part"
        yield f"LR render (LR {used})"
    if objective.lambda_hf == 0:
        yield "high-frequency loss (lambda_hf = 0)"
    if hr_from is None:
        yield "HR scale throughout (lambda_HR = 0)"
    elif hr_from > 0:
        yield f"HR scale until iteration {hr_from} (lambda_HR = 0)"
    if state.mip.variance == 0:
        yield "3D filter (variance 0)"
    yield from conductor.skips.descriptions(state.views, hr_from=hr_from)


def _marks(state: TrainState) -> dict[str, int]:
    """The milestones of λ_HR and of the strategies, iterations by name."""
    hr = state.conductor.objective.lambda_hr
    at = {"HR from": hr.start, "HR full": hr.full} if hr.peak else {}
    at |= {"HR decays": hr.decay_from} if hr.final != hr.peak else {}
    for s in state.conductor.strategies:
        at |= {f"{type(s).__name__} {name}": t for name, t in milestones(s).items()}
    return at


def _listed(iterations: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {t}" for name, t in iterations.items())


@contextmanager
def progress_bar(
    state: TrainState, after_step: Callable[[int], None] | None = None, name: str | None = None, *, shown: bool = True
) -> Iterator[Progress]:
    """Show a bar with loss, PSNR, number of Gaussians, conflict ratio and remaining time, or 20 lines of it if stderr is no
    terminal. Yields the function that advances it.

    Args:
        after_step: called after each iteration, with its number.
        name: of the training, in front of the bar.
        shown: False if several jobs share the terminal.
    """
    from tqdm import tqdm

    total, in_lines = state.settings.iterations, shown and not sys.stderr.isatty()
    between, last_read = max(1, total // _LINES), -math.inf
    numbers: dict[str, str] = {}
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
                after_step(state.t - 1)

        yield update


def _numbers(row: Mapping[str, float], lambda_lr: float) -> dict[str, str]:
    """Format a row of the history for the progress bar."""
    loss, numbers = lambda_lr * row["loss_lr"], {"N": f"{int(row['n_gaussians']):,}"}
    if row["lambda_hr"] == 0 or "loss_base" in row:  # else HR was skipped in this iteration, and the loss would jump
        numbers["loss"] = f"{loss + row['lambda_hr'] * row.get('loss_base', 0.0):.4f}"
    if not math.isnan(row.get("conflict", math.nan)):
        numbers["conflict"] = f"{row['conflict']:.2f}"
    return numbers | ({"psnr": f"{row['psnr_test']:.2f} dB"} if "psnr_test" in row else {})
