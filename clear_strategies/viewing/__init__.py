"""Showing a field: its rendering, cameras and paths, and pictures, videos, pages and a viewer."""

from __future__ import annotations

from typing import Final

FPS: Final = 24.0  # of a video along a path
