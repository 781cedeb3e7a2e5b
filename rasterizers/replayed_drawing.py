"""Drawings of a host's loop that are replayed: on a GPU, drawing and its backward pass take the host longer than the kernels.

Both passes of one kind of drawing are recorded, see `replays`, and done again for other splats, cameras and backgrounds. A loop
may keep a drawing, and a replay overwrites the one before. So its results are copied; while a drawing awaits its backward pass,
another of its kind is live; and a backward pass that comes later than the next replay draws once more. A recording is used only
if it has the bits of a live drawing of the same inputs.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, Final, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.checks import drawing
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, Rendering, SplatGradients, WithTraits, can_be_recorded, over
from rasterizers.recording import Recording, on_side_stream, running
from rasterizers.replays import Kind, Recorded, Replays, can_record, write

_BLACK: Final = (0.0, 0.0, 0.0)
_GRADIENTS: Final = tuple(f.name for f in fields(SplatGradients) if f.name != "absgrad")


def draw(rasterizer: Rasterizer, inputs: Inputs, camera: Camera, *, depth: bool) -> Rendering:
    """A drawing of the inputs, which have no graph: by a replay where it can be one."""
    device, given = inputs.means.device, _Given(rasterizer, inputs, camera, depth)
    if not (can_record(device) and can_be_recorded(rasterizer)) or running() is not None:
        return given.live()
    if device not in _threads.drawings:
        _threads.drawings[device] = _Drawings(device)
    return _threads.drawings[device].draw(given)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """What a drawing is made of; see `draw`."""

    rasterizer: Any
    inputs: Inputs
    camera: Camera
    depth: bool

    @property
    def kind(self) -> Kind:
        shapes = tuple(None if x is None else x.shape for x in self.inputs)
        size = self.camera.width, self.camera.height
        return Kind((len(self.inputs.means),), (*shapes, size), (_over_black(self.rasterizer), self.depth))

    @property
    def tensors(self) -> list[Tensor | None]:
        """All tensors that the work reads."""
        r, device = self.rasterizer, self.inputs.means.device
        return [*self.inputs, *r.numbers_of(self.camera, device), r.background_on(device)]

    def live(self) -> Rendering:
        return drawing(self.rasterizer, self.depth)(self.inputs.splats(), self.camera)


class _RecordedDrawing(Recorded[_Given, Rendering]):
    """Both passes of one kind of drawing.

    Attributes:
        turn: how often it has been drawn.
    """

    def __init__(self, given: _Given) -> None:
        device, camera = given.inputs.means.device, replace(given.camera)  # its numbers become those of others
        background = given.rasterizer.background_on(device).clone()
        own = replace(
            given, rasterizer=given.rasterizer.over_changing(background), inputs=given.inputs.copied(), camera=camera
        )
        tensors = own.tensors
        self._cotangent = background.new_ones(1, camera.height, camera.width, 3)
        self.turn = 0

        def forward() -> tuple[Rendering, list[Tensor | None]]:
            r = own.live()
            return r, [r.image, r.alpha, r.depth, r.means2d, r.visible]

        def backward(r: Rendering) -> list[Tensor | None]:
            gradients = r.vjp(self._cotangent)
            return [getattr(gradients, name) for name in _GRADIENTS]

        with on_side_stream(device):  # live, which also compiles the kernels of the backward pass
            rendering, live = forward()
            live += backward(rendering)
        super().__init__(Recording(device, forward), lambda given: write(tensors, given.tensors))
        rendering, made = self._recording.result
        self._backward = Recording(device, lambda: backward(rendering))
        _require_same_bits([*made, *self._backward.result], live)

    def outcome(self, given: _Given) -> Rendering:
        self.turn += 1
        rendering, made = self._recording.result
        return _Replayed(self, given, self.turn, rendering, _copied(made))

    def vjp(self, cotangents: Float[Tensor, "1 H W 3"]) -> SplatGradients:
        """Of what was drawn last."""
        self._cotangent.copy_(cotangents)
        self._backward.replay()
        return SplatGradients(*_copied(self._backward.result))


class _Replayed:
    """A `Rendering` by a replay."""

    def __init__(self, of: _RecordedDrawing, given: _Given, turn: int, last: Rendering, made: Sequence[Any]) -> None:
        self.image, self.alpha, self.depth, self.means2d, self.visible = made
        self._of, self._given, self._turn, self._recorded = of, given, turn, last
        self.awaits_backward = True

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """See `WithTraits`."""
        return cast(WithTraits, self._recorded if self._is_last else self._given.live()).radii

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], **more: Any) -> SplatGradients:
        """See `WithTraits`."""
        self.awaits_backward = False
        if self._is_last and len(cotangents) == 1 and not more:
            return self._of.vjp(cotangents)
        gradients: SplatGradients = cast(Any, self._given.live()).vjp(cotangents, **more)
        return gradients

    @property
    def _is_last(self) -> bool:
        return self._turn == self._of.turn


class _Drawings:
    """The drawings of a thread on one device."""

    def __init__(self, device: torch.device) -> None:
        self._replays = Replays(device, "the replay of drawings")
        self._last: dict[Kind, weakref.ref[_Replayed]] = {}
        self._count = 0

    def draw(self, given: _Given) -> Rendering:
        kind = given.kind
        last = self._last[kind]() if kind in self._last else None
        if last is not None and last.awaits_backward:
            return given.live()
        self._count += 1
        drawn = self._replays.do(kind, self._count, given, live=given.live, record=lambda: _RecordedDrawing(given))
        if isinstance(drawn, _Replayed):
            self._last = {k: one for k, one in self._last.items() if one() is not None} | {kind: weakref.ref(drawn)}
        return drawn


class _Threads(threading.local):
    def __init__(self) -> None:
        self.drawings: dict[torch.device, _Drawings] = {}


_threads: Final = _Threads()


@lru_cache(maxsize=64)
def _over_black(rasterizer: Any) -> Rasterizer:
    return over(rasterizer, _BLACK)


def _require_same_bits(replayed: Sequence[Tensor | None], live: Sequence[Tensor | None]) -> None:
    for x, y in zip(replayed, live, strict=True):
        if x is not None and y is not None and not torch.allclose(x, y, rtol=0, atol=0, equal_nan=True):
            raise RuntimeError("a replay has other bits than a live drawing of the same splats.")


def _copied(made: Sequence[Tensor | None]) -> list[Any]:
    copies = [None if x is None else torch.empty_like(x) for x in made]
    write(copies, made)
    return copies
