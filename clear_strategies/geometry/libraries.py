"""Libraries of the extra [train] that geometry uses where they are installed. The light core goes without them."""

from __future__ import annotations

import importlib
from typing import Final

_PACKAGES: Final = {"cv2": "opencv-contrib-python-headless", "kornia": "kornia", "scipy": "scipy"}

REMEDY: Final = "pip install 'clear-strategies[train]'"


def missing(*modules: str) -> str:
    """The packages of those modules that cannot be imported, joined by commas; empty where all can."""
    return ", ".join(_PACKAGES[module] for module in modules if not _importable(module))


def _importable(module: str) -> bool:
    try:
        importlib.import_module(module)
    except (ImportError, OSError):  # not installed, or its system libraries are missing
        return False
    return True
