"""Wrong detail on purpose: what a hallucinating SR model does, with a seed, so that it can be studied.

A fidelity network agrees with its LR image nearly everywhere, so reliability has nothing to find there. Generative ones
invent: differently in each view, plausibly in themselves. `corrupted` puts such errors into a share of the patches of any
reference; `Corrupted` does it to the pictures of another prior.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.priors.upscale import Prior, cached


@dataclass(frozen=True, slots=True)
class Corrupted:
    """Another prior's pictures with seeded errors that differ from view to view. Reports call it synthetic.

    Args:
        prior: whose pictures. share: of the patches with errors, in [0, 1]. strength: of the errors, >= 0.
        patch: edge of a patch, HR px; 64 is what P2G's reliability looks at.

    Raises:
        ValueError: a number is outside its range.
    """

    prior: Prior
    share: float = 0.3
    strength: float = 1.0
    patch: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        require_errors(self.share, self.strength, self.patch)
        object.__setattr__(self, "prior", cached(self.prior))

    @property
    def label(self) -> str:
        return f"{self.prior.label} (synthetic: seeded errors in {self.share:.0%} of the patches)"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        honest = self.prior(name, lr, factor)
        return corrupted(honest, lr, factor, name, self.share, self.strength, self.patch, self.seed)


def require_errors(share: float, strength: float, patch: int) -> None:
    """The ranges of `corrupted`'s numbers.

    Raises:
        ValueError: a number is outside its range.
    """
    if not 0 <= share <= 1:
        raise ValueError(f"share must lie in [0, 1], got {share}.")
    if not strength >= 0 or patch < 1:
        raise ValueError(f"strength must be >= 0 and patch >= 1, got {strength} and {patch}.")


def corrupted(
    reference: Float[Tensor, "H W 3"],
    lr: Float[Tensor, "h w 3"],
    factor: int,
    name: str,
    share: float,
    strength: float,
    patch: int,
    seed: int,
) -> Float[Tensor, "H W 3"]:
    """`reference` with errors in `share` of its patches; a function of (seed, name).

    The detail is turned over, or taken from elsewhere in the picture (both nearly agree with LR and fight the other
    views); or the content is doubled, or sharpened and of another shade (both disagree with LR, which reliability sees).
    """
    rng = np.random.default_rng([seed, *name.encode()])
    detail = reference - images.upsample(lr, factor)
    shift = rng.integers(2, max(factor, 2) + 1, 2) * rng.choice((-1, 1), 2)
    errors = (
        -1.4 * detail,
        detail.flip(0, 1) - detail,
        0.6 * (reference.roll(shift.tolist(), (0, 1)) - reference),
        0.8 * detail,  # and a shade of its own in each patch, below
    )
    corners = list(itertools.product(*(range(0, size, patch) for size in reference.shape[:2])))
    result = reference.clone()
    for which in rng.permutation(len(corners))[: round(share * len(corners))]:
        top, left = corners[which]
        box = (slice(top, top + patch), slice(left, left + patch))
        kind, shade = rng.integers(len(errors)), torch.from_numpy(rng.uniform(-0.12, 0.12, 3)).to(reference)
        result[box] += strength * (errors[kind][box] + (shade if kind == len(errors) - 1 else 0))
    return images.quantize(result)
