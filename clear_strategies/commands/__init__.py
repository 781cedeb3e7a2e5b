"""The subcommands of `clear-strategies`, and what they share.

A command is a module of this folder with `main(arguments)`, which `clear_strategies.run` imports and calls. It raises a
`ClearError` for errors that the user can solve: a run or an argument that cannot be used, a library that is not installed. It
imports torch, Hydra and modules that need them in the functions that use them, so that `--help` and the message for a wrong
argument appear at once.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

from clear_strategies.errors import SettingError
from clear_strategies.files import expanded


def is_of_hydra(word: str) -> bool:
    """Return True if a word begins as flags and overrides do; `~/photos` is a path."""
    return word.startswith(("-", "+", "~")) and expanded(word) == word


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


def positive(text: str, most: int = 100_000) -> int:
    """The argparse type of a whole number above 0: of pixels, pictures or threads, which no machine has more of."""
    if not (text.isdecimal() and len(text) < 20 and 0 < int(text) <= most):
        raise argparse.ArgumentTypeError(f"must be a whole number above 0 and at most {most:,}, got {text[:20]}")
    return int(text)
