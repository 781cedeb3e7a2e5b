"""The subcommands of `clear-strategies`: `clear-strategies NAME …`, or `python -m clear_strategies.run NAME …`.

A command is a module of this folder with `main(arguments)`, imported only when it is called. It returns when it is done and
raises a `ClearError` for what the user can solve. `clear_strategies.run` calls it, and turns errors into exit codes.
Anything else on the command line is Hydra's.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Final, NamedTuple


class Command(NamedTuple):
    """A row of the table.

    Args:
        usage: the arguments behind its name.
        summary: what it does, in one line.
    """

    usage: str
    summary: str


COMMANDS: Final = {
    "train": Command("PHOTOS [setting=value …]", "from a folder of photos, or a capture, to a splat and pictures"),
    "render": Command("RUN", "pictures and videos of a saved run or a PLY file, along any camera path"),
    "export": Command("RUN --to FORMAT", "a saved run as a file for viewers: ply, splat, spz, sog, or a page (html)"),
    "view": Command("RUN", "an interactive viewer in the browser of a saved run or a PLY file"),
    "doctor": Command("", "what this machine has, what works, and what is missing"),
}


def named(arguments: Sequence[str]) -> Callable[[], None] | None:
    """The call of the command that these arguments of the program name; None where they are Hydra's."""
    name = arguments[0] if arguments else ""
    if name == "help":
        return _help
    if name not in COMMANDS:
        return None
    return lambda: import_module(f"{__name__}.{name}").main(list(arguments[1:]))


def _help() -> None:
    rows = [(f"clear-strategies {name} {row.usage}".rstrip(), row.summary) for name, row in COMMANDS.items()]
    rows.append(("clear-strategies [setting=value …]", "a run of the whole configuration; --help lists its groups"))
    width = max(len(left) for left, _ in rows)
    sys.stdout.writelines(f"{left:<{width}}  {right}\n" for left, right in rows)
