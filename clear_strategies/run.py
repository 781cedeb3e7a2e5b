"""`clear-strategies`, or `python -m clear_strategies.run`: the door to a whole run, and to the subcommands.

`clear-strategies train …` and the other subcommands are in `clear_strategies.commands`, whatever is none in
`clear_strategies.hydra_app`. Neither torch nor Hydra is imported before one of them needs it.
Exit codes: `clear_strategies.jobs.exit_codes`.
"""

from __future__ import annotations

import atexit
import gc
import logging
import signal
import sys
from importlib import import_module

from clear_strategies import commands, console, signals
from clear_strategies.jobs import exit_codes


def main() -> None:
    """The command line: a subcommand, or Hydra's."""
    atexit.register(gc.freeze)  # else Python looks through all of torch's objects before it ends, for 0.3 s
    atexit.register(signals.handle, signal.SIG_DFL)  # else one more Ctrl-C shows a traceback of Python's own end
    logging.captureWarnings(True)  # of libraries: they are for run.log
    console.harden_output()
    signals.handle(signals.stop)  # else the system ends us at once, and joblib's workers go on without us
    try:
        command = commands.named(sys.argv[1:])
        command() if command is not None else import_module("clear_strategies.hydra_app").main()
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        if (ending := exit_codes.describe(error)) is None:
            raise
        sys.stderr.write(f"{ending.message}\n")  # logging is set up for jobs only
        sys.exit(ending.code)


if __name__ == "__main__":
    main()
