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
from pathlib import Path
from typing import Any, Final

from clear_strategies.errors import HostError
from integration import launcher
from integration.inria.cameras import photo_of
from integration.inria.from_options import install
from integration.settings import Settings
from integration.views import save_photos

_log = logging.getLogger("integration.inria")  # __name__ is "__main__" here


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a train.py with CLEAR; returns the exit status."""
    return launcher.main("integration.inria", HOST, arguments)


@contextmanager
def _installed_by_training_setup(save_lr: Path | None, settings: Settings) -> Iterator[list[Any]]:
    """CLEAR is installed after the first call of `training_setup` of each model (CoR-GS trains two), for the cameras of the last
    `Scene`.
    """
    importlib.import_module("gaussian_renderer")  # whose `render` install replaces
    scene: Any = importlib.import_module("scene")
    setup, init = scene.GaussianModel.training_setup, scene.Scene.__init__
    scenes, models, attached = list[Any](), list[Any](), list[Any]()

    @functools.wraps(init)
    def init_and_remember(loaded: Any, *args: Any, **kwargs: Any) -> None:
        init(loaded, *args, **kwargs)
        scenes.append(loaded)

    @functools.wraps(setup)
    def setup_and_install(gaussians: Any, opt: Any, *args: Any, **kwargs: Any) -> Any:
        result = setup(gaussians, opt, *args, **kwargs)
        if any(model is gaussians for model in models):  # points=stereo, and a restored checkpoint, call it again
            return result
        models.append(gaussians)
        if not scenes:
            raise HostError(
                "training_setup was called before a Scene was made, so the training cameras are unknown. Put the line "
                "install(gaussians, scene, opt, …) into the script instead."
            )
        if save_lr is not None:
            save_photos(map(photo_of, scenes[-1].getTrainCameras()), save_lr)
            raise SystemExit(0)
        attached.append(install(gaussians, scenes[-1], opt, settings))
        return result

    scene.GaussianModel.training_setup, scene.Scene.__init__ = setup_and_install, init_and_remember
    try:
        yield attached
        for each in attached:
            _log.info("%s.", each.attachment.summary())
    finally:
        scene.GaussianModel.training_setup, scene.Scene.__init__ = setup, init
        for each in reversed(attached):
            each.remove()


HOST: Final = launcher.Host(
    "the train.py of a 3DGS-style trainer",
    _installed_by_training_setup,
    "it called no GaussianModel.training_setup, or made no step",
)

if __name__ == "__main__":
    sys.exit(main())
