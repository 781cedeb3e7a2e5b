"""`python -m clear_strategies`: which doors there are."""

from __future__ import annotations

DOORS = {
    "clear_strategies.run": "train: python -m clear_strategies.run +strategy=clear (also: clear-strategies +strategy=clear)",
    "clear_strategies.report": "compare runs: python -m clear_strategies.report FOLDER [FOLDER ...]",
    "clear_strategies.bench": "measure run time against error: python -m clear_strategies.bench --help",
}

if __name__ == "__main__":
    for module, what in DOORS.items():
        print(f"{module:<24} {what}")  # noqa: T201
