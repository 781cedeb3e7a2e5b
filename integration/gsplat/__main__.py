"""Run gsplat's unchanged examples/simple_trainer.py with CLEAR:

    python -m integration.gsplat --sr sr_x4 simple_trainer.py default --data_dir data

The script ends with `gsplat.distributed.cli(main, cfg)`; there CLEAR is installed into its `Runner`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final

from torch.optim.optimizer import register_optimizer_step_pre_hook

from clear_strategies.errors import HostError
from integration import launcher
from integration.gsplat.simple_trainer import in_one_process, install, photos_of
from integration.replacing import replaced_attribute
from integration.settings import Settings

VERSIONS: Final = ", which gsplat 1.4 to 1.6 have. Install one of these."


@contextmanager
def _installed_by_cli(save_lr: Path | None, settings: Settings) -> Iterator[list[Any]]:
    """Install CLEAR when the script calls `cli`, after it has defined its `Runner`."""
    distributed = launcher.module_of_host("gsplat.distributed", VERSIONS)
    cli, attached, undo = distributed.cli, list[Any](), ExitStack()

    def cli_with_clear(train: Any, *args: Any, **kwargs: Any) -> Any:
        undo.close()
        runner = getattr(train, "__globals__", {}).get("Runner")
        if runner is None:
            raise HostError(f"{sys.argv[0]} has no Runner, which gsplat's simple_trainer.py has.")
        if save_lr is not None:
            runner.train = lambda self: launcher.save_lr(photos_of(self.trainset), save_lr)
        else:
            install(runner, settings, installed=attached.append)
        return in_one_process(cli)(train, *args, **kwargs)

    with undo:
        undo.callback(register_optimizer_step_pre_hook(_refuse_to_train).remove)
        undo.enter_context(replaced_attribute(distributed, "cli", cli_with_clear))
        yield attached


def _refuse_to_train(*_: Any) -> None:
    raise HostError(
        f"{sys.argv[0]} trains, but does not call gsplat's cli, as simple_trainer.py does, where CLEAR is installed. Call attach "
        "in its loop (docs/how-to/each-host.md), or write an adapter (docs/how-to/own-host.md)."
    )


TRAINER: Final = launcher.Trainer("gsplat's simple_trainer.py", _installed_by_cli, "no Runner was trained")
main: Final = partial(launcher.main, "integration.gsplat", TRAINER)

if __name__ == "__main__":
    sys.exit(main())
