"""`python -m tests.helpers.gsplat_elsewhere NAME …`: the example's loop with these strategies, on another device than the CPU."""

import sys
from dataclasses import replace
from functools import partial
from typing import Any

import torch
import torch.distributed.tensor  # torch's own imports would not know the generator below

import rasterizers.reference
from integration.examples import gsplat_loop
from integration.examples.demo import load_demo
from rasterizers.autograd import rasterization
from tests.helpers.elsewhere import NAME, Elsewhere

_POINTS, _ITERATIONS = 60, 4


def main(names: list[str]) -> None:
    """Train for a few iterations with each."""
    stereo, generator = gsplat_loop.stereo, torch.Generator

    def few(*photos: Any) -> Any:
        points = stereo(*photos)
        return replace(points, means=points.means[:_POINTS], colors=points.colors[:_POINTS])

    drawn_there = replace(rasterizers.reference._TRAITS, devices=frozenset({"cpu", NAME}))
    rasterizers.reference._TRAITS = drawn_there  # type: ignore[misc]
    torch.Generator = lambda _="cpu": generator()  # type: ignore[assignment,misc] # there are none for the other device
    gsplat_loop.stereo = few  # type: ignore[assignment]
    gsplat_loop.load_demo = lambda device: load_demo(64, 48, device=NAME)  # type: ignore[assignment]
    gsplat_loop.cpu_rasterization = partial(rasterization, backend="torch")  # type: ignore[assignment]
    with Elsewhere():
        for name in names:
            print(name, gsplat_loop.main(_ITERATIONS, None if name == "none" else name))  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1:])
