"""Run gsplat's unchanged examples/simple_trainer.py with CLEAR:

    python -m integration.gsplat --sr sr_x4 simple_trainer.py default --data_dir data

The script ends with `gsplat.distributed.cli(main, cfg)`; there CLEAR is installed into its `Runner`.
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence
from typing import Any

from clear_strategies.errors import ClearError
from integration.errors import HostError
from integration.gsplat.attached import Attached
from integration.gsplat.data import save_lr
from integration.gsplat.simple_trainer import install
from integration.launcher import Launch, parser, run_script
from integration.log import show_log

_log = logging.getLogger("integration.gsplat")  # __name__ is "__main__" here


def main(arguments: Sequence[str] | None = None) -> int:
    """Run simple_trainer.py with CLEAR; returns the exit status."""
    show_log()
    options = parser("integration.gsplat", "Run gsplat's simple_trainer.py with CLEAR.").parse_args(arguments)
    attached: list[Attached] = []
    try:
        launch = Launch(options)
        _install_at_the_end(launch, attached)
        run_script(launch)
    except ClearError as error:
        _log.error("%s", error)
        return 2
    if not any(a.attachment.counts["merges"] for a in attached):
        _log.error("%s trained without CLEAR: no Runner was trained.", launch.script)
        return 1
    return 0


def _install_at_the_end(launch: Launch, attached: list[Attached]) -> None:
    """Install CLEAR when the script calls `cli`, which is when its `Runner` exists."""
    distributed: Any = importlib.import_module("gsplat.distributed")
    cli = distributed.cli

    def cli_with_clear(train: Any, *args: Any, **kwargs: Any) -> Any:
        distributed.cli = cli
        runner = getattr(train, "__globals__", {}).get("Runner")
        if runner is None:
            raise HostError(f"{launch.script} has no Runner, which gsplat's simple_trainer.py has.")
        if launch.save_lr is not None:
            runner.train = lambda self: _save_lr(self, launch.save_lr)
        else:
            install(runner, **launch.settings, installed=attached.append)
        return cli(train, *args, **kwargs)

    distributed.cli = cli_with_clear


def _save_lr(runner: Any, folder: Any) -> None:
    save_lr(runner.trainset, folder)
    raise SystemExit(0)


if __name__ == "__main__":
    sys.exit(main())
