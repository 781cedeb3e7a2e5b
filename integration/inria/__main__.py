"""Run an unchanged 3DGS-style train.py with CLEAR: `python -m integration.inria --sr sr_x4 train.py -s data`.

When the script has called `GaussianModel.training_setup(opt)`, CLEAR is installed with the options that it passed.
"""

from __future__ import annotations

import functools
import importlib
import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from integration import launcher
from integration.errors import HostError
from integration.inria import Attached
from integration.inria.cameras import photo_of
from integration.inria.from_options import install
from integration.launcher import Launch, run_script
from integration.views import save_photos

_log = logging.getLogger("integration.inria")  # __name__ is "__main__" here


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a train.py with CLEAR; returns the exit status."""
    why = "it called no GaussianModel.training_setup, or made no step"
    return launcher.main(
        "integration.inria", "the train.py of a 3DGS-style trainer", arguments, lambda launch: _Run(launch).train(), why
    )


class _Run:
    """One run of a train.py.

    Attributes:
        attached: None before the script's `training_setup`.
    """

    def __init__(self, launch: Launch) -> None:
        self._launch = launch
        self._scene: Any = None
        self.attached: Attached | None = None

    def train(self) -> bool:
        """Whether a step of CLEAR was made."""
        folder = str(self._launch.script.parent.resolve())
        sys.path.insert(0, folder)  # for the host's modules
        try:
            with self._hooked_host():
                run_script(self._launch)
        finally:
            sys.path.remove(folder)
        if self.attached is None or not self.attached.attachment.counts["merges"]:
            return False
        _log.info("%s.", self.attached.attachment.summary())
        return True

    @contextmanager
    def _hooked_host(self) -> Iterator[None]:
        importlib.import_module("gaussian_renderer")
        scene: Any = importlib.import_module("scene")
        setup, init = scene.GaussianModel.training_setup, scene.Scene.__init__

        @functools.wraps(init)
        def init_and_remember(loaded: Any, *args: Any, **kwargs: Any) -> None:
            init(loaded, *args, **kwargs)
            self._scene = loaded

        @functools.wraps(setup)
        def setup_and_install(gaussians: Any, opt: Any, *args: Any, **kwargs: Any) -> Any:
            result = setup(gaussians, opt, *args, **kwargs)
            scene.GaussianModel.training_setup = setup  # points=stereo, and a restored checkpoint, call it again
            self._install(gaussians, opt)
            return result

        scene.GaussianModel.training_setup, scene.Scene.__init__ = setup_and_install, init_and_remember
        try:
            yield
        finally:
            scene.GaussianModel.training_setup, scene.Scene.__init__ = setup, init
            if self.attached is not None:
                self.attached.remove()

    def _install(self, gaussians: Any, opt: Any) -> None:
        if self._scene is None:
            raise HostError(
                "training_setup was called before a Scene was made, so the training cameras are unknown. Put the line "
                "install(gaussians, scene, opt, …) into the script instead."
            )
        if self._launch.save_lr is not None:
            save_photos(map(photo_of, self._scene.getTrainCameras()), self._launch.save_lr)
            raise SystemExit(0)
        self.attached = install(gaussians, self._scene, opt, **self._launch.settings)


if __name__ == "__main__":
    sys.exit(main())
