"""An Inria-style train.py with CLEAR attached and no line of it changed: `python -m integration.inria train.py -s data`.

`gaussian_renderer.render` is wrapped before the script imports it; the first training camera that it draws attaches the
strategies to the model that it is drawn from.
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

from clear_strategies.data.priors import Images
from clear_strategies.errors import ClearError, DataError
from clear_strategies.merging.conductor import Conductor
from integration.inria import THRESHOLD, Attached, Render, attach
from integration.views import super_resolve

_log = logging.getLogger(__name__)

# 3DGS's own, for a train.py that is not given others.
_ITERATIONS: Final = 30_000
_DENSIFY_UNTIL: Final = 15_000


def main(arguments: Sequence[str] | None = None) -> int:
    """Run somebody's train.py with CLEAR attached; returns the exit status."""
    logging.basicConfig(level=logging.INFO, format="[clear] %(message)s")
    given = _parser().parse_args(arguments)
    try:
        launch = _Launch(given)
    except (ClearError, ValueError) as error:
        _log.error("%s", error)
        return 2
    try:
        return launch.run()
    except ClearError as error:
        _log.error("%s", error)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m integration.inria",
        description="Run the train.py of an Inria-style trainer with CLEAR attached.",
    )
    add = parser.add_argument
    add("--clear", default="clear", metavar="NAMES", help="strategies of conf/: clear, gco, gco,svs … (%(default)s)")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="e.g. strategies.gco.tolerance=0.1; repeatable")
    add("--sr", metavar="FOLDER", help="SR pictures, named like the photographs")
    add("--suffix", default="", help="what the SR tool appended to the names, e.g. _x4")
    add("--factor", type=int, default=4, help="HR pixels per LR pixel (%(default)s)")
    add("script", type=Path, help="train.py")
    add("rest", nargs=argparse.REMAINDER, help="its own arguments")
    return parser


class _Launch:
    """One run of a train.py.

    Raises:
        DataError: a strategy, setting or file is not there. ValueError: HR takes part, but there are no SR pictures.
    """

    def __init__(self, given: argparse.Namespace) -> None:
        from clear_strategies.compose import conductor

        self.script, self.arguments, self.factor = given.script, given.rest, given.factor
        if not self.script.is_file():
            raise DataError(self.script, "script", "is not there", "give the train.py of your trainer")
        host = argparse.ArgumentParser(allow_abbrev=False, add_help=False)
        host.add_argument("--iterations", type=int, default=_ITERATIONS)
        host.add_argument("--densify_grad_threshold", type=float, default=THRESHOLD)
        host.add_argument("--densify_until_iter", type=int, default=_DENSIFY_UNTIL)
        host.add_argument("--start_checkpoint")
        self.opt, _ = host.parse_known_args(self.arguments)
        if self.opt.start_checkpoint is not None:
            raise ValueError(
                "a checkpoint of the host holds nothing of CLEAR: start from the beginning, without --start_checkpoint."
            )
        self.sr = None if given.sr is None else Images(given.sr, given.suffix)
        self.conductor: Conductor = conductor(given.clear, *given.set, iterations=self.opt.iterations)
        super_resolve(self.sr, self.conductor, self.factor)
        self.scenes: list[Any] = []
        self.attached: Attached | None = None

    def run(self) -> int:
        with self._as_the_script(), self._wrapped():
            runpy.run_path(str(self.script), run_name="__main__")
        if self.attached is None:
            _log.error("%s drew no training camera by gaussian_renderer.render: CLEAR took no part.", self.script)
            return 1
        _log.info("%s.", ", ".join(f"{n:,} {what}" for what, n in self.attached.attachment.counts.items()))
        return 0

    @contextmanager
    def _as_the_script(self) -> Iterator[None]:
        """As if python had been started with it."""
        before = sys.argv, list(sys.path)
        sys.argv, sys.path[:0] = [str(self.script), *self.arguments], [str(self.script.parent.resolve())]
        try:
            yield
        finally:
            sys.argv, sys.path[:] = before

    @contextmanager
    def _wrapped(self) -> Iterator[None]:
        renderer: Any = importlib.import_module("gaussian_renderer")
        scene: Any = importlib.import_module("scene")
        render, load = renderer.render, scene.Scene.__init__

        @functools.wraps(load)
        def remember(loaded: Any, *args: Any, **kwargs: Any) -> None:
            load(loaded, *args, **kwargs)
            self.scenes.append(loaded)

        renderer.render, scene.Scene.__init__ = self._attaching(render), remember
        try:
            yield
        finally:
            renderer.render, scene.Scene.__init__ = render, load
            if self.attached is not None:
                self.attached.remove()

    def _attaching(self, render: Render) -> Render:
        """`render`, which attaches when it first draws with gradients."""
        now = render

        @functools.wraps(render)
        def wrapped(viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
            nonlocal now
            trains = torch.is_grad_enabled() and getattr(pc, "optimizer", None) is not None
            if self.attached is None and self.scenes and trains:
                self.attached = attach(
                    pc, self.scenes[-1].getTrainCameras(), self.conductor, sr=self.sr, factor=self.factor,
                    threshold=self.opt.densify_grad_threshold, densify_until=self.opt.densify_until_iter,
                )  # fmt: skip
                now = self.attached.wrap(render)
            return now(viewpoint_camera, pc, *args, **kwargs)

        return wrapped
