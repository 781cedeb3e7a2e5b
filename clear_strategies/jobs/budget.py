"""A run that ends within a number of minutes (`fit.minutes`): the size of HR and the number of iterations follow.

Both come from measurements on this machine: the seconds that the SR network takes for a crop of a photo, and those of a few
iterations from the middle of the run, whose result is thrown away. A run that is late all the same leaves out iterations
before its learning rates fall, as one on a plateau does (`skips.plateau_to`).
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from clear_strategies.data.capture import Frame
from clear_strategies.data.priors import Prior, network_of, passes_of
from clear_strategies.training.loop import iterate, kernel_threads
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer

_log = logging.getLogger(__name__)

_STARTED: Final = 3.0  # seconds before a job begins: Python, torch, the configuration
_SR: Final = 0.2  # share of the time that is left which SR images may take
_CROP: Final = 96  # px of the crop that a network is timed on
_LOADED: Final = 32  # px of one before it: the first call of a network also loads it
_LEAST_MEGAPIXELS: Final = 0.1
_LEAST: Final = 60  # iterations: with fewer there is nothing to look at
_PILOT: Final = 8.0  # seconds of iterations that are timed
_WARM: Final = 3  # iterations before them: caches, evidence
_PACE: Final = 20  # iterations over which the pace of a run is measured

# What a run's files cost, in HR renders and in iterations, and seconds of what does not depend on the field.
_RENDERS_OF_VIEW, _RENDERS, _ITERATIONS_OF_MAP, _REST = 3, 60, 16, 5.0


@dataclass(frozen=True, slots=True)
class Budget:
    """The seconds of a run, and when it began, by `time.perf_counter`."""

    seconds: float
    began: float

    @classmethod
    def of(cls, minutes: float) -> Budget:
        return cls(60 * minutes, time.perf_counter() - _STARTED)

    @property
    def left(self) -> float:
        """Seconds."""
        return self.began + self.seconds - time.perf_counter()

    def megapixels(self, frames: Sequence[Frame], prior: Prior, factor: int) -> float | None:
        """The megapixels of an HR image up to which the SR images of all frames fit; None where no network makes them.

        Args:
            factor: by which the prior enlarges.
        """
        if (network := network_of(prior)) is None or not frames:
            return None
        photo = frames[0].load()[:_CROP, :_CROP]
        network("a crop, to load the network", photo[:_LOADED, :_LOADED], factor)
        began = time.perf_counter()
        height, width, _ = network("a crop, to measure the time", photo, factor).shape
        each = passes_of(prior) * (time.perf_counter() - began) / (height * width)
        return max(_LEAST_MEGAPIXELS, _SR * self.left / (len(frames) * each * 1e6))

    def iterations(self, state: TrainState, rasterizer: Rasterizer, *, trainings: int, maps: int, frames: int) -> Plan:
        """How many iterations fit.

        Args:
            state: to measure with; it is of no use afterwards.
            trainings: that the run consists of.
            maps, frames: of the pictures, `fit.map_views` and `fit.video`.
        """
        most = state.settings.iterations
        state.t, times = max(1, most // 2), list[float]()
        with kernel_threads(state, rasterizer):
            while len(times) < _WARM + 1 or (sum(times[_WARM:]) < _PILOT and len(times) < _WARM + len(state.views)):
                began = time.perf_counter()
                iterate(state, rasterizer)
                times.append(time.perf_counter() - began)
        each = sum(times[_WARM:]) / len(times[_WARM:])
        began = time.perf_counter()
        state.field.render(rasterizer, state.views[0].hr.camera)
        render = time.perf_counter() - began
        renders = frames + _RENDERS_OF_VIEW * len(state.views) + _RENDERS
        files = renders * render + maps * _ITERATIONS_OF_MAP * each + _REST
        iterations = min(most, max(_LEAST, int((self.left - files) / (trainings * each))))
        return Plan(iterations, each, files, self)


@dataclass(frozen=True, slots=True)
class Plan:
    """How a run keeps to its budget.

    Args:
        each: seconds of an iteration.
        files: seconds that the run's files will take.
    """

    iterations: int
    each: float
    files: float
    budget: Budget

    def description(self) -> str:
        """A line of the run's printed plan."""
        spent, whole = self.budget.seconds - self.budget.left, self.budget.seconds
        line = (
            f"{whole / 60:g} minutes: {spent:.0f} s until now, {self.iterations} iterations of {self.each:.2f} s, "
            f"{self.files:.0f} s for pictures and files"
        )
        late = spent + self.iterations * self.each + self.files - whole
        return line if late < 0.2 * whole else f"{line}; this takes {late:.0f} s longer than asked for"

    def hurry(self, state: TrainState) -> Callable[[], None]:
        """A function to call after each iteration. When the rest takes longer than is left, it skips to where the rates fall."""
        skips, ticks = state.skip_policy.skips, [time.perf_counter()]

        def check() -> None:
            ticks.append(time.perf_counter())
            recent = ticks[-_PACE - 1 :]
            pace = (recent[-1] - recent[0]) / (len(recent) - 1)
            to = min(skips.plateau_to, state.settings.iterations - 1)  # the last one is trained and evaluated
            late = (state.settings.iterations - to) * pace > self.budget.left - self.files
            if late and skips.plateau_from <= state.t < to:
                state.skip_until(to, "the time that is left would not last (fit.minutes)")

        return check
