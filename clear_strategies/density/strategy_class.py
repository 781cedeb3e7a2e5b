"""The class of a densification strategy, by its dotted name in the configuration."""

from __future__ import annotations

import importlib
from typing import Any, Final

import torch

from clear_strategies.errors import DataError

_NEEDS_CUDA: Final = "gsplat.strategy.mcmc.MCMCStrategy"


def strategy_class(target: str | None, device: torch.device) -> Any:
    """The class with this dotted name."""
    if target is None:
        example = "density.strategy._target_=your_package.YourStrategy"
        raise unusable("_target_", "no strategy is named", f"{example}, or density=gsplat_default")
    module, _, name = target.rpartition(".")
    try:
        kind = getattr(importlib.import_module(module), name)
    except ImportError as error:
        gsplat = "gsplat" in f"{target} {error}"
        remedy = "pip install 'clear-strategies[gsplat]'" if gsplat else "correct its dotted name"
        raise unusable("_target_", f"{target} cannot be imported ({error})", remedy) from error
    except (AttributeError, ValueError) as error:
        raise unusable("_target_", f"{target} is not there ({error})", "correct its dotted name") from error
    if f"{kind.__module__}.{kind.__qualname__}" == _NEEDS_CUDA and device.type != "cuda":
        raise unusable(
            "_target_", "gsplat's MCMCStrategy moves Gaussians by CUDA kernels, and these are on the CPU",
            "take density=gsplat_mcmc, the same strategy with those computations in torch",
        )  # fmt: skip
    return kind


def unusable(field: str, problem: str, remedy: str) -> DataError:
    return DataError("config", f"density.strategy.{field}".rstrip("."), problem, remedy)
