"""Replays of the drawings of a host's loop: on a GPU, launching a drawing and its backward pass takes longer than the kernels.

Both passes are recorded, see `replays`, and replayed with other splats, cameras and backgrounds. A loop may keep a drawing, which
the next replay would overwrite. So results are copied; while a drawing awaits its backward pass, another with the same key is
live; and a backward pass that comes after the next replay draws once more. A recording is used only if it has the bits of a live
drawing of the same inputs.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, partial
from typing import Any, Final, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from rasterizers.inputs import Inputs
from rasterizers.interface import (
    Camera,
    Rasterizer,
    Rendering,
    SplatGradients,
    WithTraits,
    is_recordable,
    over,
    with_depth,
)
from rasterizers.recording import Recording, on_side_stream, running
from rasterizers.replays import Given, Replay, ReplayKey, Replays, StaticInputs, can_record, shapes_of, write

_BLACK: Final = (0.0, 0.0, 0.0)
_GRADIENTS: Final = tuple(f.name for f in fields(SplatGradients) if f.name != "absgrad")


def draw(rasterizer: Rasterizer, inputs: Inputs, camera: Camera, *, depth: bool) -> Rendering:
    """Draw the inputs, which have no autograd graph, by a replay if one is possible."""
    device, call = inputs.means.device, _Call(rasterizer, inputs, camera, depth)
    if not (can_record(device) and is_recordable(rasterizer)) or running() is not None:
        return call.live()
    key, last = call.key, _thread.last
    if key in last and (drawn := last[key]()) is not None and drawn.awaits_backward:
        return call.live()
    if device not in _thread.replays:
        _thread.replays[device] = Replays(device, "the replay of drawings")
    _thread.count += 1
    record = partial(_DrawingReplay, call)
    rendering = _thread.replays[device].do(key, _thread.count, call.given, live=call.live, record=record)
    if isinstance(rendering, _ReplayedRendering):
        rendering.call = call
        _thread.last = {k: one for k, one in last.items() if one() is not None} | {key: weakref.ref(rendering)}
    return rendering


class _Thread(threading.local):
    """A thread's recordings of drawings, the last replay of each kind while its rendering is alive, and the number of calls."""

    def __init__(self) -> None:
        self.replays: dict[torch.device, Replays] = {}
        self.last: dict[ReplayKey, weakref.ref[_ReplayedRendering]] = {}
        self.count = 0


_thread: Final = _Thread()


@dataclass(frozen=True, slots=True, eq=False)
class _Call:
    """The arguments of `draw`."""

    rasterizer: Any
    inputs: Inputs
    camera: Camera
    depth: bool

    @property
    def key(self) -> ReplayKey:
        n, device = len(self.inputs.means), self.inputs.means.device
        return ReplayKey(n, (), shapes_of(self.given, n), (device, _over_black(self.rasterizer), self.depth))

    @property
    def given(self) -> Given:
        """All that the drawing reads."""
        return [*self.inputs, self.camera, self.rasterizer.background_on(self.inputs.means.device)]

    def live(self) -> Rendering:
        return with_depth(self.rasterizer, self.depth)(self.inputs.splats(), self.camera)


class _DrawingReplay(Replay[Rendering]):
    """Both passes of a drawing.

    Attributes:
        replays: the number of replays so far.
    """

    def __init__(self, call: _Call) -> None:
        device, r = call.inputs.means.device, call.rasterizer
        copied = StaticInputs(call.given, partial(r.numbers_of, device=device))
        *inputs, camera, background = copied.copies
        static = replace(call, rasterizer=r.over_changing(background), inputs=Inputs(*inputs), camera=camera)
        self._cotangent = background.new_ones(1, camera.height, camera.width, 3)
        self.replays = 0

        def forward() -> tuple[Rendering, list[Tensor | None]]:
            r = static.live()
            return r, [r.image, r.alpha, r.depth, r.means2d, r.visible]

        def backward(r: Rendering) -> list[Tensor | None]:
            gradients = r.vjp(self._cotangent)
            return [getattr(gradients, name) for name in _GRADIENTS]

        with on_side_stream(device):  # live, which also compiles the kernels of the backward pass
            rendering, live = forward()
            live += backward(rendering)
        super().__init__(Recording(device, forward), copied)
        rendering, made = self._recording.result
        self._backward = Recording(device, lambda: backward(rendering))
        _require_same_bits([*made, *self._backward.result], live)

    def outcome(self) -> Rendering:
        self.replays += 1
        rendering, made = self._recording.result
        return _ReplayedRendering(self, self.replays, rendering, _copied(made))

    def vjp(self, cotangents: Float[Tensor, "1 H W 3"]) -> SplatGradients:
        """The gradients of the last replay."""
        self._cotangent.copy_(cotangents)
        self._backward.replay()
        return SplatGradients(*_copied(self._backward.result))


class _ReplayedRendering:
    """The `Rendering` of a replay.

    Attributes:
        call: what was drawn, to draw it once more.
    """

    call: _Call

    def __init__(self, of: _DrawingReplay, number: int, last: Rendering, made: Sequence[Any]) -> None:
        self.image, self.alpha, self.depth, self.means2d, self.visible = made
        self._of, self._number, self._last = of, number, last
        self.awaits_backward = True

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """See `WithTraits`."""
        return cast(WithTraits, self._last if self._is_last else self.call.live()).radii

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], **more: Any) -> SplatGradients:
        """See `WithTraits`."""
        self.awaits_backward = False
        if self._is_last and len(cotangents) == 1 and not more:
            return self._of.vjp(cotangents)
        gradients: SplatGradients = cast(Any, self.call.live()).vjp(cotangents, **more)
        return gradients

    @property
    def _is_last(self) -> bool:
        return self._number == self._of.replays


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
