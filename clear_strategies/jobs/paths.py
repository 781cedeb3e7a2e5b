"""Whether the folders and files that a configuration names are there, before a job reads data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from clear_strategies.errors import DataError
from clear_strategies.files import expanded


def require_paths(setting: Callable[[str], Any]) -> None:
    """Raise a DataError if a folder or file of the scene or of its SR images is not there.

    It names the first folder of a path that is not there, which is the same for all scenes of a wrong data.root.

    Args:
        setting: the value of a dotted key; None where the configuration has no such key.
    """
    given = {"data.cloud.path": setting("data.cloud.init") == "ply", "prior.path": setting("data.save_lr") is None}
    for key in ("data.root", "data.path", *(name for name, is_read in given.items() if is_read)):
        if path := setting(key):
            whole = Path(expanded(str(path)))
            if gone := [part for part in (*reversed(whole.parents), whole) if not part.exists()]:
                raise DataError(gone[0], key, "is not there", "correct the path")
