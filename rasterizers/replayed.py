"""Drawings of a host's loop that are replayed: on a GPU, drawing and its backward pass take the host longer than the kernels.

Both passes of one kind of drawing are recorded, see `replays`, and done again for other splats, cameras and backgrounds. A loop
may keep a drawing, and a replay overwrites the one before. So its results are copied; while a drawing awaits its backward pass,
another of its kind is live; and a backward pass that comes later than the next replay draws once more.
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
from rasterizers.interface import Camera, Rasterizer, Rendering, SplatGradients, Splats, WithRadii, over
from rasterizers.recording import Recording, on_side_stream, running
from rasterizers.replays import Kind, Recorded, Replays, can_record, write
from rasterizers.warp_runtime import sent

_BLACK: Final = (0.0, 0.0, 0.0)
_GRADIENTS: Final = tuple(f.name for f in fields(SplatGradients) if f.name != "absgrad")


def draw(
    rasterizer: Rasterizer, splats: Splats, colors: Float[Tensor, "N B1 3"], camera: Camera, *, depth: bool
) -> Rendering:
    """A drawing: by a replay where it can be one.

    Args:
        colors: the spherical harmonics that are drawn, of which `splats` has slices.
    """
    device, asked = splats.means.device, _Asked(rasterizer, splats, colors, camera, depth)
    if not (can_record(device) and hasattr(rasterizer, "over_changing")) or running() is not None:
        return asked.live()
    if device not in _threads.drawings:
        _threads.drawings[device] = _Drawings(device)
    return _threads.drawings[device].draw(asked)


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """What a drawing is made of; see `draw`."""

    rasterizer: Any
    splats: Splats
    colors: Float[Tensor, "N B1 3"]
    camera: Camera
    depth: bool

    @property
    def tensors(self) -> list[Tensor | None]:
        s = self.splats
        return [s.means, s.quats, s.scales, s.opacities, self.colors, s.rgb_offset]

    @property
    def kind(self) -> Kind:
        shapes = tuple(None if x is None else x.shape for x in self.tensors)
        size = self.camera.width, self.camera.height
        return Kind((len(self.splats),), (*shapes, size), (_over_black(self.rasterizer), self.depth))

    def numbers_of(self, camera: Camera) -> Sequence[Tensor]:
        numbers: Sequence[Tensor] = self.rasterizer.numbers_of(camera, self.splats.means.device)
        return numbers

    def live(self) -> Rendering:
        return drawing(self.rasterizer, self.depth)(self.splats, self.camera)


class _RecordedDrawing(Recorded[_Asked, Rendering]):
    """The recordings of both passes of one kind of drawing, and the tensors from which they read what they are given.

    Attributes:
        turn: how often it has been drawn.
    """

    _work: Recording[tuple[Rendering, list[Tensor | None]]]

    def __init__(self, asked: _Asked) -> None:
        device = asked.splats.means.device
        own = [None if x is None else x.clone(memory_format=torch.contiguous_format) for x in asked.tensors]
        means, quats, scales, opacities, colors, offset = own
        splats = Splats(means, quats, scales, opacities, colors[:, :1], colors[:, 1:], offset)  # type: ignore[arg-type, index]
        camera, self._color = replace(asked.camera), asked.rasterizer.background
        self._own, self._numbers = own, asked.numbers_of(camera)
        self._background = sent(torch.tensor([self._color], dtype=torch.float32), device)
        self._cotangent = self._background.new_zeros(1, camera.height, camera.width, 3)
        self.turn = 0
        drawn_by = drawing(asked.rasterizer.over_changing(self._background), asked.depth)

        def forward() -> tuple[Rendering, list[Tensor | None]]:
            r = drawn_by(splats, camera)
            return r, [r.image, r.alpha, r.depth, r.means2d, r.visible]

        with on_side_stream(device):
            forward()[0].vjp(self._cotangent)  # compiles the kernels of the backward pass
        self._work = Recording(device, forward)
        self._back = Recording(device, lambda: self._work.result[0].vjp(self._cotangent))

    def outcome(self, given: _Asked) -> Rendering:
        """See `Recorded`."""
        self.turn += 1
        rendering, made = self._work.result
        return _Replayed(self, given, self.turn, rendering, _copied(made))

    def vjp(self, cotangents: Float[Tensor, "1 H W 3"]) -> SplatGradients:
        """Of what was drawn last."""
        self._cotangent.copy_(cotangents)
        self._back.replay()
        return SplatGradients(*_copied([getattr(self._back.result, name) for name in _GRADIENTS]))

    def _write(self, given: _Asked) -> None:
        write([*self._own, *self._numbers], [*given.tensors, *given.numbers_of(given.camera)])
        if (color := given.rasterizer.background) != self._color:
            self._background.copy_(sent(torch.tensor([color], dtype=torch.float32), self._background.device))
            self._color = color


class _Replayed:
    """A `Rendering` by a replay."""

    def __init__(self, of: _RecordedDrawing, asked: _Asked, turn: int, last: Rendering, made: Sequence[Any]) -> None:
        self.image, self.alpha, self.depth, self.means2d, self.visible = made
        self._of, self._asked, self._turn, self._recorded = of, asked, turn, last
        self.awaits_backward = True

    @property
    def radii(self) -> Int[Tensor, "N 2"]:
        """See `WithRadii`."""
        return cast(WithRadii, self._recorded if self._is_last else self._asked.live()).radii

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], **more: Any) -> SplatGradients:
        """See `Rendering.vjp`, `WithAbsgrad` and `WithDepthGradient`."""
        self.awaits_backward = False
        if self._is_last and len(cotangents) == 1 and not more:
            return self._of.vjp(cotangents)
        gradients: SplatGradients = cast(Any, self._asked.live()).vjp(cotangents, **more)
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

    def draw(self, asked: _Asked) -> Rendering:
        kind = asked.kind
        last = self._last[kind]() if kind in self._last else None
        if last is not None and last.awaits_backward:
            return asked.live()
        self._count += 1
        drawn = self._replays.do(kind, self._count, asked, live=asked.live, record=lambda: _RecordedDrawing(asked))
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


def _copied(made: Sequence[Tensor | None]) -> list[Any]:
    copies = [None if x is None else torch.empty_like(x) for x in made]
    write(copies, made)
    return copies
