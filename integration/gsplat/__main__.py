"""Run gsplat's unchanged examples/simple_trainer.py with CLEAR:

    python -m integration.gsplat --sr sr_x4 simple_trainer.py default --data_dir data

The script ends with `gsplat.distributed.cli(main, cfg)`; there CLEAR is installed into its `Runner`.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from torch.optim.optimizer import register_optimizer_step_pre_hook

from clear_strategies.errors import HostError
from integration import launcher
from integration.gsplat.simple_trainer import install, photos_of
from integration.settings import Settings
from integration.views import save_photos


def main(arguments: Sequence[str] | None = None) -> int:
    """Run simple_trainer.py with CLEAR; returns the exit status."""
    return launcher.main("integration.gsplat", HOST, arguments)


@contextmanager
def _installed_by_cli(save_lr: Path | None, settings: Settings) -> Iterator[list[Any]]:
    """CLEAR is installed when the script calls `cli`, which is when its `Runner` exists."""
    distributed: Any = importlib.import_module("gsplat.distributed")
    cli, attached = distributed.cli, list[Any]()
    before_cli = register_optimizer_step_pre_hook(_refuse_to_train)

    def cli_with_clear(train: Any, *args: Any, **kwargs: Any) -> Any:
        distributed.cli = cli
        before_cli.remove()
        runner = getattr(train, "__globals__", {}).get("Runner")
        if runner is None:
            raise HostError(f"{sys.argv[0]} has no Runner, which gsplat's simple_trainer.py has.")
        if save_lr is not None:
            runner.train = lambda self: _save_lr(self, save_lr)
        else:
            install(runner, settings, installed=attached.append)
        return cli(train, *args, **kwargs)

    distributed.cli = cli_with_clear
    try:
        yield attached
    finally:
        distributed.cli = cli
        before_cli.remove()


def _refuse_to_train(*_: Any) -> None:
    raise HostError(
        f"{sys.argv[0]} trains, but does not call gsplat's cli, as simple_trainer.py does, where CLEAR is installed. Call attach "
        "in its loop: docs/how-to/each-host.md."
    )


def _save_lr(runner: Any, folder: Path) -> None:
    save_photos(photos_of(runner.trainset), folder)
    raise SystemExit(0)


HOST: Final = launcher.Host("gsplat's simple_trainer.py", _installed_by_cli, "no Runner was trained")

if __name__ == "__main__":
    sys.exit(main())
