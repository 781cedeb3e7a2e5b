"""`python -m clear_strategies`: which doors there are."""

from __future__ import annotations

import sys
from typing import Final

DOORS: Final = {
    "clear_strategies.run": "train: python -m clear_strategies.run +strategy=clear (also: clear-strategies +strategy=clear)",
    "clear_strategies.run help": "the subcommands: python -m clear_strategies.run train PHOTOS, …",
    "clear_strategies.report": "compare runs: python -m clear_strategies.report FOLDER [FOLDER ...]",
    "clear_strategies.bench": "measure run time against error: python -m clear_strategies.bench --help",
}

if __name__ == "__main__":
    sys.stdout.writelines(f"{module:<24} {what}\n" for module, what in DOORS.items())
