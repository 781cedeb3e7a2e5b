"""simple_trainer's initial splats from dense stereo between its training photos."""

from __future__ import annotations

import copy
import functools
import inspect
import logging
from typing import Any, Final

from integration.gsplat.data import photos_of
from integration.points import no_stereo, stereo_points

_log = logging.getLogger(__name__)

_CREATE: Final = "create_splats_with_optimizers"


def start_from_stereo(runner_class: Any) -> None:
    """Make every later `Runner` start from the stereo cloud of its training photos.

    simple_trainer's `create_splats_with_optimizers` gets a parser whose `points` and `points_rgb` are that cloud; the
    runner's own parser stays as it is. With an `init_type` other than "sfm", which reads no points, a warning says so.

    Args:
        runner_class: simple_trainer's `Runner`.

    Raises:
        HostError: the module of the class has no create_splats_with_optimizers or no Dataset.
    """
    module = getattr(inspect.unwrap(runner_class.__init__), "__globals__", {})
    if missing := [name for name in (_CREATE, "Dataset") if name not in module]:
        raise no_stereo(
            f"the module of {runner_class.__name__} has no {missing[0]}, which gsplat's simple_trainer.py has"
        )
    create, dataset = module[_CREATE], module["Dataset"]

    @functools.wraps(create)
    def create_from_stereo(parser: Any, *args: Any, **kwargs: Any) -> Any:
        call = inspect.signature(create).bind(parser, *args, **kwargs)
        call.apply_defaults()
        init_type = call.arguments.get("init_type", "sfm")
        if init_type == "sfm":
            cloud = stereo_points(photos_of(dataset(parser, split="train")))
            parser = copy.copy(parser)  # what else its points are used for (depths) needs its own
            parser.points, parser.points_rgb = cloud.means.numpy(), (cloud.colors * 255).numpy()
        else:
            _log.warning("points=stereo has no effect with init_type=%s. Set init_type=sfm.", init_type)
        return create(parser, *args, **kwargs)

    module[_CREATE] = create_from_stereo
