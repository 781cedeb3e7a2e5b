"""The optimizers of a host's loop, which it may combine, split or replace during training."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

from clear_strategies.errors import SettingError
from clear_strategies.merging.detail import DetailRates
from integration.detail import DETAIL_EPS, detail_adam

_DETAIL = "detail"


def optimizers_of(
    given: Mapping[str, Any] | torch.optim.Optimizer, params: Mapping[str, Tensor], names: Iterable[str]
) -> list[torch.optim.Optimizer]:
    """The optimizers that step the Gaussians: they have one of the names, or hold one of the parameters. Others, e.g. of poses,
    are left out.

    Args:
        given: the host's optimizers, by the names of its parameters or by any other names, or a single one.

    Raises:
        SettingError: they are neither.
    """
    if isinstance(given, torch.optim.Optimizer):
        return [given]
    if not isinstance(given, Mapping):
        raise SettingError(
            f"optimizers must be a dict of optimizers or one of torch's, got {type(given).__name__}. Give each a name, e.g. "
            "{'all': optimizer}."
        )
    leaves, known = {id(p) for p in params.values()}, {*names, _DETAIL}
    found = [o for name, o in given.items() if name in known or not leaves.isdisjoint(map(id, _stepped(o)))]
    return list({id(o): o for o in found}.values())


def step_detail(
    given: MutableMapping[str, Any] | torch.optim.Optimizer,
    found: list[torch.optim.Optimizer],
    detail: torch.nn.Parameter,
    rates: DetailRates,
) -> list[torch.optim.Optimizer]:
    """`found`, with an optimizer that steps f_det. If a single optimizer steps all parameters, the loop steps no other, and f_det
    becomes a group of it. Otherwise f_det gets an Adam of its own in the host's dictionary.

    Raises:
        SettingError: the single optimizer has a learning rate scheduler, which counts its groups; or it takes no groups.
    """
    if any(p is detail for o in found for p in _stepped(o)):
        return found
    if isinstance(given, torch.optim.Optimizer) or (len(found) == 1 and len(_stepped(found[0])) > 1):
        only = found[0]
        if not hasattr(only, "add_param_group"):
            raise SettingError(
                f"optimizers: f_det becomes a group of the only optimizer, but {type(only).__name__} has no add_param_group. "
                "Derive it from torch.optim.Optimizer, or attach(detail=False)."
            )
        if getattr(only.step, "_wrapped_by_lr_sched", False):
            raise SettingError(
                "optimizers: f_det becomes a group of the optimizer, whose learning rate scheduler exists already and counts its "
                "groups. Make the scheduler after attach(), or attach(detail=False)."
            )
        only.add_param_group({"params": [detail], "name": _DETAIL, "lr": rates.rate, "eps": DETAIL_EPS})
        if not isinstance(given, torch.optim.Optimizer):
            given.setdefault(_DETAIL, only)
        return found
    if _DETAIL not in given:  # also if the parameter came from a checkpoint of the host
        given[_DETAIL] = detail_adam(detail, rates)
        return [*found, given[_DETAIL]]
    return found


def _stepped(optimizer: Any) -> list[Tensor]:
    return [p for group in getattr(optimizer, "param_groups", ()) for p in group["params"]]
