"""What a host renders for the strategies, as its adapter passes it to an `Attachment`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal
from weakref import WeakMethod

import torch
from jaxtyping import Float
from torch import Tensor

from integration.autograd_shot import AutogradShot
from rasterizers.interface import Camera

Target = Literal["lr", "hr"] | Camera
"""What a host draws: the view of this iteration at one of its sizes, or what a camera without a photo sees."""


@dataclass(frozen=True, slots=True, eq=False)
class HostRendering:
    """One rendering by a host, as its adapter passes it on.

    Args:
        output: a tensor that the host computes its loss from. Its gradient marks the start of the host's backward pass.
        returned: what the host's own render function returns.
    """

    shot: AutogradShot
    output: Tensor
    returned: Any


RenderAt = Callable[[Target, Float[Tensor, " N"] | None], HostRendering]
"""Renders by the host's own renderer, opacities multiplied by the gate: with f_det at HR, without it for any other target."""


def called_at(on_backward: WeakMethod[Callable[[int], None]], nth: int) -> Callable[[Tensor], None]:
    """A tensor hook that calls `on_backward(nth)`. Its reference is weak: with a strong one, its tensor would never be freed."""
    return lambda _: None if (alive := on_backward()) is None else alive(nth)


@contextmanager
def random_state_kept(device: torch.device) -> Iterator[None]:
    """Restore torch's random generators, so that a dropout inside the host's render drops the same at both scales."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        yield
