"""What a user writes: a strategy, a loop with `attach`, a training. `mypy` checks it with the packages."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, assert_type

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import Conductor, Run, Step, Strategy, View, train
from clear_strategies.compose import conductor
from clear_strategies.data.priors import Bicubic
from clear_strategies.schedules import milestone
from integration.gsplat import attach
from integration.gsplat.attached import Attached
from integration.views import view
from rasterizers.as_gsplat import rasterization


@dataclass(frozen=True)
class Late(Strategy):
    """Lets high-frequency gradients pass from an iteration on."""

    start: int = milestone(2_000)

    def route(self, step: Step) -> float | Float[Tensor, " N"]:
        return 1.0 if step.t >= self.start else 0.0


def loop(splats: dict[str, Tensor], optimizers: dict[str, torch.optim.Optimizer], photos: Sequence[Tensor]) -> None:
    clear = assert_type(conductor("clear", "strategies.gco.tolerance=0.1", iterations=100), Conductor)
    K, pose, sr = torch.eye(3), torch.eye(4), clear.prior(Bicubic())
    views = [view(f"{i}.png", photo, pose, K, sr=sr, factor=4) for i, photo in enumerate(photos)]
    assert_type(views[0], View)
    attached = assert_type(attach(splats, optimizers, views, clear), Attached)
    image, _, info = attached.wrap(rasterization)(splats["means"])
    assert_type(image, Tensor)
    assert_type(info, dict[str, Any])
    assert_type(attached.attachment.t, int)


def alone() -> dict[str, float]:
    run = assert_type(train("photos", "fit.iterations=300", folder="outputs/mine"), Run)
    assert_type(run.render(), Tensor)
    Conductor(Late(start=10))
    return {name: float(values.mean()) for name, values in run.splats.items()}


def mistakes() -> None:
    """Without the types of a package, mypy finds none of these, and each ignored line is an error itself."""
    attach({}, {}, [], "clear")  # type: ignore[arg-type]
    view("a.png", torch.rand(4, 4, 3), torch.eye(4))  # type: ignore[call-arg]
    conductor(iteration=100)  # type: ignore[call-arg]
    train(3)  # type: ignore[arg-type]
    Late(begin=3)  # type: ignore[call-arg]
    rasterization()  # type: ignore[call-arg]
