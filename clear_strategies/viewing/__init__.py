"""Looking at a field: how it is drawn, from where, and what it is drawn into: pictures, videos, a page, a viewer."""

from __future__ import annotations

from typing import Final

FPS: Final = 24.0  # of a video along a path
