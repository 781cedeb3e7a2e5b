"""gsplat's MCMCStrategy without CUDA (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo").

Settings, schedule and state are gsplat's. The computations that gsplat has as CUDA kernels only, and the operations around
them, are written here in torch. conf/density/gsplat_mcmc.yaml names this class.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import torch
from gsplat.strategy import MCMCStrategy
from jaxtyping import Float, Int
from torch import Tensor, nn

from rasterizers.geometry import rotation_matrix

_MOST_COPIES: Final = 51  # gsplat's bound on how many Gaussians one becomes in a round
_GROWTH: Final = 1.05  # per round
_BINOMIALS: Final = torch.tensor(
    [[math.comb(n, j) for j in range(_MOST_COPIES + 1)] for n in range(_MOST_COPIES + 1)], dtype=torch.float64
)
# The noise is weighted by σ(100 ((1 - o) - 0.995)): only Gaussians of low opacity move.
_NOISE_SLOPE: Final = 100.0
_NOISE_FROM: Final = 0.995

Params = dict[str, nn.Parameter]


class MCMC(MCMCStrategy):  # type: ignore[misc, unused-ignore]  # gsplat has no types
    """gsplat's MCMCStrategy in torch: dead Gaussians move to live ones, new ones are added, and noise moves all.

    Args:
        noise_lr: strength of the noise, times the learning rate of the positions.
        min_opacity: Gaussians below it are dead.
    """

    def step_post_backward(
        self,
        params: Params,
        optimizers: dict[str, Any],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        lr: float,
    ) -> None:
        """As gsplat's; `lr` is the positions' learning rate, world units."""
        with torch.no_grad():
            if self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0:
                relocate(params, optimizers, self.min_opacity)
                add(params, optimizers, self.cap_max, self.min_opacity)
            params["means"].add_(noise(params, lr * self.noise_lr))


def relocation(
    opacities: Float[Tensor, " N"], scales: Float[Tensor, "N 3"], copies: Int[Tensor, " N"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, "N 3"]]:
    """Opacity and scale of each of `copies` Gaussians that together replace one.  Eq. 9 of that paper

    o' = 1 - (1 - o)^(1/n), s' = s · o / Σ_j C(n, j) (-1)^(j-1) o'^j / √j: the paper's double sum, its inner binomials
    added up.
    """
    n = copies.clamp(1, _MOST_COPIES)
    o = opacities.double()
    shared = -torch.expm1(torch.log1p(-o) / n)
    j = torch.arange(1, _MOST_COPIES + 1, dtype=torch.float64, device=o.device)
    signs = 1 - 2 * ((j - 1) % 2)
    total = (_BINOMIALS.to(o.device)[n, 1:] * signs * shared[:, None] ** j / j.sqrt()).sum(-1)
    return shared.to(opacities), scales * (o / total).to(scales)[:, None]


def relocate(params: Params, optimizers: dict[str, Any], min_opacity: float) -> None:
    """Replace dead Gaussians by copies of live ones, sampled by opacity."""
    opacities = params["opacities"].sigmoid()
    dead = opacities <= min_opacity
    if not bool(dead.any()) or bool(dead.all()):
        return
    places, live = dead.nonzero()[:, 0], (~dead).nonzero()[:, 0]
    sources = live[torch.multinomial(opacities[live], len(places), replacement=True)]
    share(params, sources, min_opacity)

    def moved(p: Tensor) -> Tensor:
        return p.index_copy(0, places, p[sources])

    def rested(moments: Tensor) -> Tensor:
        return moments.index_fill(0, sources, 0)

    _rewrite(params, optimizers, moved, rested)


def add(params: Params, optimizers: dict[str, Any], cap: int, min_opacity: float) -> None:
    """Add a twentieth more Gaussians, up to the cap: copies of Gaussians sampled by opacity."""
    n = len(params["means"])
    more = min(cap, int(_GROWTH * n)) - n
    if more <= 0:
        return
    sources = torch.multinomial(params["opacities"].sigmoid(), more, replacement=True)
    share(params, sources, min_opacity)

    def grown(p: Tensor) -> Tensor:
        return torch.cat((p, p[sources]))

    def rested(moments: Tensor) -> Tensor:
        return torch.cat((moments, moments.new_zeros(more, *moments.shape[1:])))

    _rewrite(params, optimizers, grown, rested)


def share(params: Params, sources: Int[Tensor, " K"], min_opacity: float) -> None:
    """Lower each source's opacity and scale to those of its copies to come."""
    opacities, scales = relocation(
        params["opacities"].sigmoid()[sources], params["scales"].exp()[sources], torch.bincount(sources)[sources] + 1
    )
    params["opacities"][sources] = torch.logit(opacities.clamp(min_opacity, 1 - torch.finfo(torch.float32).eps))
    params["scales"][sources] = scales.log()


def noise(params: Params, strength: float) -> Float[Tensor, "N 3"]:
    """A random offset within each Gaussian's covariance, larger for lower opacity."""
    faint = torch.sigmoid(_NOISE_SLOPE * (1 - params["opacities"].sigmoid() - _NOISE_FROM))
    offset = torch.randn_like(params["means"]) * (faint * strength)[:, None]
    R = rotation_matrix(params["quats"])
    along = (R.mT @ offset[..., None]) * params["scales"].exp().square()[..., None]
    return (R @ along)[..., 0]


def _rewrite(
    params: Params,
    optimizers: dict[str, Any],
    of_parameter: Callable[[Tensor], Tensor],
    of_moments: Callable[[Tensor], Tensor],
) -> None:
    """Replace every parameter and its moments."""
    for name, old in list(params.items()):
        new = nn.Parameter(of_parameter(old), requires_grad=old.requires_grad)
        moments = optimizers[name].state.pop(old, {})
        optimizers[name].state[new] = {
            key: value if key == "step" else of_moments(value) for key, value in moments.items()
        }
        optimizers[name].param_groups[0]["params"] = [new]
        params[name] = new
