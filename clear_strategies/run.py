"""`clear-strategies`, or `python -m clear_strategies.run`: the door to a whole run, and to the subcommands.

Arguments that begin with an override or a flag are passed to Hydra (`clear_strategies.hydra_app`): `+strategy=clear`,
`fit.iterations=300`, `-m`, `--cfg job`. Others name a subcommand, a module of `clear_strategies.commands`. Neither torch nor
Hydra is imported before one of them needs it. Exit codes: `clear_strategies.jobs.exit_codes`.
"""

from __future__ import annotations

import atexit
import difflib
import gc
import logging
import shlex
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Final

from clear_strategies import console, signals
from clear_strategies.commands import is_of_hydra
from clear_strategies.errors import SettingError
from clear_strategies.jobs import exit_codes

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
    "clear-strategies +strategy=clear --cfg job --resolve": "prints a run's configuration; nothing runs",
    "python -m clear_strategies.report FOLDER": "a table of the runs in a folder, and report.html",
    "clear-strategies --hydra-help": "the flags of Hydra, which reads these lines",
}


def main() -> None:
    """The command line: a subcommand, or Hydra's."""
    program(lambda: named(sys.argv[1:])())  # noqa: PLW0108 - `named` raises errors, too


def program(command: Callable[[], object]) -> None:
    """Run a command; what the user can solve is told in one line, with an exit code (`jobs.exit_codes`)."""
    atexit.register(gc.freeze)  # else Python looks through all of torch's objects before it ends, for 0.3 s
    atexit.register(signals.handle, signal.SIG_DFL)  # else one more Ctrl-C shows a traceback of Python's own end
    logging.captureWarnings(True)  # of libraries: they are for run.log
    console.harden_output()
    signals.handle(signals.stop)  # else the system ends us at once, and joblib's workers go on without us
    try:
        command()
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        if (ending := exit_codes.describe(error)) is None:
            raise
        sys.stderr.write(f"{ending.message}\n")  # logging is set up for jobs only
        sys.exit(ending.code)


def named(arguments: Sequence[str]) -> Callable[[], None]:
    """Return a function that does what the program's arguments ask for."""
    name = arguments[0] if arguments else "help"
    if name in ("help", "--help", "-h"):
        return _help
    if "--version" in arguments:
        return _version
    if name in NAMES:
        return lambda: import_module(f"clear_strategies.commands.{name}").main(list(arguments[1:]))
    if is_of_hydra(name) or "=" in name:
        return lambda: import_module("clear_strategies.hydra_app").main()
    remedy = "clear-strategies --help lists all; a setting is written name=value."
    if similar := _similar_command(name):
        remedy = f"Did you mean {similar}?"
    raise SettingError(f"{name}: there is no such command. {remedy}")


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
        "clear-strategies COMMAND …, for photos and saved runs. COMMAND --help shows its arguments.\n\n"
        f"{_rows(COMMANDS)}\n"
        "clear-strategies setting=value …, for research: any strategies, data and settings, and sweeps.\n\n"
        f"{_rows(_RESEARCH)}"
    )


def _rows(table: Mapping[str, str]) -> str:
    width = max(map(len, table))
    return "".join(f"  {left:<{width}}  {right}\n" for left, right in table.items())


if __name__ == "__main__":
    main()
