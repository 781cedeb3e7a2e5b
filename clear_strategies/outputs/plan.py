"""Floor 5: what a run says before and while it trains."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import torch

from clear_strategies.data.scene import Scene
from clear_strategies.schedules import milestones
from clear_strategies.strategies.svs import SVS
from clear_strategies.training.loop import Progress
from clear_strategies.training.state import TrainState

_log = logging.getLogger(__name__)

_LOOK_EVERY: Final = 0.25  # seconds between two looks at the numbers for the bar: on a device each look waits


@dataclass(frozen=True, slots=True)
class Chosen:
    """What was asked for, by name: a baseline of the papers' tables, or strategies, in the order of the configuration."""

    method: str | None
    strategies: Sequence[str]

    @property
    def title(self) -> str:
        return self.method or " + ".join(self.strategies) or "baseline"


def describe(scene: Scene, state: TrainState, chosen: Chosen, *, rasterizer: str, threads: str) -> str:
    """The plan: what trains on what, when, and what is left out. Settings that have no effect are warned of."""
    settings, conductor = state.settings, state.conductor
    strategies = ", ".join(
        f"{name} ({type(s).__name__})" for name, s in zip(chosen.strategies, conductor.strategies, strict=True)
    )
    lines = {
        **scene.notes,
        **({} if chosen.method is None else {"method": f"{chosen.method}; strategies named before it take no part"}),
        "strategies": strategies or ("none (the paper's baseline)" if chosen.method is None else "none"),
        "device": _named(state.device),
        "rasterizer": rasterizer,
        "threads": threads,
        "per-Gaussian pass": "readable" if state.compiled_step is None else "compiled",
        "iterations": f"{settings.iterations}, seed {settings.seed}",
        "milestones": ", ".join(f"{name} {t}" for name, t in marks(state).items()),
    }
    for s in conductor.strategies:
        if found := milestones(s):
            lines[f"milestones of {type(s).__name__}"] = ", ".join(f"{name} {t}" for name, t in found.items())
    if found := milestones(state.density.settings):
        lines[f"milestones of {state.density.name}"] = ", ".join(f"{name} {t}" for name, t in found.items())
    skipped = []
    if not conductor.wants_lr:
        used = "is the area mean of the HR render" if conductor.objective.lambda_lr > 0 else "plays no part"
        skipped.append(f"LR render (LR {used})")
    if conductor.objective.lambda_lr == 0 and (idle := [name for name in chosen.strategies if name == "gco"]):
        _log.warning("lambda_LR is 0: nothing can conflict, %s has no effect.", idle[0])
    if conductor.objective.lambda_hf == 0:
        skipped.append("high-frequency loss (lambda_hf = 0)")
    hr = conductor.objective.lambda_hr
    if hr.peak == hr.final == 0:
        skipped.append("HR scale throughout (lambda_HR = 0)")
        if idle := [name for name in chosen.strategies if name in ("gco", "p2g")]:
            _log.warning("lambda_HR is 0 throughout: %s has no effect.", " and ".join(idle))
    elif hr.start > 0:
        skipped.append(f"HR scale until iteration {hr.start} (lambda_HR = 0)")
    if state.mip.variance == 0:
        skipped.append("3D filter (variance 0)")
    if any(isinstance(s, SVS) and s.anchor_strength == 0 for s in conductor.strategies):
        skipped.append("anchor (anchor_strength = 0)")
    skipped += state.skip_policy.skips.says()
    lines["skipped"] = "; ".join(skipped) or "nothing"
    width = max(map(len, lines))
    return "\n".join(f"  {label:<{width}}  {text}" for label, text in lines.items())


def _named(device: torch.device) -> str:
    return f"{device.type}, {torch.cuda.get_device_name(device)}" if device.type == "cuda" else device.type


def marks(state: TrainState) -> dict[str, int]:
    """The milestones worth a mark on a curve."""
    hr = state.conductor.objective.lambda_hr
    at = {"HR from": hr.start, "HR full": hr.full, **state.density.marks}
    if hr.final != hr.peak:
        at["HR decays"] = hr.decay_from
    for s in state.conductor.strategies:
        if isinstance(s, SVS) and s.anchor_strength > 0:
            at["anchor"] = s.anchor_start
    return at


@contextmanager
def progress(state: TrainState, watch: Callable[[], None] | None = None) -> Iterator[Progress]:
    """A bar with loss, PSNR, Gaussians, conflict ratio and the time that is left; `watch` is called at each step."""
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    shown: dict[str, str] = {}
    every = 0.5 if sys.stderr.isatty() else 15  # seconds; a log file needs no animation
    total, done = state.settings.iterations, state.t - 1
    with (
        logging_redirect_tqdm(),
        tqdm(total=total, initial=done, unit="it", dynamic_ncols=True, mininterval=every) as bar,
    ):
        looked = -math.inf

        def look(row: Mapping[str, float]) -> None:
            λ_lr, λ_hr = state.conductor.objective.lambda_lr, row["lambda_hr"]
            shown["loss"] = f"{λ_lr * row['loss_lr'] + λ_hr * row.get('loss_base', 0.0):.4f}"
            shown["N"] = f"{int(row['n_gaussians']):,}"
            if not math.isnan(row.get("conflict", math.nan)):
                shown["conflict"] = f"{row['conflict']:.2f}"
            if "psnr_test" in row:
                shown["psnr"] = f"{row['psnr_test']:.2f} dB"
            bar.set_postfix(shown, refresh=False)

        def update(state: TrainState) -> None:
            nonlocal looked
            telling = state.ended or "psnr_test" in state.history[-1]
            if telling or time.monotonic() - looked >= _LOOK_EVERY:
                look(state.history_as_floats()[-1])
                looked = time.monotonic()
            bar.update(1)
            if watch is not None:
                watch()

        yield update
