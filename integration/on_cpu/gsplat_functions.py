"""CPU versions of the functions that gsplat compiles for CUDA; the rest of gsplat is torch, and stays."""

from __future__ import annotations

import functools
import importlib
import inspect
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, Final, cast

import torch
from jaxtyping import Bool
from torch import Tensor

import rasterizers
from clear_strategies.errors import HostError
from integration.gsplat.__main__ import VERSIONS
from integration.launcher import module_of_host


def replace() -> None:
    """Replace `rasterization` and gsplat's CUDA functions; one that is not here raises `HostError` where it is called."""
    sys.modules["gsplat.cuda._backend"] = cast(Any, SimpleNamespace(_C=None))  # nothing compiled is loaded, or built
    everywhere: list[Any] = [
        module_of_host(f"gsplat{name}", VERSIONS)
        for name in ("", ".rendering", ".distributed", ".relocation", ".strategy.ops", ".cuda._wrapper")
    ]
    gsplat, rendering, *_ = everywhere
    version = tuple(map(int, gsplat.__version__.split(".")[:2]))
    for name, ours in {
        "rasterization": rasterization_like(rendering.rasterization, one_radius=version < (1, 5)),
        "quat_scale_to_covar_preci": importlib.import_module("gsplat.cuda._torch_impl")._quat_scale_to_covar_preci,
        "_make_lazy_cuda_func": function,
        "cli": lambda train, config, verbose=False: train(0, 0, 1, config),
    }.items():
        for module in everywhere:
            if hasattr(module, name):
                setattr(module, name, ours)


def rasterization_like(theirs: Callable[..., Any], *, one_radius: bool) -> Callable[..., Any]:
    """Ours, for calls in gsplat's order and with its default of `packed`.

    Args:
        one_radius: `info["radii"]` has one number for each Gaussian, as before gsplat 1.5.
    """
    signature = inspect.signature(theirs)

    @functools.wraps(theirs)
    def rasterization(*args: Any, **kwargs: Any) -> Any:
        call = {"packed": signature.parameters["packed"].default} | signature.bind(*args, **kwargs).arguments
        images, alphas, info = rasterizers.rasterization(**call)
        if one_radius:
            info["radii"] = info["radii"].amax(-1)
        return images, alphas, info

    return rasterization


def function(name: str) -> Callable[..., Any]:
    """A function of gsplat's CUDA module."""

    def absent(*_: Any, **__: Any) -> Any:
        raise HostError(
            f"gsplat's CUDA function {name} has no counterpart on a CPU. docs/how-to/on-a-laptop.md lists the options that work."
        )

    return _FUNCTIONS.get(name, absent)


def _relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, n_max: int, min_opacity: float = 0.0
) -> tuple[Tensor, Tensor]:
    """`gsplat.relocation`, of MCMC; the table of binomials is not needed."""
    from clear_strategies.density.mcmc import relocation  # other trainers need not load the densifiers

    return relocation(opacities, scales, ratios.long(), min_opacity)


@torch.no_grad()
def _adam(
    param: Tensor, grad: Tensor, mean: Tensor, square: Tensor, valid: Bool[Tensor, " N"], lr: float, beta1: float, beta2: float,
    eps: float,
) -> None:  # fmt: skip
    """A step of gsplat's `SelectiveAdam`: of the valid rows alone, without bias correction."""
    rows = valid.nonzero()[:, 0]
    mean[rows] = beta1 * mean[rows] + (1 - beta1) * grad[rows]
    square[rows] = beta2 * square[rows] + (1 - beta2) * grad[rows].square()
    param[rows] -= lr * mean[rows] / (square[rows].sqrt() + eps)


_FUNCTIONS: Final[dict[str, Callable[..., Any]]] = {
    "relocation": _relocation,
    "compute_relocation": _relocation,  # its name before gsplat 1.5
    "adam": _adam,
}
