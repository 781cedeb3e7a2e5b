"""`clear-strategies settings`: the choices and settings of a run, by Hydra's help."""

from __future__ import annotations

import sys
from typing import Final

_USAGE: Final = """clear-strategies settings [setting=value …]

It lists the groups of conf/ with their choices (group=choice), and every setting of a run with the value that it would have,
e.g.

  clear-strategies settings
  clear-strategies settings +strategy=clear data=llff     with these choices

`clear-strategies +strategy=clear --cfg job` prints the values alone, as YAML.
"""


def main(arguments: list[str]) -> None:
    """List them, with the arguments as Hydra's overrides."""
    if "--help" in arguments or "-h" in arguments:
        sys.stdout.write(_USAGE)
        return
    from clear_strategies import hydra_app

    hydra_app.main(["--help", *arguments])
