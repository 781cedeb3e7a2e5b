"""Priors with seeded wrong detail, to study what a hallucinating SR model does.

A fidelity network agrees with its LR image nearly everywhere, so P2G's reliability finds nothing there. A generative
network invents detail: plausible in each view, different between views. `SeededErrors` puts such errors into a share of
an image's patches; `Corrupted` applies them to another prior's SR images, `DemoPrior` to the true HR photos.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.data.priors.interface import Prior, cached
from clear_strategies.errors import DataError

_ROUNDS: Final = 20  # of back-projection: the LR pixels then agree to less than a grey level


@dataclass(frozen=True, slots=True, kw_only=True)
class SeededErrors:
    """Errors that are a function of (seed, name of the view).

    Args:
        share: share of the patches that get errors, in [0, 1].
        strength: strength of the errors, >= 0; 0: none.
        patch: edge of a patch, HR px; 64 is the patch of P2G's reliability.
        seed: seed of the errors, independent of the run's.
        hidden: keep only the part of the errors that the LR photo cannot show: reduced, wrong patches equal right ones, so
            that no comparison with the photo finds them.

    Raises:
        SettingError: a number is outside its range.
    """

    share: float = 0.3
    strength: float = 1.0
    patch: int = 64
    seed: int = 0
    hidden: bool = False

    def __post_init__(self) -> None:
        require_number("prior.share", self.share, least=0, most=1)
        require_number("prior.strength", self.strength, least=0)
        require_whole("prior.patch", self.patch, least=1)
        require_whole("prior.seed", self.seed, least=0)

    def corrupt(
        self, image: Float[Tensor, "H W 3"], lr: Float[Tensor, "h w 3"], factor: int, name: str
    ) -> Float[Tensor, "H W 3"]:
        """`image` with errors in `share` of its patches.

        Two kinds of error nearly agree with LR and contradict the other views: negated detail, and detail from
        elsewhere in the image. The other two disagree with LR, which reliability measures: doubled content, and
        sharpened content of another shade.
        """
        rng = np.random.default_rng([self.seed, *name.encode()])
        shift = (rng.integers(2, max(factor, 2) + 1, 2) * rng.choice((-1, 1), 2)).tolist()
        corners = list(itertools.product(*(range(0, size, self.patch) for size in image.shape[:2])))
        detail = image - images.upsample(lr, factor)
        errors = (
            -1.4 * detail,
            detail.flip(0, 1) - detail,
            0.6 * (image.roll(shift, (0, 1)) - image),
            0.8 * detail,  # and a shade, different in each patch, below
        )
        result, touched = image.clone(), torch.zeros_like(image[..., :1])
        for which in rng.permutation(len(corners))[: round(self.share * len(corners))]:
            kind, shade = int(rng.integers(len(errors))), torch.from_numpy(rng.uniform(-0.12, 0.12, 3))
            top, left = corners[which]
            box = (slice(top, top + self.patch), slice(left, left + self.patch))
            result[box] += self.strength * (errors[kind][box] + (shade.to(image) if kind == len(errors) - 1 else 0))
            touched[box] = 1
        if self.hidden:
            result = images.back_projected(result, images.downsample(image, factor), factor, _ROUNDS, where=touched)
        return images.quantize(result)


@dataclass(frozen=True, slots=True)
class Corrupted(SeededErrors):
    """Adds seeded errors to another prior's SR images. Reports mark such runs as synthetic."""

    prior: Prior

    def __post_init__(self) -> None:
        SeededErrors.__post_init__(self)
        object.__setattr__(self, "prior", cached(self.prior))

    @property
    def label(self) -> str:
        return f"{self.prior.label} (synthetic: seeded errors in {self.share:.0%} of the patches)"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        return self.corrupt(self.prior(name, lr, factor), lr, factor, name)


@dataclass(frozen=True, slots=True, eq=False)
class DemoPrior(SeededErrors):
    """The true HR photos with seeded errors: the demo's prior, for any scene whose photos are HR."""

    truth: Mapping[str, Callable[[], Float[Tensor, "H W 3"]]]  # by the views' names

    @property
    def label(self) -> str:
        return f"demo (synthetic: truth with seeded errors in {self.share:.0%} of the patches)"

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        truth, height, width = self.truth[name]().to(lr), lr.shape[0] * factor, lr.shape[1] * factor
        if truth.shape[:2] != (height, width):
            problem = f"is {truth.shape[1]}x{truth.shape[0]} where HR is {width}x{height}"
            remedy = "use photos that are HR (data.views.photos_are=hr), or another prior"
            raise DataError(name, "truth", problem, remedy)
        return self.corrupt(truth, lr, factor, name)
