"""What the adapters say, for hosts that have not configured Python's logging."""

from __future__ import annotations

import logging
from typing import Final

_OURS: Final = ("integration", "clear_strategies", "rasterizers")


def show_log() -> None:
    """Print our messages as "[clear] …" to stderr, unless the host handles logging itself."""
    if logging.getLogger().handlers:
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("[clear] %(message)s"))
    for name in _OURS:
        logger = logging.getLogger(name)
        if not logger.handlers:
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)
