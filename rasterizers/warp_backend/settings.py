"""The settings of the Warp backend, and its memory budget."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.checks import Backend, require_device
from rasterizers.interface import Camera, Color, Traits
from rasterizers.sending import color_on
from rasterizers.warp_runtime import require_warp

TILE: Final = 8
"""Edge of the tiles that Gaussians are listed for, px."""
SEGMENT: Final = 64
"""The most pairs that one thread, or one block of threads, goes through in turn: some tiles' lists and some Gaussians' are
a hundred times as long as the others'."""
PAIR_BYTES: Final = (
    40  # tile and place, twice for the sort, the Gaussian, before and after it, and a share of the marks
)
SUMS_BYTES: Final = 36  # a pair's nine sums for one cotangent


_TRAITS: Final = {
    device: Traits(devices=frozenset({device}), dtypes=frozenset({torch.float32}), depth=True, absgrad=True, radii=True)
    for device in ("cpu", "cuda")
}


def _default_device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True, slots=True)
class WarpSettings(Backend):
    """The settings of `WarpRasterizer`, apart from its class, because `frame` needs them and that class needs `frame`.

    Args:
        memory: MiB that one image's lists may take, together with the sums that their pairs send back.
        device: "cuda" or "cpu", where the splats' tensors are; by default "cuda" where there is one.
        capacities: the number of pairs to allocate for the next image of each size, from the images before it.
        changing: see `over_changing`.

    Raises:
        BackendUnavailable: Warp is not installed, or there is no CUDA device.
        ValueError: a setting is out of range.
    """

    memory: int = 4096
    device: str = field(default_factory=_default_device)
    capacities: dict[tuple[int, int], int] = field(default_factory=dict, init=False, repr=False, compare=False)
    changing: Tensor | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        Backend.__post_init__(self)
        if self.memory < 1:
            raise ValueError(f"memory must be at least 1 MiB, got {self.memory}.")
        require_device(self.device)
        require_warp("the warp rasterizer", self.device, "device=cpu runs here, slowly")

    @property
    def traits(self) -> Traits:
        return _TRAITS[self.device]

    def with_background(self, background: Color) -> WarpSettings:
        """A copy with another background and the same `capacities`: the number of pairs does not depend on the background."""
        copied = replace(self, background=background)
        object.__setattr__(copied, "capacities", self.capacities)
        return copied

    def over_changing(self, background: Float[Tensor, "1 3"]) -> WarpSettings:
        """As `with_background`, for a background on the device that is another one in each replay of a recording."""
        copied = self.with_background(self.background)
        object.__setattr__(copied, "changing", background)
        return copied

    def background_on(self, device: torch.device) -> Float[Tensor, "1 3"]:
        return color_on(self.background, device) if self.changing is None else self.changing

    def capacity(self, camera: Camera) -> int:
        """The number of pairs to allocate for an image of this size before they are counted; -1: it is the first one."""
        return self.capacities.get((camera.width, camera.height), -1)

    def remember(self, camera: Camera, pairs: int) -> None:
        """Set the capacity to a quarter more than an image needed; the capacity shrinks slowly if later ones need less."""
        capacity = max(pairs + pairs // 4, self.capacity(camera) * 63 // 64)
        self.capacities[camera.width, camera.height] = capacity if self.allows(capacity) else pairs

    def allows(self, pairs: int) -> bool:
        """Return True if the lists of this many pairs, which are counted in 32 bits, fit the budget."""
        return mebibytes(pairs) <= self.memory and pairs < 2**31


def padded(count: int) -> int:
    """The next power of two, so that torch's allocator reuses memory from the last image."""
    return 1 << max(0, count - 1).bit_length()


def mebibytes(pairs: int) -> int:
    """Memory of the pairs' lists and of their sums for one cotangent."""
    return padded(pairs) * (PAIR_BYTES + SUMS_BYTES) >> 20
