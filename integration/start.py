"""Checks and log messages when strategies are attached to a host."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import torch

from clear_strategies.core.view import View
from clear_strategies.errors import SettingError
from clear_strategies.merging.conductor import Conductor

_log = logging.getLogger(__name__)


def require_supported(conductor: Conductor, accumulation: int) -> None:
    """Raise a SettingError for what no host can do."""
    if accumulation < 1:
        raise SettingError(f"accumulation: must be at least 1 backward pass per step, got {accumulation}.")
    if not conductor.wants_lr:
        raise SettingError(
            "objective: a host renders LR itself, so lambda_lr must be > 0 and lr_from must be lr, got "
            f"lambda_lr={conductor.objective.lambda_lr}, lr_from={conductor.objective.lr_from!r}."
        )
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized() and (n := distributed.get_world_size()) > 1:
        raise SettingError(f"CLEAR trains in one process, got {n}. Start the training without torchrun, on one device.")


def announce(conductor: Conductor, views: Sequence[View], *, own_background: bool) -> None:
    """Log what each strategy will do, and which have no effect. After `on_fit_start`.

    Args:
        own_background: the host chooses its background by itself.
    """
    for s in conductor.strategies:
        if (prepared := s.summary()) is not None:
            _log.info("%s: %s.", type(s).__name__, prepared)
    if not conductor.decorated and any(view.factor > 1 for view in views):
        _log.warning(
            "%s has no effect: the views were made without it. Make them with sr=conductor.prior(sr).",
            ", ".join(getattr(getattr(d, "func", d), "__name__", str(d)) for d in conductor.decorators),
        )
    for hook, reason in {
        "densifier": "keeps its own density control",
        **({"background": "chooses its background itself"} if own_background else {}),
    }.items():
        if (owner := conductor.owner(hook)) is not None:
            _log.info("%s has no effect here: the host %s.", type(owner).__name__, reason)
    if not conductor.strategies:
        _log.info("no strategy is attached: both losses are summed, as in the paper's baseline.")
