"""The passes of the compiled per-Gaussian step."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from clear_strategies.core.conflicts import Weights
from clear_strategies.kernels.gaussian_step import Attribute
from clear_strategies.kernels.gaussian_step.cpp import CppGaussianStep
from tests.helpers.backends import needs


@pytest.fixture(params=[pytest.param(name, marks=needs(name)) for name in ("cpp", "warp", "warp-cuda")])
def passes(request):
    """The pass in C++ or in Warp, for tensors in the CPU's memory."""
    if request.param == "cpp":
        return CppGaussianStep
    from clear_strategies.kernels.gaussian_step import warp

    return warp.WarpGaussianStep if request.param == "warp" else partial(Elsewhere, warp.WarpGaussianStep, "cuda")


class Elsewhere:
    """A pass on another device; what it writes comes back to the tests' tensors."""

    def __init__(self, passes, device, *gradients) -> None:
        self.device = device
        self.there: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}  # the same tensor stays the same tensor
        tables = ({name: self.bring(x) for name, x in t.items()} if t else None for t in gradients)
        self.passes = passes(*tables)

    def bring(self, x):
        if not isinstance(x, torch.Tensor):
            return x
        return self.there.setdefault(id(x), (x, x.to(self.device, copy=True)))[1]

    def fetch(self, *written) -> None:
        for x in written:
            if x is not None:
                x.copy_(self.there.pop(id(x))[1])

    def products(self):
        found = self.passes.products()
        dot, l2, h2 = (x.cpu() for x in (found.dot, found.l2, found.h2))
        return replace(found, dot=dot, l2=l2, h2=h2)

    def step(self, attributes, weights, step):
        brought = {name: Attribute(*map(self.bring, a)) for name, a in attributes.items()}
        found = self.passes.step(brought, Weights(*map(self.bring, weights)), step)
        self.fetch(*(x for a in attributes.values() for x in (a.p, a.m, a.v)))
        return found
