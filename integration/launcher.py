"""The command line that all launchers share: CLEAR's options, the host's script, and the script's own arguments."""

from __future__ import annotations

import argparse
import importlib
import logging
import runpy
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, NoReturn

from clear_strategies import console
from clear_strategies.commands import path_of
from clear_strategies.errors import ClearError, DataError, HostError
from integration.replacing import replaced_attribute
from integration.settings import Settings
from integration.views import HostPhoto, save_photos

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Trainer:
    """A trainer whose scripts a launcher runs.

    Args:
        script: a description of its script.
        hook: takes `--save-lr` and the settings of `install`; returns a context in which the script runs with CLEAR. Its value
            is a list, to which the host's `Attached` are added while the script runs.
        otherwise: why the list may be empty at the end.
    """

    script: str
    hook: Callable[[Path | None, Settings], AbstractContextManager[list[Any]]]
    otherwise: str


def main(module: str, trainer: Trainer, arguments: Sequence[str] | None = None) -> int:
    """The program `python -m <module> [options] script [its arguments]`; returns its exit status."""
    return run(parser(module, f"Run {trainer.script} with CLEAR.").parse_args(arguments), lambda: trainer)


def parser(module: str, description: str) -> argparse.ArgumentParser:
    """The parser of the program's options, by the names of `Settings`."""
    made = argparse.ArgumentParser(prog=f"python -m {module}", description=description)
    add = made.add_argument
    add("--strategies", metavar="NAMES", help="of conf/strategy: clear, gco, gco,svs … (default: %(default)s)")
    add(
        "--overrides", action="append", metavar="KEY=VALUE",
        help="e.g. strategies.gco.tolerance=0.1; repeatable",
    )  # fmt: skip
    add(
        "--points", metavar="own|stereo",
        help="what the Gaussians start from: the trainer's own points, or dense stereo between its training photos "
        "(default: %(default)s)",
    )  # fmt: skip
    add("--sr", type=path_of, metavar="FOLDER", help="SR images, named like the photos")
    add("--suffix", help="what the SR tool appended to the names, e.g. _x4")
    add("--factor", type=int, help="HR pixels per LR pixel (default: %(default)s)")
    add(
        "--save-lr", type=path_of, metavar="FOLDER",
        help="write the photos as they are trained on (reduced, masked) for an SR tool to enlarge; then stop",
    )  # fmt: skip
    add("script", type=Path, help="the trainer's script")
    add("rest", nargs=argparse.REMAINDER, help="the arguments of the script")
    made.set_defaults(**asdict(Settings()) | {"overrides": []})
    return made


def run(options: argparse.Namespace, prepared: Callable[[], Trainer]) -> int:
    """Run the script; returns the exit status.

    Args:
        options: of `parser`; with `strategies` None the script runs without CLEAR.
        prepared: called when `sys.argv` and `sys.path` are the script's.
    """
    console.harden_output()
    console.show_in_host()
    try:
        if not options.script.is_file():
            raise DataError(options.script, "script", "is not there", "give the training script of your trainer")
        settings = None if options.strategies is None else _settings(options)
        folder = str(options.script.parent.resolve())
        with (  # as in `python script …`
            replaced_attribute(sys, "argv", [str(options.script), *options.rest]),
            replaced_attribute(sys, "path", [folder, *sys.path]),
        ):
            trainer = prepared()
            with nullcontext() if settings is None else trainer.hook(options.save_lr, settings) as attached:
                runpy.run_path(str(options.script), run_name="__main__")
    except ClearError as error:
        _log.error("%s", error)
        return 2
    if attached is None or any(each.attachment.counts["merges"] for each in attached):
        return 0
    _log.error("%s trained without CLEAR: %s.", options.script, trainer.otherwise)
    return 1


def module_of_host(name: str, rule: str) -> Any:
    """A module that the host must have.

    Args:
        rule: the rest of the error's sentence, and what to do.

    Raises:
        HostError: there is no such module.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):  # it imports another that is not there
            raise
        raise HostError(f"{sys.argv[0]} has no module {name}{rule}") from None


def save_lr(photos: Iterable[HostPhoto], folder: Path) -> NoReturn:
    """Implements `--save-lr`, instead of training."""
    save_photos(photos, folder)
    raise SystemExit(0)


def _settings(options: argparse.Namespace) -> Settings:
    """The settings of `install`, checked before the host loads its scene.

    Raises:
        SettingError: the configuration or `points` is refused, or HR is used without SR images.
    """
    settings = Settings(**{f.name: getattr(options, f.name) for f in fields(Settings)})
    if options.save_lr is None:
        settings.sr_source(settings.conductor())
    return settings
