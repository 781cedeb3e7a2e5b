"""The command line that all launchers share: CLEAR's options, the host's script, and the script's own arguments."""

from __future__ import annotations

import argparse
import logging
import runpy
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from clear_strategies.compose import conductor
from clear_strategies.errors import ClearError, DataError
from integration.log import show_log
from integration.points import wants_stereo
from integration.views import sr_images, sr_source

_log = logging.getLogger(__name__)


def main(
    module: str, script: str, arguments: Sequence[str] | None, train: Callable[[Launch], bool], otherwise: str
) -> int:
    """The program `python -m <module>`; returns its exit status.

    Args:
        script: the host's, in words. train: runs it; returns whether a step of CLEAR was made.
        otherwise: why none may have been.
    """
    show_log()
    options = _parser(module, f"Run {script} with CLEAR.").parse_args(arguments)
    try:
        if train(Launch(options)):
            return 0
    except ClearError as error:
        _log.error("%s", error)
        return 2
    _log.error("%s trained without CLEAR: %s.", options.script, otherwise)
    return 1


def _parser(module: str, description: str) -> argparse.ArgumentParser:
    """The arguments of `python -m <module> [options] script [its arguments]`."""
    made = argparse.ArgumentParser(prog=f"python -m {module}", description=description)
    add = made.add_argument
    add("--strategies", default="clear", metavar="NAMES", help="of conf/strategy: clear, gco, gco,svs … (%(default)s)")
    add(
        "--overrides", action="append", default=[], metavar="KEY=VALUE",
        help="e.g. strategies.gco.tolerance=0.1; repeatable",
    )  # fmt: skip
    add(
        "--points", default="own", metavar="own|stereo",
        help="what the Gaussians start from: the trainer's own points, or dense stereo between its training photos "
        "(%(default)s)",
    )  # fmt: skip
    add("--sr", metavar="FOLDER", help="SR images, named like the photos")
    add("--suffix", default="", help="what the SR tool appended to the names, e.g. _x4")
    add("--factor", type=int, default=4, help="HR pixels per LR pixel (%(default)s)")
    add(
        "--save-lr", metavar="FOLDER",
        help="write the photos as they are trained on (reduced, masked) for an SR tool to enlarge; then stop",
    )  # fmt: skip
    add("script", type=Path, help="the host's script")
    add("rest", nargs=argparse.REMAINDER, help="the arguments of the script")
    return made


class Launch:
    """One run of a host's script.

    Attributes:
        settings: the arguments of `install`.

    Raises:
        DataError: the script is missing.
        SettingError: the configuration or `points` is refused, or HR is used without SR images.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.script, self.arguments, self.save_lr = options.script, options.rest, options.save_lr
        if not self.script.is_file():
            raise DataError(self.script, "script", "is not there", "give the training script of your trainer")
        wants_stereo(options.points)  # raises now and not after the host has loaded its scene
        sr = sr_images(options.sr, options.suffix)
        self.settings: dict[str, Any] = {
            "strategies": options.strategies, "overrides": options.overrides, "sr": sr, "factor": options.factor,
            "points": options.points,
        }  # fmt: skip
        if self.save_lr is None:  # as early
            sr_source(sr, conductor(options.strategies, *options.overrides), options.factor)


def run_script(launch: Launch) -> None:
    """Run the script with `sys.argv` and `sys.path` as in `python script …`."""
    before = sys.argv, list(sys.path)
    sys.argv, sys.path[:0] = [str(launch.script), *launch.arguments], [str(launch.script.parent.resolve())]
    try:
        runpy.run_path(str(launch.script), run_name="__main__")
    finally:
        sys.argv, sys.path[:] = before
