"""The learning rates of 3DGS, and Adam over the field's attributes (F8)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from clear_strategies.core.checks import require_number, require_whole
from clear_strategies.core.gradients import ATTRIBUTES, gathered
from clear_strategies.errors import counted
from clear_strategies.merging.detail import DetailRates
from clear_strategies.schedules import LARGEST_RATE, LogLinear, milestone

_log = logging.getLogger(__name__)

BETA1: Final = 0.9
BETA2: Final = 0.999
_GEOMETRY_POWER: Final = 1 / 3


@dataclass(frozen=True, slots=True)
class LearningRates:
    """Learning rates per step, by attribute; those of 3DGS's first release, which sparse-view forks use (F8), for its 30,000
    iterations.

    Args:
        means: log-linear decay, in units of the scene's extent.
        quats, scales, opacities, sh0, shN: of the raw parameters (any norm, log, logit, SH coefficients).
        detail, detail_steps, detail_decay: the rate, steps and decay of f_det, see `DetailRates`.
        geometry_steps: the iterations that the rates of means, scales and quats are for. In a run of T < geometry_steps
            these are (geometry_steps / T)^(1/3) times as high, see `of_run`; 0: as they stand in a run of any length.
        cool_from, end: between these iterations all rates fall linearly to 0, except for that of the means, which always falls.
            A run then ends on what its views agree on and not on the last view. Equal: no rate falls.
        eps: ε of Adam. Gradients of mean losses are near 1e-6, so torch's default of 1e-8 would freeze the small ones.
    """

    means: LogLinear = field(default_factory=LogLinear)
    quats: float = 1e-3
    scales: float = 5e-3
    opacities: float = 5e-2
    sh0: float = 2.5e-3
    shN: float = 1.25e-4  # noqa: N815 - gsplat's name
    detail: float = DetailRates().rate
    detail_steps: int = DetailRates().steps
    detail_decay: float = DetailRates().decay
    geometry_steps: int = 30_000
    cool_from: int = milestone(9_000)
    end: int = milestone(10_000)
    eps: float = 1e-15

    def __post_init__(self) -> None:
        for name in ("quats", "scales", "opacities", "sh0", "shN"):
            require_number(name, getattr(self, name), most=LARGEST_RATE)
        require_number("eps", self.eps, above=0, below=1)  # 0 / (√0 + 0) moves what has no gradient
        require_whole("geometry_steps", self.geometry_steps, least=0)
        require_whole("cool_from", self.cool_from, least=0)
        require_whole("end", self.end, least=self.cool_from)
        self.of_detail  # noqa: B018 - its ranges are checked here

    @property
    def of_detail(self) -> DetailRates:
        """The rates of f_det."""
        return DetailRates(self.detail, self.detail_steps, self.detail_decay)

    def of_run(self, iterations: int) -> LearningRates:
        """The rates of a run of this length, by `geometry_steps` and `detail_steps`.

        A Gaussian begins as a sphere, as large as the distance to its neighbours, and has to become a disc. In a step, Adam moves
        a parameter by its rate at most, so a run of a twentieth of the iterations ends too early. The best factor grows more
        slowly than T shrinks, because the noise at the end grows with the rate. Colours need no factor: they begin as the photos
        show them, and higher rates only fit the training views more closely.
        """
        rates = replace(self, detail=self.of_detail.of_run(iterations).rate)
        if iterations >= self.geometry_steps:
            return rates
        factor = (self.geometry_steps / iterations) ** _GEOMETRY_POWER
        _log.debug(
            "means, scales and quats learn %.2f times as fast: the run has %s (optim.geometry_steps: %d).",
            factor, counted(iterations, "iteration"), self.geometry_steps,
        )  # fmt: skip
        means = replace(self.means, initial=factor * self.means.initial, final=factor * self.means.final)
        return replace(rates, means=means, scales=factor * self.scales, quats=factor * self.quats)

    def at(self, t: int, extent: float) -> dict[str, float]:
        """Every attribute's rate at iteration t, in the attribute's unit."""
        cools = self.cool_from < self.end
        warmth = min(1.0, max(0, self.end + 1 - t) / (self.end + 1 - self.cool_from)) if cools else 1.0
        rates = {name: warmth * getattr(self, name) for name in ATTRIBUTES if name != "means"}
        return {"means": self.means(t) * extent, **rates}


class Adam:
    """Adam with per-attribute learning rates and rows that follow their Gaussians.

    Args:
        extent: 3DGS's cameras_extent, world units: scales the positions' learning rate.

    Attributes:
        restored: how often a checkpoint has restored the moments.
    """

    def __init__(self, params: Mapping[str, Tensor], rates: LearningRates, extent: float) -> None:
        self.rates, self.extent = rates, extent
        self.steps = self.restored = 0
        self.first = {name: torch.zeros_like(p) for name, p in params.items()}
        self.second = {name: torch.zeros_like(p) for name, p in params.items()}

    def step(self, params: Mapping[str, Tensor], grads: Mapping[str, Tensor]) -> None:
        """One step in place. An attribute without gradient has gradient 0: its momentum still moves it."""
        rates, bias2 = self.advance()
        if "detail" in grads and self.rates.detail_decay > 0:
            params["detail"].mul_(1 - self.rates.detail_decay)
        for name, p in params.items():
            m, v, g = self.first[name], self.second[name], grads.get(name)
            m.mul_(BETA1)
            v.mul_(BETA2)
            if g is not None:
                m.add_(g, alpha=1 - BETA1)
                v.addcmul_(g, g, value=1 - BETA2)
            denominator = (v / bias2).sqrt_().add_(self.rates.eps)
            p.addcdiv_(m, denominator, value=-rates[name])

    def advance(self) -> tuple[dict[str, float], float]:
        """Count a step. Returns each attribute's rate over the bias of the first moment, and the bias of the second."""
        self.steps += 1
        bias1, bias2 = 1 - BETA1**self.steps, 1 - BETA2**self.steps
        return {name: rate / bias1 for name, rate in self.rates.at(self.steps, self.extent).items()}, bias2

    def take(self, parents: Int[Tensor, " M"], fresh: Bool[Tensor, " M"]) -> None:
        """Gather the moments after a change of structure; fresh rows start without momentum."""
        new = fresh.nonzero()[:, 0]
        for moments in (self.first, self.second):
            for name, rows in moments.items():
                moments[name] = gathered(rows, parents).index_fill_(0, new, 0)

    def forget(self, name: str) -> None:
        """Zero an attribute's moments, e.g. after an opacity reset."""
        self.first[name].zero_()
        self.second[name].zero_()

    def state_dict(self) -> dict[str, Tensor]:
        moments = {"first": self.first, "second": self.second}
        return {f"{kind}.{name}": rows for kind, table in moments.items() for name, rows in table.items()}

    def load_state_dict(self, tensors: Mapping[str, Tensor], steps: int) -> None:
        self.steps, self.restored = steps, self.restored + 1
        self.first, self.second = (
            {name: tensors[f"{kind}.{name}"].to(rows.device, copy=True) for name, rows in moments.items()}
            for kind, moments in (("first", self.first), ("second", self.second))
        )
