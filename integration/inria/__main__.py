"""Run an unchanged 3DGS-style train.py with CLEAR attached: `python -m integration.inria train.py -s data`.

`gaussian_renderer.render` is wrapped before the script imports it. When the script first renders with gradients, the
strategies are attached to the model that it renders.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import logging
import runpy
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import torch

from clear_strategies.compose import conductor
from clear_strategies.data.priors import Images
from clear_strategies.errors import ClearError, DataError, SettingError
from clear_strategies.merging.conductor import Conductor
from integration.inria import THRESHOLD, Attached, Render, attach
from integration.views import sr_source

_log = logging.getLogger(__name__)

# 3DGS's defaults, for options that are not among the script's arguments.
_ITERATIONS: Final = 30_000
_DENSIFY_UNTIL: Final = 15_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a train.py with CLEAR attached; returns the exit status."""
    logging.basicConfig(level=logging.INFO, format="[clear] %(message)s")
    options = _parser().parse_args(arguments)
    try:
        run = _Run(options)
    except (ClearError, ValueError) as error:
        _log.error("%s", error)
        return 2
    try:
        return run.start()
    except ClearError as error:
        _log.error("%s", error)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m integration.inria",
        description="Run the train.py of a 3DGS-style trainer with CLEAR attached.",
    )
    add = parser.add_argument
    add("--clear", default="clear", metavar="NAMES", help="strategies of conf/: clear, gco, gco,svs … (%(default)s)")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="e.g. strategies.gco.tolerance=0.1; repeatable")
    add("--sr", metavar="FOLDER", help="SR images, named like the photos")
    add("--suffix", default="", help="what the SR tool appended to the names, e.g. _x4")
    add("--factor", type=int, default=4, help="HR pixels per LR pixel (%(default)s)")
    add("script", type=Path, help="train.py")
    add("rest", nargs=argparse.REMAINDER, help="the arguments of train.py")
    return parser


def _host_options(arguments: Sequence[str]) -> argparse.Namespace:
    """The options of train.py that CLEAR needs."""
    parser = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
    parser.add_argument("--iterations", type=int, default=_ITERATIONS)
    parser.add_argument("--densify_grad_threshold", type=float, default=THRESHOLD)
    parser.add_argument("--densify_until_iter", type=int, default=_DENSIFY_UNTIL)
    parser.add_argument("--start_checkpoint")
    return parser.parse_known_args(arguments)[0]


class _Run:
    """One run of a train.py.

    Raises:
        DataError: the script is missing, or the configuration is refused.
        SettingError: HR is used without SR images, or the script would start from a checkpoint.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        self.script, self.arguments, self.factor = options.script, options.rest, options.factor
        if not self.script.is_file():
            raise DataError(self.script, "script", "is not there", "give the train.py of your trainer")
        self.host_options = _host_options(self.arguments)
        if self.host_options.start_checkpoint is not None:
            raise SettingError(
                "start_checkpoint: the host's checkpoints hold nothing of CLEAR. Start from the beginning, without "
                "--start_checkpoint."
            )
        self.sr = None if options.sr is None else Images(options.sr, options.suffix)
        self.conductor: Conductor = conductor(options.clear, *options.set, iterations=self.host_options.iterations)
        sr_source(self.sr, self.conductor, self.factor)  # raises now and not after the host has loaded its scene
        self.scenes: list[Any] = []
        self.attached: Attached | None = None

    def start(self) -> int:
        with self._script_environment(), self._wrapped_host():
            runpy.run_path(str(self.script), run_name="__main__")
        if self.attached is None:
            _log.error("%s rendered no training camera by gaussian_renderer.render: CLEAR had no effect.", self.script)
            return 1
        _log.info("%s.", ", ".join(f"{n:,} {what}" for what, n in self.attached.attachment.counts.items()))
        return 0

    @contextmanager
    def _script_environment(self) -> Iterator[None]:
        """`sys.argv` and `sys.path` as in `python train.py …`."""
        before = sys.argv, list(sys.path)
        sys.argv, sys.path[:0] = [str(self.script), *self.arguments], [str(self.script.parent.resolve())]
        try:
            yield
        finally:
            sys.argv, sys.path[:] = before

    @contextmanager
    def _wrapped_host(self) -> Iterator[None]:
        renderer: Any = importlib.import_module("gaussian_renderer")
        scene: Any = importlib.import_module("scene")
        render, init = renderer.render, scene.Scene.__init__

        @functools.wraps(init)
        def init_and_remember(loaded: Any, *args: Any, **kwargs: Any) -> None:
            init(loaded, *args, **kwargs)
            self.scenes.append(loaded)

        renderer.render, scene.Scene.__init__ = self._attaching(render), init_and_remember
        try:
            yield
        finally:
            renderer.render, scene.Scene.__init__ = render, init
            if self.attached is not None:
                self.attached.remove()

    def _attaching(self, render: Render) -> Render:
        """`render` that attaches CLEAR when it first runs with gradients."""
        current = render

        @functools.wraps(render)
        def wrapped(viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
            nonlocal current
            training = torch.is_grad_enabled() and getattr(pc, "optimizer", None) is not None
            if self.attached is None and self.scenes and training:
                host = self.host_options
                self.attached = attach(
                    pc, self.scenes[-1].getTrainCameras(), self.conductor, sr=self.sr, factor=self.factor,
                    threshold=host.densify_grad_threshold, densify_until=host.densify_until_iter,
                )  # fmt: skip
                current = self.attached.wrap(render)
            return current(viewpoint_camera, pc, *args, **kwargs)

        return wrapped


if __name__ == "__main__":
    sys.exit(main())
