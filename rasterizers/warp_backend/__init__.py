"""The backend "warp": NVIDIA Warp kernels, compiled at first use from one source for CUDA and for the CPU, in float32.

The stages have the names of `rasterizers.reference`: project, bin, blend, and their VJPs. Warp is imported when a rasterizer
is constructed; `frame` launches the kernels; the other files hold the kernels, with VJPs written by hand.

Deterministic: every sum has a fixed order, and there are no floating-point atomics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from rasterizers.backend import Backend
from rasterizers.interface import Camera, Color, Rendering, Splats, Traits
from rasterizers.sending import color_on
from rasterizers.warp_backend.sizes import mebibytes
from rasterizers.warp_runtime import require_warp

_TRAITS: Final = {
    device: Traits(devices=frozenset({device}), dtypes=frozenset({torch.float32}), depth=True, absgrad=True, radii=True)
    for device in ("cpu", "cuda")
}


@dataclass(frozen=True, slots=True)
class WarpRasterizer(Backend):
    """Warp kernels for CUDA; the same kernels run on a CPU, slowly, to check them.

    Args:
        memory: MiB that one image's lists may take, together with the sums that their pairs send back.
        device: "cuda" or "cpu", where the splats' tensors are; by default "cuda" where there is one.
        capacities: the number of pairs to allocate for the next image of each size, from the images before it.
        changing: see `over_changing`.

    Raises:
        BackendUnavailable: Warp is not installed, or there is no CUDA device.
        ValueError: a setting is out of range; or splats are not finite, when the image is first read.
    """

    memory: int = 4096
    device: str = field(default_factory=lambda: "cuda" if torch.cuda.is_available() else "cpu")
    capacities: dict[tuple[int, int], int] = field(default_factory=dict, init=False, repr=False, compare=False)
    changing: Tensor | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        Backend.__post_init__(self)
        if self.memory < 1:
            raise ValueError(f"memory must be at least 1 MiB, got {self.memory}.")
        if self.device not in _TRAITS:  # without a number: splats are drawn on the device they are on
            raise ValueError(f"device must be cpu or cuda, got {self.device!r}.")
        require_warp("the warp rasterizer", self.device, "device=cpu runs here, slowly")

    @property
    def traits(self) -> Traits:
        return _TRAITS[self.device]

    def draw(self, jobs: Sequence[tuple[Splats, Camera]], depth: Sequence[bool]) -> list[Rendering]:
        """Jobs of one pose share colour and depth order."""
        from rasterizers.warp_backend.frame import WarpFrame

        return [*WarpFrame(self, jobs, depth).draw()]

    def numbers_of(self, camera: Camera, device: torch.device) -> Sequence[Tensor]:
        """See `rasterizers.interface.Recordable`."""
        from rasterizers.warp_backend.frame import numbers_of

        return numbers_of(camera, device)

    def with_background(self, background: Color) -> WarpRasterizer:
        """A copy with another background and the same `capacities`: the number of pairs does not depend on the background."""
        copied = replace(self, background=background)
        object.__setattr__(copied, "capacities", self.capacities)
        return copied

    def over_changing(self, background: Float[Tensor, "1 3"]) -> WarpRasterizer:
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
