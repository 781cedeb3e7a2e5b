"""The log of the adapters in hosts that have not configured Python's logging."""

from __future__ import annotations

import logging
from typing import Final

_PACKAGES: Final = ("integration", "clear_strategies", "rasterizers")


def show_log() -> None:
    """Print our messages as "[clear] …" to stderr, unless the host handles logging itself."""
    if logging.getLogger().handlers:
        return
    handler = logging.StreamHandler()
    handler.setFormatter(logging.Formatter("[clear] %(message)s"))
    for name in _PACKAGES:
        logger = logging.getLogger(name)
        if not logger.handlers:
            logger.addHandler(handler)
            logger.setLevel(logging.INFO)
