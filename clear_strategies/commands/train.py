"""`clear-strategies train PHOTOS`: a run on a folder of photos or a capture, by the same configuration as every other run.

The reader is the one of what lies in the folder. Everything behind the folder goes to Hydra unchanged.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from clear_strategies import run
from clear_strategies.errors import SettingError

_USAGE: Final = """clear-strategies train PHOTOS [setting=value …]

PHOTOS is a folder of photos, or a capture: COLMAP's sparse/, a transforms.json, a poses_bounds.npy or a Blender scene in it.
It trains the whole method (+strategy=clear) on all photos; settings change that, e.g.

  clear-strategies train photos/ fit.iterations=3000
  clear-strategies train photos/ data.views.test_every=8

`clear-strategies --cfg job data=photos` lists all settings.
"""
# What decides which strategies train, so that the default must not.
_CHOOSE_STRATEGIES: Final = ("+strategy=", "+method=", "experiment=", "+experiment=")


def main(arguments: list[str]) -> None:
    """Train on what the first argument names.

    Raises:
        SettingError: there is no first argument, or it is no folder.
    """
    if "--help" in arguments or "-h" in arguments:
        sys.stdout.write(_USAGE)
        return
    run.hydra_main(overrides(arguments))


def overrides(arguments: Sequence[str]) -> list[str]:
    """The arguments of the command as Hydra's.

    Raises:
        SettingError: as `main`.
    """
    if not arguments or arguments[0].startswith(("-", "+", "~")):
        raise SettingError("train needs a folder of photos first: clear-strategies train PHOTOS [setting=value …].")
    path, rest = Path(arguments[0]), list(arguments[1:])
    if not path.is_dir():
        raise SettingError(f"train: {path} is no folder. Name the folder of the photos, or of the capture.")
    chosen = [] if any(override.startswith(_CHOOSE_STRATEGIES) for override in rest) else ["+strategy=clear"]
    return [*chosen, f"data={kind(path)}", f"data.path={_quoted(str(path))}", *rest]


def kind(folder: Path) -> str:
    """The choice of conf/data for what lies in the folder."""
    if (folder / "transforms_train.json").is_file():
        return "blender"
    if (folder / "transforms.json").is_file():
        return "nerfstudio"
    if (folder / "poses_bounds.npy").is_file():
        return "llff"
    for candidate in ("sparse/0", "sparse", "colmap/sparse/0", "."):
        if any((folder / candidate / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            return "colmap"
    return "photos"


def _quoted(value: str) -> str:
    """A string of Hydra's grammar: paths may contain spaces, commas, brackets and equals signs."""
    escaped = value.replace("\\", "\\\\").replace("'", "\\'") if "'" in value else value
    return f"'{escaped}'"
