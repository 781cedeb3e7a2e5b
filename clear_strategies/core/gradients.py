"""Per-Gaussian gradients by attribute, their row algebra, and the rendering as strategies use it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.core.deferred import Number
from rasterizers.interface import SplatGradients

PARAMETERS: Final = ("means", "quats", "scales", "opacities", "sh0", "shN")
"""gsplat's names for the raw parameters (log scales, logit opacities)."""

ATTRIBUTES: Final = (*PARAMETERS, "detail")
"""The parameters, and the detail feature f_det."""

CONFLICT_GROUPS: Final = ("means", "sh0", "shN", "opacities", "scales", "quats")
"""The paper's six: position, base appearance, higher-order appearance, opacity, scale, rotation."""


class Colour(NamedTuple):
    """A gradient of the spherical harmonics as its factors, Y ⊗ ∇rgb: per Gaussian three numbers and Y, instead of 48 numbers.

    Args:
        basis: Y of the active bands of each Gaussian, from the camera that drew it.
    """

    rgb: Float[Tensor, "N 3"]
    basis: Float[Tensor, "N B1"]


class Grads(dict[str, Tensor]):
    """attribute -> gradient [N, …] of one loss, with + and * by a number or by one number per Gaussian [N].

    An absent attribute has gradient 0. Arithmetic is by name alone: its results have neither `colour` nor `screen`.

    Attributes:
        colour: the gradient of sh0 and shN as factors, in addition to what they have by name; None: there is none.
        screen: the gradient of the projected centre [N, 2], 1/pixel; a statistic, not the gradient of a parameter.
    """

    screen: Float[Tensor, "N 2"] | None
    colour: Colour | None

    def __init__(
        self, values: Mapping[str, Tensor] | None = None, *, colour: Colour | None = None, screen: Tensor | None = None
    ) -> None:
        super().__init__(values or {})
        self.colour, self.screen = colour, screen

    @property
    def tensors(self) -> Mapping[str, Tensor]:
        """The tensors that must be finite before a step, by name. Y, a third of the numbers, is finite for drawn Gaussians."""
        return self if self.colour is None else {**self, "rgb": self.colour.rgb}

    def __add__(self, other: Mapping[str, Tensor]) -> Grads:
        return self.plus(other, 1.0)

    def plus(self, other: Mapping[str, Tensor], weight: float | Float[Tensor, " N"]) -> Grads:
        """The sum with another, each of whose rows counts `weight` times."""
        total = Grads(self)
        for name, value in other.items():
            rows = weight.to(value).view(-1, *[1] * (value.dim() - 1)) if isinstance(weight, Tensor) else weight
            if name not in total:
                total[name] = value * rows
            elif isinstance(rows, Tensor):
                total[name] = torch.addcmul(total[name], value, rows)
            else:
                total[name] = torch.add(total[name], value, alpha=rows)
        return total

    def __mul__(self, weight: float | Float[Tensor, " N"]) -> Grads:
        return Grads().plus(self, weight)

    __rmul__ = __mul__

    def without_detail(self) -> Grads:
        """The same without f_det, which is never corrected."""
        kept = {name: value for name, value in self.items() if name != "detail"}
        return Grads(kept, colour=self.colour, screen=self.screen)


@dataclass(frozen=True, slots=True, eq=False)
class ScreenGradients:
    """∇_u of the three losses, [N, 2], in NDC units (pixel gradient × W/2, H/2 of its own image).

    Args:
        base, hf: None while HR is not rendered; hf is also None when λ_HF = 0.
        ordinary: ‖∇_u(L_LR + λ_HR(L_base + λ_HF L_HF))‖, the statistic of 3DGS.
    """

    lr: Float[Tensor, "N 2"]
    base: Float[Tensor, "N 2"] | None
    hf: Float[Tensor, "N 2"] | None
    ordinary: Float[Tensor, " N"]


def gradients_of(g: SplatGradients) -> list[Grads]:
    """The gradients of the drawn splats, one for each cotangent, with the colours' gradient as factors. From
    `SplatGradients.summed` it makes what `summed` returns.
    """
    basis, n = g.basis.contiguous(), len(g.means)
    rows = (g.means, g.quats, g.scales, g.opacities, g.rgb[:n], g.screen[:n])
    each = [
        Grads(
            {name: x.contiguous() for name, x in zip(PARAMETERS[:4], drawn, strict=True)},
            colour=Colour(rgb.contiguous(), basis), screen=screen,
        )
        for *drawn, rgb, screen in zip(*(x.unbind() for x in rows), strict=True)
    ]  # fmt: skip
    last = zip(g.rgb[n:], g.screen[n:], strict=True)
    return each + [Grads({"detail": rgb.contiguous()}, screen=screen) for rgb, screen in last]


def summed(each: Sequence[Grads], weight: Float[Tensor, " N"]) -> list[Grads]:
    """The last gradient times `weight`, row by row, is added to the one before, which keeps its `screen`.  Eq. 13

    The last keeps its `screen` and `weight` times its gradient of f_det, the only gradient that f_det gets.
    """
    *others, base, hf = each
    total = base.without_detail().plus(hf.without_detail(), weight)  # Eq. 13
    total.screen = base.screen
    detail = Grads({name: g for name, g in hf.items() if name == "detail"}) * weight
    detail.screen = hf.screen
    return [*others, total, detail]


@runtime_checkable
class Shot(Protocol):
    """A rendering of one view, with its VJP; strategies, objective and hosts use no other type."""

    @property
    def image(self) -> Float[Tensor, "H W 3"]: ...

    @property
    def means2d(self) -> Float[Tensor, "N 2"]:
        """Projected centres, pixels of this image."""
        ...

    @property
    def visible(self) -> Bool[Tensor, " N"]: ...

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        """∇θ of Σ cotangent·image on the raw parameters, one per cotangent, each with `.screen`.

        Args:
            weight: the last gradient times this is added to the one before, see `summed`; None: nothing is added. A shot of
                your own may lack the argument.
        """
        ...


def in_our_shapes(tensors: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """The same tensors by attribute, with opacities as [N], which 3DGS and nerfstudio keep as [N, 1]."""
    o = tensors.get("opacities")
    return tensors if o is None or o.shape[1:] != (1,) else Grads({**tensors, "opacities": o[:, 0]})


def gathered(rows: Float[Tensor, "N ..."], parents: Int[Tensor, " M"]) -> Float[Tensor, "M ..."]:
    """Row i is a copy of row parents[i]. If the number of rows stays, so does the memory, and recordings that read it hold."""
    chosen = rows.index_select(0, parents)
    return rows.copy_(chosen) if len(rows) == len(parents) else chosen


def conflict_columns(conflict: Mapping[str, Number]) -> dict[str, Number]:
    """The shares by their column in the history: "conflict" of Gaussians, "conflict_means" … of groups."""
    return {("conflict" if group == "gaussian" else f"conflict_{group}"): share for group, share in conflict.items()}


def to_ndc(screen: Float[Tensor, "N 2"], size: tuple[int, int]) -> Float[Tensor, "N 2"]:
    """∇_u in NDC from ∇_u in pixels of an image of `size` (width, height)."""
    return screen * _half(size, screen.dtype, screen.device)


@lru_cache(maxsize=64)
def _half(size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Float[Tensor, " 2"]:
    """Half the size of an image, written on the device: for a copy from the CPU the host would wait."""
    return torch.cat([torch.full((1,), pixels / 2, dtype=dtype, device=device) for pixels in size])


def screen_of(g: Grads) -> Float[Tensor, "N 2"]:
    """`g.screen`, which must be there."""
    if g.screen is None:
        raise ValueError("a Shot's vjp() must set .screen on every Grads it returns.")
    return g.screen


def screen_norm(screen: Float[Tensor, "N 2"]) -> Float[Tensor, " N"]:
    """‖∇_u‖₂. torch's own norm over rows of two numbers takes five times as long on a CPU.

    Squared in units of 2⁻²⁰: many gradients of a large image lie below 1e-19, and the root of a subnormal square takes thirty
    times as long as another.
    """
    squares = (screen * 2.0**20).square_()
    return (squares[:, 0] + squares[:, 1]).sqrt_().mul_(2.0**-20)
