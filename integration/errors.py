"""The error that every host adapter raises."""

from __future__ import annotations

from clear_strategies.errors import ClearError


class HostError(ClearError, RuntimeError):
    """The host does something that is not supported. The message says what, and what to change in the host."""
