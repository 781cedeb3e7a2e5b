"""The subcommands of `clear-strategies`: `clear-strategies NAME …`, or `python -m clear_strategies.run NAME …`.

A command is a module of this folder with `main(arguments)`, imported only when it is called. It returns when it is done and
raises a `ClearError` for what the user can solve: a run or an argument that cannot be used, a library that is not installed.
`clear_strategies.run` calls it, and turns errors into exit codes.
A command imports torch, Hydra and what needs them in the functions that use them, so that its `--help`, and the message for a
wrong argument, come at once.

What begins with an override or a flag is Hydra's: `+strategy=clear`, `fit.iterations=300`, `-m`, `--cfg job`.
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

# Name and arguments, and what it does.
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
    """The call of the command that these arguments of the program name; None where they are Hydra's."""
    name = arguments[0] if arguments else "help"
    if name in ("help", "--help", "-h"):
        return _help
    if "--version" in arguments:
        return _version
    if name in NAMES:
        return lambda: import_module(f"{__name__}.{name}").main(list(arguments[1:]))
    if is_of_hydra(name) or "=" in name:
        return None
    meant = _meant(name)
    remedy = (
        f"Did you mean {meant}?" if meant else "clear-strategies --help lists all; a setting is written name=value."
    )
    raise SettingError(f"{name}: there is no such command. {remedy}")


def is_of_hydra(word: str) -> bool:
    """Whether a word begins as flags and overrides do; `~/photos` is a path."""
    return word.startswith(("-", "+", "~")) and expanded(word) == word


def _meant(word: str) -> str | None:
    """The command that a wrong one most resembles, or the one for the file or folder that it names; None for neither."""
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
    """Raises a SettingError for wrong arguments, in place of argparse's usage and exit."""

    def error(self, message: str) -> NoReturn:
        raise SettingError(f"{message}. {self.prog} --help lists the arguments.")


def parser_of(command: str, description: str, *, run: bool = True) -> argparse.ArgumentParser:
    """A parser with `--verbose`, and with RUN and `--rasterizer` for commands that open one."""
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
    """The type of an argument that is a path."""
    return Path(expanded(text))


def positive(text: str) -> int:
    """The type of an argument that must be a whole number above 0."""
    if not (text.isdecimal() and int(text) > 0):
        raise argparse.ArgumentTypeError(f"must be a whole number above 0, got {text}")
    return int(text)
