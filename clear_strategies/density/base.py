"""The error that both densifiers raise."""

from __future__ import annotations

from clear_strategies.errors import ClearError


class DensityError(ClearError, RuntimeError):
    """Pruning would leave too few Gaussians to go on."""
