"""Showing a field: its rendering, the cameras of a run and a path through them, a video and a viewer."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Final

from clear_strategies.errors import SettingError

FPS: Final = 24.0  # of a video along a path


def require_viewer() -> None:
    """Raise a SettingError where one of the viewer's libraries is not installed."""
    if lacks := [name for name in ("viser", "nerfview", "splines") if find_spec(name) is None]:
        raise SettingError(f"the viewer needs {' and '.join(lacks)}: pip install 'clear-strategies[view]'.")
