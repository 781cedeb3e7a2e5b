"""The tensors of a drawing, as a loop has them."""

from __future__ import annotations

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from rasterizers.interface import Splats


class Inputs(NamedTuple):
    """The tensors of a drawing. The colours are one tensor, as in hosts: for the gradient of a slice, autograd would fill another
    tensor of that size with zeros.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    colors: Float[Tensor, "N K 3"]
    rgb_offset: Float[Tensor, "N 3"] | None

    def drawn(self, bands: int | None = None) -> Inputs:
        """The same without their autograd graph.

        Args:
            bands: the number of bands of the colours to keep; None: all.
        """
        means, quats, scales, opacities, colors, offset = (x if x is None else x.detach() for x in self)
        return Inputs(means, quats, scales, opacities, colors[:, :bands], offset)  # type: ignore[arg-type, index]

    def attributes(self) -> dict[str, Tensor]:
        """All but the offset, by name."""
        return {name: x for name, x in self._asdict().items() if name != "rgb_offset"}

    def splats(self, bands: int | None = None) -> Splats:
        """`drawn`, as `Splats`."""
        means, quats, scales, opacities, colors, offset = self.drawn(bands)
        return Splats(means, quats, scales, opacities, colors[:, :1], colors[:, 1:], offset)
