"""What the subcommands share: their arguments."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from clear_strategies.errors import SettingError


class _Parser(argparse.ArgumentParser):
    """Raises a SettingError for wrong arguments, in place of argparse's usage and exit."""

    def error(self, message: str) -> NoReturn:
        raise SettingError(f"{message}. {self.prog} --help lists the arguments.")


def parser_of(command: str, description: str, *, run: bool = True) -> argparse.ArgumentParser:
    """A parser with `--verbose`, and with RUN and `--rasterizer` for commands that open one."""
    parser = _Parser(prog=f"clear-strategies {command}", description=description)
    if run:
        parser.add_argument(
            "run", type=Path, metavar="RUN", help="a run's folder, one of its checkpoints, or a PLY file"
        )
        parser.add_argument("--rasterizer", metavar="NAME", help="cpp, torch, warp or gsplat (default: the run's own)")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more")
    return parser


def positive(kind: Callable[[str], float]) -> Callable[[str], float]:
    """The type of an argument that must be a number above 0."""

    def parse(text: str) -> float:
        value = kind(text)
        if not (value > 0 and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f"must be above 0, got {text}")
        return value

    parse.__name__ = getattr(kind, "__name__", "number")
    return parse
