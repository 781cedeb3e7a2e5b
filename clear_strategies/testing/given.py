"""A view of thirty Gaussians with given gradients, and a conductor of a few iterations, in which a strategy is checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import ATTRIBUTES, Grads, summed
from clear_strategies.core.step import Step
from clear_strategies.core.view import Photo, View
from clear_strategies.errors import AnswerError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import WarmupDecay, scaled
from clear_strategies.strategies.base import Strategy, overrides
from rasterizers.interface import Camera
from rasterizers.testing import ContractError

Make = Callable[[], Strategy]

N: Final = 30
STEPS: Final = 6
_FACTOR: Final = 4


@dataclass(slots=True, eq=False)
class StubShot:
    """A rendering with given gradients: what a strategy needs of one, without a rasterizer."""

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    gradients: list[Grads]
    cotangents: list[Tensor] = field(default_factory=list)
    """That it was given, which do not change its gradients."""

    def vjp(self, cotangents: Float[Tensor, "K H W 3"], weight: Float[Tensor, " N"] | None = None) -> list[Grads]:
        self.cotangents.append(cotangents.clone())
        each = self.gradients[: len(cotangents)]
        return each if weight is None else summed(each, weight)


def random_params(n: int, g: torch.Generator) -> dict[str, Tensor]:
    """Raw parameters by attribute."""
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3), "detail": (3,),
    }  # fmt: skip
    return {name: 3 * torch.randn(n, *shapes[name], generator=g) for name in ATTRIBUTES}


def without_error(hook: str, when: str, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    try:
        return call(*args, **kwargs)
    except AnswerError:
        raise
    except Exception as error:
        raise ContractError(f"{hook} fails {when} ({type(error).__name__}: {error})".replace("  ", " ")) from error


def situation(seed: int, n: int = N) -> tuple[StubShot, StubShot, View, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(0)  # one view, whatever the seed: strategies may remember it by name
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 40.0, 20.0, 16.0, 40, 32)  # as the readers give poses
    hr_image = images.quantize(torch.rand(32, 40, 3, generator=g))
    lr_image = images.downsample(hr_image, _FACTOR)
    noisy = (hr_image + 0.1 * torch.randn(32, 40, 3, generator=g)).clamp(0, 1)
    view = View("checked", Photo(camera.scaled(1 / _FACTOR), lr_image), Photo(camera, noisy))
    g = torch.Generator().manual_seed(seed)
    visible = torch.rand(n, generator=g) < 0.8
    u = torch.rand(n, 2, generator=g) * torch.tensor([40.0, 32.0])

    def gradients(detail: bool) -> Grads:
        values = {name: 1e-6 * p * visible.view(-1, *[1] * (p.dim() - 1)) for name, p in random_params(n, g).items()}
        if not detail:
            del values["detail"]
        return Grads(values, screen=1e-6 * torch.randn(n, 2, generator=g))

    lr = StubShot(lr_image * 0.9, u / _FACTOR, visible, [gradients(False)])
    hr = StubShot(hr_image * 1.2 - 0.1, u, visible, [gradients(True), gradients(True)])
    return lr, hr, view, random_params(n, g)


@dataclass(frozen=True)
class _Observes(Strategy):
    """Has the evidence that another strategy may read."""

    evidence: Evidence

    def observe(self, step: Step, hr: Any) -> Evidence:
        return self.evidence


def evidence() -> Evidence:
    q = torch.linspace(0, 1, N)
    return Evidence(q, q.flip(0))


def conductor(
    make: Make, *, lambda_hf: float = 0.2, evidence: Evidence | None = None, views: Sequence[View] | None = None,
    others: Sequence[Strategy] = (),
) -> Conductor:  # fmt: skip
    """Milestones are compressed, so that every phase falls inside the few steps of a check.

    Args:
        evidence: of another strategy, where this one has none. views: of the training, for `on_views`.
        others: that take part besides.
    """
    objective = Objective(WarmupDecay(start=0, full=1, decay_from=STEPS, end=STEPS), lambda_hf)
    strategy = scaled(make(), STEPS / 2 / 5_000)
    if evidence is not None and not overrides(strategy, "observe"):
        others = [*others, _Observes(evidence)]
    conductor = Conductor(strategy, *others, objective=objective)
    conductor.on_fit_start(3, seed=11, views=[situation(0)[2]] if views is None else views)
    return conductor


def trace(conductor: Conductor, start: int, stop: int, n: int = N) -> Iterator[Any]:
    """All answers of a conductor in the iterations from `start` to before `stop`."""
    for t in range(start, stop):
        lr, hr, view, params = situation(100 + t, n)
        z = conductor.gate(t, n)
        yield torch.ones(n) if z is None else z
        yield torch.tensor(conductor.background(t) or (0.0, 0.0, 0.0))
        update = conductor.update(params, lr, hr, view, t)
        yield update.score
        yield from (*lr.cotangents, *hr.cotangents)  # what `compare` answered
        yield from (g for _, g in sorted((update.grads or {}).items()))
        for extra in conductor.extra_views(t):
            yield from (extra.photo.image, extra.weight)
        conductor.after_step(params, update.step)
        yield from params.values()


def enlarged(camera: Camera, factor: int) -> Photo:
    large = camera.scaled(factor)
    return Photo(large, torch.full((large.height, large.width, 3), 0.5))
