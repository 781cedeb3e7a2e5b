"""The libraries of the extra [train] that the geometry uses if they are installed."""

from __future__ import annotations

import importlib
from typing import Final

_PACKAGES: Final = {"cv2": "opencv-contrib-python-headless", "kornia": "kornia", "scipy": "scipy"}
REMEDY: Final = "pip install 'clear-strategies[train]'"


def missing(*modules: str) -> str:
    """The packages of those modules that cannot be imported, joined by commas; empty if all can."""
    packages = []
    for module in modules:
        try:
            importlib.import_module(module)
        except (ImportError, OSError):  # not installed, or its system libraries are missing
            packages.append(_PACKAGES[module])
    return ", ".join(packages)
