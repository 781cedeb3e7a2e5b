"""Run gsplat's unchanged examples/simple_trainer.py with CLEAR:

    python -m integration.gsplat --sr sr_x4 simple_trainer.py default --data_dir data

The script ends with `gsplat.distributed.cli(main, cfg)`; there CLEAR is installed into its `Runner`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from typing import Any

from integration import launcher
from integration.errors import HostError
from integration.gsplat.attached import Attached
from integration.gsplat.data import photos_of
from integration.gsplat.simple_trainer import install
from integration.launcher import Launch, run_script
from integration.views import save_photos


def main(arguments: Sequence[str] | None = None) -> int:
    """Run simple_trainer.py with CLEAR; returns the exit status."""
    return launcher.main("integration.gsplat", "gsplat's simple_trainer.py", arguments, _train, "no Runner was trained")


def _train(launch: Launch) -> bool:
    attached: list[Attached] = []
    _install_at_the_end(launch, attached)
    run_script(launch)
    return any(a.attachment.counts["merges"] for a in attached)


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
    save_photos(photos_of(runner.trainset), folder)
    raise SystemExit(0)


if __name__ == "__main__":
    sys.exit(main())
