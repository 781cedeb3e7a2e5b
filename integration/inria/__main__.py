"""Run an unchanged 3DGS-style train.py with CLEAR: `python -m integration.inria --sr sr_x4 train.py -s data`.

When the script has called `GaussianModel.training_setup(opt)`, CLEAR is installed with the options that it passed. So it is after
another method whose name begins so, as InstantSplat's `training_setup_pp(opt, confidence_lr)`.
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook

from clear_strategies.errors import HostError
from integration import launcher
from integration.inria.cameras import photo_of
from integration.inria.from_options import install, training_render
from integration.replacing import replaced_attribute, replaced_everywhere
from integration.settings import Settings
from integration.views import no_stereo

_log = logging.getLogger("integration.inria")  # __name__ is "__main__" here
_SETUP: Final = "training_setup"
_BY_HAND: Final = (
    "Put the line install(gaussians, scene, opt, …) into the script; attach, if another function than render draws."
)


@contextmanager
def _installed_by_training_setup(save_lr: Path | None, settings: Settings) -> Iterator[list[Any]]:
    """CLEAR is installed after the first call of `training_setup` of each model (CoR-GS trains two), for the cameras of the last
    `Scene`.
    """
    renderer, scene = _of_trainer("gaussian_renderer"), _of_trainer("scene")  # install replaces `render` of the first
    init, render = scene.Scene.__init__, training_render(renderer)
    of = scene.GaussianModel
    scenes, models, attached, drawing, watching = list[Any](), list[Any](), list[Any](), [render], ExitStack()

    @functools.wraps(init)
    def init_and_remember(loaded: Any, *args: Any, **kwargs: Any) -> None:
        init(loaded, *args, **kwargs)
        scenes.append(loaded)

    def installing(setup: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(setup)
        def setup_and_install(gaussians: Any, *args: Any, **kwargs: Any) -> Any:
            result, opt = setup(gaussians, *args, **kwargs), next(iter((*args, *kwargs.values())), None)
            # SCGaussian's of an earlier stage has no options; points=stereo, and a restored checkpoint, set a model up again
            if opt is None or any(model is gaussians for model in models):
                return result
            models.append(gaussians)
            if not scenes:
                raise HostError(
                    f"{setup.__name__} was called before a Scene was made, so the training cameras are unknown. {_BY_HAND}"
                )
            if save_lr is not None:
                launcher.save_lr(map(photo_of, scenes[-1].getTrainCameras()), save_lr)
            if settings.points == "stereo" and setup.__name__ != _SETUP:
                raise no_stereo(f"the script calls {setup.__name__}, whose arguments belong to its own points")
            watching.close()  # the module's function has the host's own as its __wrapped__
            attached.append(install(gaussians, scenes[-1], opt, settings))
            undo.callback(attached[-1].remove)
            drawing.append(attached[-1].wrap(drawing[-1]))  # for what has taken the module's function before, as EDGS
            return result

        return setup_and_install

    @functools.wraps(render)
    def render_as_attached(*args: Any, **kwargs: Any) -> Any:
        return drawing[-1](*args, **kwargs)

    with ExitStack() as undo:
        undo.enter_context(watching)
        watching.enter_context(replaced_everywhere(render, render_as_attached))
        watching.callback(register_optimizer_step_pre_hook(_refuse_to_train).remove)
        undo.enter_context(replaced_attribute(scene.Scene, "__init__", init_and_remember))
        for name in [name for name in dir(of) if name.startswith(_SETUP)]:
            undo.enter_context(replaced_attribute(of, name, installing(getattr(of, name))))
        yield attached
        for each in attached:
            _log.info("%s.", each.attachment.summary())


def _refuse_to_train(optimizer: torch.optim.Optimizer, *_: Any) -> None:
    """GES sets up a model of another class, and draws it by another function."""
    if any(group.get("name") == "xyz" for group in optimizer.param_groups):
        raise HostError(
            f"the Gaussians of {sys.argv[0]} would train without CLEAR: no scene.GaussianModel.{_SETUP} set them up. {_BY_HAND}"
        )


def _of_trainer(name: str) -> Any:
    remedy = (
        "Where it is elsewhere, as in EDGS, set PYTHONPATH. Another trainer needs an adapter: docs/how-to/own-host.md."
    )
    return launcher.module_of_host(name, f" beside it, as in 3DGS. {remedy}")


TRAINER: Final = launcher.Trainer(
    "the train.py of a 3DGS-style trainer",
    _installed_by_training_setup,
    "it called no GaussianModel.training_setup, or made no step",
)
main: Final = functools.partial(launcher.main, "integration.inria", TRAINER)

if __name__ == "__main__":
    sys.exit(main())
