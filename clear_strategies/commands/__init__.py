"""The subcommands of `clear-strategies`: `clear-strategies NAME …`, or `python -m clear_strategies.run NAME …`.

A command is a module of this folder with `main(arguments)`. `clear_strategies.run` imports and calls it, and turns errors into
exit codes. It raises a `ClearError` for errors that the user can solve: a run or an argument that cannot be used, a library that
is not installed. It imports torch, Hydra and modules that need them in the functions that use them, so that `--help` and the
message for a wrong argument appear at once.

Arguments that begin with an override or a flag are passed to Hydra: `+strategy=clear`, `fit.iterations=300`, `-m`, `--cfg job`.
"""

from __future__ import annotations

import argparse
import difflib
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Final, NoReturn

from clear_strategies.errors import SettingError
from clear_strategies.files import expanded

# Descriptions of the commands, by their name and arguments.
COMMANDS: Final = {
    "train PHOTOS [setting=value …]": "from photos or a capture to a splat and pictures",
    "render RUN": "a video of a saved run or a PLY file, or pictures from given cameras",
    "export RUN": "a saved run as a PLY file for viewers",
    "view RUN": "an interactive viewer in the browser of a saved run or a PLY file",
    "doctor": "what this machine has, what works, and what is missing",
}
NAMES: Final = [usage.split()[0] for usage in COMMANDS]
_RESEARCH: Final = {
    "clear-strategies +strategy=clear data=llff data.path=FOLDER": "one run of the whole configuration",
    "clear-strategies -m +strategy=clear,gco fit.seed=0,1": "a sweep: a run for every combination",
    "clear-strategies +strategy=clear --cfg job": "prints a run's configuration; nothing runs",
    "python -m clear_strategies.report FOLDER": "a table of the runs in a folder, and report.html",
    "clear-strategies --hydra-help": "the flags of Hydra, which reads these lines",
}


def named(arguments: Sequence[str]) -> Callable[[], None] | None:
    """Return a function that runs the command that the program's arguments name; None if they are for Hydra."""
    name = arguments[0] if arguments else "help"
    if name in ("help", "--help", "-h"):
        return _help
    if "--version" in arguments:
        return _version
    if name in NAMES:
        return lambda: import_module(f"{__name__}.{name}").main(list(arguments[1:]))
    if is_of_hydra(name) or "=" in name:
        return None
    remedy = "clear-strategies --help lists all; a setting is written name=value."
    if similar := _similar_command(name):
        remedy = f"Did you mean {similar}?"
    raise SettingError(f"{name}: there is no such command. {remedy}")


def is_of_hydra(word: str) -> bool:
    """Return True if a word begins as flags and overrides do; `~/photos` is a path."""
    return word.startswith(("-", "+", "~")) and expanded(word) == word


def _similar_command(word: str) -> str | None:
    """The command that is most similar to a wrong one, or the one for the file or folder that it names; else None."""
    quoted = shlex.quote(word)
    if word.endswith(".ply"):
        return f"clear-strategies view {quoted}"
    if "/" in word or Path(word).exists():
        return f"clear-strategies train {quoted}"
    if word in ("report", "bench"):
        return f"python -m clear_strategies.{word}"
    return next(iter(difflib.get_close_matches(word.lower(), NAMES, 1)), None)


def _version() -> None:
    sys.stdout.write(f"clear-strategies {import_module('clear_strategies').__version__}\n")


def _help() -> None:
    sys.stdout.write(
        "clear-strategies COMMAND …; --help behind a command tells more.\n\n"
        f"{_rows(COMMANDS)}\n"
        "clear-strategies setting=value …, for research: any strategies, data and settings, and sweeps.\n\n"
        f"{_rows(_RESEARCH)}"
    )


def _rows(table: Mapping[str, str]) -> str:
    width = max(map(len, table))
    return "".join(f"  {left:<{width}}  {right}\n" for left, right in table.items())


class _Parser(argparse.ArgumentParser):
    """Raises a SettingError for wrong arguments; argparse would print the usage and exit."""

    def error(self, message: str) -> NoReturn:
        raise SettingError(f"{message}. {self.prog} --help lists the arguments.")


def parser_of(command: str, description: str, *, run: bool = True) -> argparse.ArgumentParser:
    """Make a parser with `--verbose`, and with RUN and `--rasterizer` for commands that open a run."""
    parser = _Parser(prog=f"clear-strategies {command}", description=description)
    if run:
        parser.add_argument(
            "run", type=path_of, metavar="RUN", help="a run's folder, one of its checkpoints, or a PLY file"
        )
        which = "cpp, torch, warp, gsplat, or another package's class by its dotted name (default: the run's own)"
        parser.add_argument("--rasterizer", metavar="NAME", help=which)
    parser.add_argument("-v", "--verbose", action="store_true", help="say more")
    return parser


def path_of(text: str) -> Path:
    """The argparse type of a path."""
    return Path(expanded(text))


def positive(text: str) -> int:
    """The argparse type of a whole number above 0."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, got {text}")
    return int(text)
