"""One camera's picture as gsplat's `rasterization` makes it, three channels at a time.

The first three are the spherical harmonics, or the first of the colours; every other channel is a number of each Gaussian. Depth
is drawn with the first three, or, by a backend without the trait `depth_gradient`, as two more channels: the depth of the centre,
and the 1 whose picture is alpha.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from rasterizers.differentiable import Drawing, in_graph, render
from rasterizers.geometry import constant_band, depths
from rasterizers.inputs import Inputs
from rasterizers.interface import Camera, Rasterizer, over


@dataclass(frozen=True, slots=True)
class Part:
    """Three channels: a picture of low + span · what was drawn.

    Args:
        keeps: how many of the three are wanted.
    """

    drawing: Drawing
    low: float = 0.0
    span: float = 1.0
    keeps: int = 3

    def picture(self, drawn: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W C"]:
        """The channels that are wanted, in the range of their colours."""
        image = drawn if (self.low, self.span) == (0.0, 1.0) else self.low + self.span * drawn
        return image if self.keeps == 3 else image[..., : self.keeps]


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """The picture of one camera.

    Args:
        inputs, sh_degree, background, render_mode: as of `as_gsplat.rasterization`, for one scene and camera.
        replays: see `differentiable.render`.
    """

    rasterizer: Rasterizer
    camera: Camera
    pose: Float[Tensor, "4 4"]
    inputs: Inputs
    sh_degree: int | None
    background: Float[Tensor, " D"] | None
    render_mode: str
    replays: bool

    def parts(self) -> list[Part]:
        """Draw the channels."""
        found: list[Part] = []
        means, colors, wants_depth = self.inputs.means, self.inputs.colors, self.render_mode != "RGB"
        depth = wants_depth and self.rasterizer.traits.depth_gradient  # with the first of the parts
        wants_colors = "RGB" in self.render_mode
        behind = self.background.tolist() if wants_colors and self.background is not None else []
        if wants_colors and self.sh_degree is not None:
            found.append(self._drawn(self.inputs, (self.sh_degree + 1) ** 2, behind or [0.0] * 3, depth=depth))
        elif wants_colors:
            for first in range(0, colors.shape[-1], 3):
                three = slice(first, first + 3)
                found.append(self._channels(colors[:, three], behind[three], depth=depth and not found))
        elif depth:
            found.append(self._channels(means.new_zeros(len(means), 0), depth=True))
        if wants_depth and not depth:
            z = depths(means, self.pose.to(means)).clamp_min(0)  # behind the camera nothing is drawn
            found.append(self._channels(torch.stack((z, torch.ones_like(z)), 1)))
        return found

    def picture(
        self, parts: Sequence[Part], means2d: Tensor, rows: Int[Tensor, " M"] | None, absgrad: Tensor | None
    ) -> tuple[Float[Tensor, "H W X"], Float[Tensor, "H W"]]:
        """The picture, and its alpha."""
        drawn = [in_graph(part.drawing, means2d, rows, pose=self.pose, absgrad=absgrad) for part in parts]
        pictures = [part.picture(one.image) for part, one in zip(parts, drawn, strict=True)]
        alpha, depth = drawn[0].alpha, drawn[0].depth
        if self.render_mode != "RGB":
            if depth is None:
                accumulated, alpha = pictures.pop().unbind(-1)  # with exact gradients
                depth = accumulated / alpha.clamp_min(1e-10)
            pictures.append((depth if "ED" in self.render_mode else depth * alpha)[..., None])
        image = pictures[0] if len(pictures) == 1 else torch.cat(pictures, -1)
        background = self.background
        if background is not None and background.requires_grad and "RGB" in self.render_mode:
            through = (1 - alpha.detach())[..., None] * (background - background.detach())  # 0, for its gradient
            image = image + pad(through, (0, image.shape[-1] - through.shape[-1]))
        return image, alpha

    def _channels(self, colors: Float[Tensor, "N C"], behind: Sequence[float] = (), *, depth: bool = False) -> Part:
        """Draw at most three channels, of any range, over black where `behind` gives no number."""
        keeps, behind = colors.shape[1], [*behind, *[0.0] * (3 - len(behind))]
        colors = pad(colors, (0, 3 - keeps))
        low, span = _low_and_span(colors, behind)
        inputs = self.inputs._replace(colors=constant_band((colors - low) / span), rgb_offset=None)
        part = self._drawn(inputs, 1, [(x - low) / span for x in behind], depth=depth)
        return replace(part, low=low, span=span, keeps=keeps)

    def _drawn(self, inputs: Inputs, bands: int, behind: Sequence[float], *, depth: bool) -> Part:
        rasterizer = over(self.rasterizer, cast(Any, tuple(behind)))
        return Part(render(rasterizer, inputs, bands, self.camera, depth=depth, replays=self.replays))


def _low_and_span(colors: Float[Tensor, "N 3"], background: Sequence[float]) -> tuple[float, float]:
    """RGB in any range is drawn as (RGB - low) / span, with colours >= 0 over a background in [0, 1].

    The weights of a pixel's colours and background sum to 1, so the image is low + span times what is drawn. A span below 1, a
    power of two, keeps the digits of small colours: `constant_band` adds numbers near 1/2.
    """
    finite = colors.detach().nan_to_num(0, 0, 0)  # NaN is refused by the rasterizer
    least, most = (float(x) for x in finite.aminmax()) if finite.numel() else (0.0, 0.0)
    low = min(0.0, least, *background)
    power = 2.0 ** max(math.frexp(max(most, *background) - low)[1], -126)
    return low, max(min(1.0, power), max(background) - low)
