"""What both densifiers share: the error, the marks, and the ranges of their settings."""

from __future__ import annotations

from typing import Any

from clear_strategies.errors import ClearError, SettingError


class DensityError(ClearError, RuntimeError):
    """Pruning would leave too few Gaussians to go on."""


def structure_marks(stop: int, reset_every: int) -> dict[str, int]:
    """The marks that both densifiers have: the end of densification, and the first opacity reset before it."""
    reset = {"opacity reset": reset_every} if 0 < reset_every < stop else {}
    return {"densify until": stop, **reset}


def require_in_range(settings: Any) -> None:
    """Check the settings that all densifiers share.

    Raises:
        SettingError: one is outside its range.
    """
    if settings.mode not in ("quantile", "fixed"):
        raise SettingError(f"mode must be quantile or fixed, got {settings.mode!r}.")
    if min(settings.every, settings.max_gaussians, settings.min_gaussians) < 1 or settings.reset_every < 0:
        raise SettingError("every, max_gaussians and min_gaussians must be at least 1, reset_every at least 0.")
