"""Resuming a run that was stopped, and recognizing one that is finished."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from clear_strategies.compose import flat
from clear_strategies.errors import DataError
from clear_strategies.outputs import metrics
from clear_strategies.outputs.metrics import Metrics
from clear_strategies.settings import CHANGES_NO_RESULT
from clear_strategies.training import checkpoint
from clear_strategies.training.checkpoint import CHECKPOINTS, Checkpoint
from clear_strategies.training.state import TrainState

_log = logging.getLogger(__name__)

_TRAIN_AGAIN: Final = "remove the file: the run is then trained again"
AUTO: Final = "auto"  # the value of fit.resume that is not a path

# What may differ between a run and the one that it resumes. Another device changes bits, which is logged.
_NOT_COMPARED: Final = CHANGES_NO_RESULT | {"fit.device"}


def comparable(values: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration, flat and JSON-ready, without what a resumed run may change."""
    compared = {key: value for key, value in flat(values).items() if key not in _NOT_COMPARED}
    return dict(msgspec.json.decode(msgspec.json.encode(compared)))  # as it comes back from a file


def finished(folder: Path, config: Mapping[str, Any]) -> Metrics | None:
    """The results of the finished run in this folder; None where there is none.

    Raises:
        DataError: it was another configuration's, or its metrics.json is damaged.
    """
    path = folder / "metrics.json"
    if not path.exists():
        return None
    content = metrics.read(path, _TRAIN_AGAIN)
    _require_same(path, content.config, config)
    mean = content.shown.mean.get("ours")
    score = "no PSNR" if mean is None or mean.psnr is None else f"PSNR {mean.psnr:.2f} dB"
    _log.info("%s: this run finished on %s (%s); nothing is trained.", folder, content.provenance.date, score)
    return content


def resume(state: TrainState, source: str | None, folder: Path, config: Mapping[str, Any]) -> None:
    """Restore what `fit.resume` names.

    Args:
        source: a run's folder or one of its checkpoints; "auto": the newest checkpoint in `folder` that is whole, or none.

    Raises:
        DataError: the checkpoint is damaged, or another configuration's.
    """
    if source is None:
        return
    if source != AUTO:
        restore(state, checkpoint.load(Path(source)), Path(source), config)
        return
    checkpoints = checkpoint.saved(folder / CHECKPOINTS)
    for path in reversed(checkpoints):
        try:
            saved = checkpoint.load(path)
        except DataError as error:
            _log.warning("%s; trying an earlier one.", error)
            continue
        restore(state, saved, path, config)
        return
    if checkpoints:
        _log.warning("%s: no checkpoint is whole; the run starts from the beginning.", folder / CHECKPOINTS)


def folder_of(source: Path) -> Path:
    """The run's folder, of itself, its folder of checkpoints, or one of these."""
    return next((path.parent for path in (source, source.parent) if path.name == CHECKPOINTS), source)


def newest(folder: Path) -> Path | None:
    """The newest checkpoint of the run in this folder."""
    return next(reversed(checkpoint.saved(folder / CHECKPOINTS)), None)


def restore(state: TrainState, saved: Checkpoint, source: Path, config: Mapping[str, Any]) -> None:
    """Continue from a checkpoint of the same configuration."""
    _require_same(source, saved.config, config)
    state.restore(saved, source)
    _log.info("resumed from %s: %d iterations are done.", source, saved.t - 1)
    if saved.device != state.device.type:
        _log.warning(
            "this run trained on %s until now and continues on %s: its bits differ from those of an uninterrupted run.",
            saved.device, state.device.type,
        )  # fmt: skip


def _require_same(source: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    differences = [
        f"{key}: {then.get(key)!r} then, {now.get(key)!r} now"
        for key in sorted({*then, *now})
        if then.get(key) != now.get(key)
    ]
    if differences:
        raise DataError(
            source, "config", "this is not the configuration that wrote it: " + "; ".join(differences[:5]),
            "resume with the same overrides, or start a new run",
        )  # fmt: skip
