"""Density control as Markov chain Monte Carlo (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Gaussians of low opacity are relocated to others, the field grows by copies of Gaussians, both sampled by opacity, and noise is
added to the positions of faint ones. There is no threshold for splitting, and no reset of opacities.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.finite import require_finite
from clear_strategies.core.seeds import hashed_generator_at
from clear_strategies.core.view import View
from clear_strategies.errors import DensityError
from clear_strategies.geometry.photos import cut_out
from clear_strategies.kernels import per_gaussian
from clear_strategies.schedules import LogLinear, milestone
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.densifier import Densifier
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_MOST_COPIES: Final = 51  # the paper's largest number of Gaussians that one becomes in a round
_BINOMIALS: Final = torch.tensor(
    [[math.comb(n, j) for j in range(_MOST_COPIES + 1)] for n in range(_MOST_COPIES + 1)], dtype=torch.float64
)
_DENSE: Final = 4.0  # LR px between initial points, up to which their number is a measure of the surface
_WHOLE: Final = 2**30  # fixed-point value of 1: sums of the weights of 2²³ Gaussians are exact in float64
_SHORT_RUN: Final = 750  # the least `stop`, that of 1,500 iterations; shorter runs gain more by density control
_GATE: Final = 100.0  # slope of the noise's gate σ(100 (dead_opacity - o))
_STILL: Final = 1e-4  # value of the gate, reached at opacities above 0.1, below which no noise is added


@dataclass(frozen=True)
class MCMC(Strategy):
    """Relocates and adds Gaussians by sampling, and adds noise to faint ones, in place of `density`.

    Args:
        start: relocation and growth begin after this iteration.
        stop: the first iteration without relocation, growth and noise. SVS takes its anchor then.
        every: iterations between rounds of relocation and growth.
        growth: the share of Gaussians that a round adds, up to the cap.
        per_point: the cap, as a multiple of the initial number of Gaussians, one for each initial point.
        max_gaussians: the largest cap.
        min_gaussians: having fewer Gaussians above `dead_opacity` is an error, unless all are.
        dead_opacity: Gaussians of at most this opacity are relocated.
        noise: strength of the noise. A Gaussian of covariance Σ moves by noise(t) σ(100 (dead_opacity - opacity)) Σ η / s̃ after
            each iteration until `stop`, with η ~ N(0, I) and s̃ the median of the Gaussians' largest scales; 0: none moves.
        cooling: noise(t) / noise, which falls as the learning rate of the positions does.

    Raises:
        SettingError: a setting is outside its range.
    """

    start: int = milestone(500)
    stop: int = milestone(5_000)
    every: int = milestone(100, least=1)
    growth: float = 0.05
    per_point: float = 5.0
    max_gaussians: int = 1_000_000
    min_gaussians: int = 10
    dead_opacity: float = 0.005
    noise: float = 500.0
    cooling: LogLinear = field(default_factory=lambda: LogLinear(initial=1.0, final=0.01))

    def __post_init__(self) -> None:
        for name in ("every", "max_gaussians", "min_gaussians"):
            require_whole(name, getattr(self, name), least=1)
        for name, least in (("growth", 0), ("per_point", 1), ("noise", 0)):
            require_number(name, getattr(self, name), least=least)
        require_number("dead_opacity", self.dead_opacity, above=0, below=1)

    def densifier(self, field: GaussianField, views: Sequence[View], seed: int) -> Sampler | None:
        """Make the sampler; None, with the reason in the log, if sampling would not help."""
        if self.stop < _SHORT_RUN:
            reason = (
                f"it needs {2 * _SHORT_RUN:,} iterations or more, {_SHORT_RUN} of them for sampling, and in this run sampling "
                f"stops at iteration {self.stop}"
            )
        elif cut_out((view.lr for view in views), views[0].background):
            reason = (
                "the photos show an object before a plain background, where few Gaussians are invisible in all photos"
            )
        elif (spacing := _spacing(field, [view.lr.camera for view in views])) > _DENSE:
            reason = (
                f"the initial points lie {spacing:.1f} LR pixels apart, more than {_DENSE:g}. data.cloud.init=stereo makes "
                "denser ones"
            )
        else:
            return Sampler(self, len(field), seed=seed)
        _log.info("mcmc is off: %s.", reason)
        return None


class Sampler(Densifier):
    """Relocates and adds Gaussians by sampling; a step is a function of the field, (seed, t) and the cap.

    Args:
        n: Gaussians at the start.
    """

    name = "MCMC"

    def __init__(self, settings: MCMC, n: int, *, seed: int) -> None:
        self.settings: MCMC = settings
        self.seed = seed
        self.cap: int = min(settings.max_gaussians, math.ceil(settings.per_point * n))

    def collects(self, t: int) -> bool:
        return False

    def due(self, t: int) -> bool:
        """Return True if Gaussians are relocated and added at t."""
        s = self.settings
        return s.start < t < s.stop and t % s.every == 0

    def settled(self, t: int) -> bool:
        return t >= self.settings.stop

    def step(self, field: GaussianField, optimizer: Adam, t: int, resized: Callable[[Int[Tensor, " M"]], None]) -> bool:
        if t >= self.settings.stop:
            return False
        generator = hashed_generator_at(self.seed, t, field.means.device)
        parents = self._round(field, optimizer, t, generator) if self.due(t) else None
        if parents is not None:
            resized(parents)
        if self.settings.noise > 0:
            self._add_noise(field, t, generator)
        return parents is not None

    def _round(
        self, field: GaussianField, optimizer: Adam, t: int, generator: torch.Generator
    ) -> Int[Tensor, " M"] | None:
        """Relocate Gaussians of low opacity and add copies; returns parents [M], or None if nothing changes."""
        s, n = self.settings, len(field)
        require_finite(f"t={t}: before densification, the parameter", field.raw(), waits=True)
        opacities = field.opacities.data.sigmoid()
        live = opacities > s.dead_opacity
        dead = torch.nonzero(~live)[:, 0]
        if n - len(dead) < min(s.min_gaussians, n):
            raise DensityError(
                f"t={t}: {n - len(dead)} of {n:,} Gaussians have an opacity above {s.dead_opacity}, fewer than "
                f"min_gaussians={s.min_gaussians}. Lower strategies.mcmc.dead_opacity, or start from a denser cloud."
            )
        added = max(0, min(self.cap, math.floor((1 + s.growth) * n)) - n)
        if len(dead) + added == 0:
            return None
        sources = drawn(opacities * live, len(dead) + added, generator)
        parents = torch.cat((torch.arange(n, device=sources.device), sources[len(dead) :]))
        parents[dead] = sources[: len(dead)]
        copies = torch.bincount(parents, minlength=n)[parents]
        shared = copies > 1  # sources and their copies, whose moments in Adam are reset
        field.take(parents)
        optimizer.take(parents, shared)
        o, scales = relocation(field.opacities.data[shared].sigmoid(), field.scales.data[shared].exp(), copies[shared])
        field.opacities.data[shared] = torch.logit(o.clamp(s.dead_opacity, 1 - torch.finfo(o.dtype).eps))
        field.scales.data[shared] = scales.log()
        _log.debug("t=%d: %d moved, %d added: %d -> %d Gaussians.", t, len(dead), added, n, len(parents))
        return parents

    def _add_noise(self, field: GaussianField, t: int, generator: torch.Generator) -> None:
        """Add noise to the positions, see `MCMC.noise`."""
        s, means, quats, scales = self.settings, field.means.data, field.quats.data, field.scales.data
        gate = torch.sigmoid(_GATE * (s.dead_opacity - field.opacities.data.sigmoid()))
        on_cpu = gate.device.type == "cpu"  # on CUDA, `nonzero` would wait for the device
        rows = torch.nonzero(gate > _STILL)[:, 0] if on_cpu else torch.arange(len(field), device=gate.device)
        eta = torch.randn(len(rows), 3, generator=generator, device=gate.device)
        per_gaussian.wander(means, quats, scales, gate, rows, eta, s.noise * s.cooling(t))

    def state_dict(self) -> dict[str, Tensor]:
        return {"cap": torch.tensor(self.cap)}

    def load_state_dict(self, tensors: dict[str, Tensor]) -> None:
        self.cap = int(tensors["cap"])


def drawn(weights: Float[Tensor, " N"], n: int, generator: torch.Generator) -> Int[Tensor, " n"]:
    """Sample n rows with replacement, with probabilities proportional to the weights in [0, 1].

    Unlike in `torch.multinomial`, weights are summed as integers, so that the order of addition on a GPU does not matter.
    """
    sums = (weights.double() * _WHOLE).long().cumsum(0)
    at = torch.rand(n, generator=generator, device=weights.device, dtype=torch.float64) * sums[-1]
    return torch.searchsorted(sums, at.long(), right=True)


def _spacing(field: GaussianField, cameras: Sequence[Camera]) -> float:
    """The median distance between initial points, in pixels of the camera that resolves each point best."""
    centers = torch.stack([camera.center.to(field.means.data) for camera in cameras])
    focal = field.means.data.new_tensor([camera.fx for camera in cameras])
    finest = (focal / torch.cdist(field.means.data, centers)).amax(dim=1)
    return float((field.scales.data[:, 0].exp() * finest).median())


def relocation(
    opacities: Float[Tensor, " N"], scales: Float[Tensor, "N 3"], copies: Int[Tensor, " N"], least: float = 0.0
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Opacity and scale of each of `copies` Gaussians that together render like the one that they replace.  Eq. 9 of that paper

    o' = 1 - (1 - o)^(1/n), s' = s · o / Σ_j C(n, j) (-1)^(j-1) o'^j / √j: the paper's double sum with its inner sum of
    binomials evaluated. o' is at least `least`, as gsplat's loop asks for (`integration.on_cpu`).
    """
    n = copies.clamp(1, _MOST_COPIES)
    o = opacities.double()
    shared = (-torch.expm1(torch.log1p(-o) / n)).clamp_min(least)
    j = torch.arange(1, _MOST_COPIES + 1, dtype=torch.float64, device=o.device)
    signs = 1 - 2 * ((j - 1) % 2)
    total = (_BINOMIALS.to(o.device)[n, 1:] * signs * shared[:, None] ** j / j.sqrt()).sum(-1)
    return shared.to(opacities), scales * (o / total).to(scales)[:, None]
