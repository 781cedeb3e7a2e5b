"""What the passes of the merge take and return."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.compiled_rules import CorrectionRule
from clear_strategies.core.conflicts import ConflictCounts
from clear_strategies.core.deferred import Number

WIDEST: Final = 45
"""Numbers of a Gaussian in one attribute, at most: three degrees of spherical harmonics."""


FIRST_BANDS: Final = {"sh0": 0, "shN": 1}
"""The first band of the attributes that are spherical harmonics."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """One attribute's gradients, contiguous float32 [N, …]; None is 0.

    Args:
        out: receives the result; it may be `lr`.
        lr: scale · g_LR + before; for sh0 and shN without what `lr_colour` holds of it.
        before: what the gradient was before this backward pass.
        hr: g^HR. None for sh0 and shN: from the colour, if there is one.
        p, anchor: θ and θ^a, for the pull of the anchor.
    """

    out: Tensor
    lr: Tensor | None = None
    before: Tensor | None = None
    hr: Tensor | None = None
    p: Tensor | None = None
    anchor: Tensor | None = None
    stiffness: float = 0.0


class Colour(NamedTuple):
    """A gradient of the spherical harmonics as its factors, Y ⊗ ∇rgb."""

    rgb: Float[Tensor, "N 3"]
    basis: Float[Tensor, "N B1"]


class Merged(NamedTuple):
    """What was counted, and whether every number of the result is finite; on a device it is not known yet."""

    counts: ConflictCounts
    finite: Number


@runtime_checkable
class Merge(Protocol):
    """Merges the attributes, and writes `out` of each."""

    def __call__(
        self, attributes: Mapping[str, Rows], rule: CorrectionRule | None, q: Float[Tensor, " N"] | None, *,
        lr_colour: Colour | None = None, colour: Colour | None = None,
        keeps_lr: bool = True, lambda_hr: float = 1.0, scale: float = 1.0,
    ) -> Merged:  # fmt: skip
        """
        Args:
            attributes: by gsplat's names, and "detail", which is compared with nothing.
            rule: None: nothing is corrected. q: reliability; None: 0.
            lr_colour: of scale · g_LR, and colour: of g^HR.
            keeps_lr: False: out is ĝ_HR alone.
            lambda_hr: 0: neither compared nor added.
        """
        ...
