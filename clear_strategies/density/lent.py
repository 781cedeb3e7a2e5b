"""A field and its optimizer as a strategy of gsplat's interface takes them, and what it made of them taken back.

The dicts share memory with field and moments. Row numbers are passed as one more parameter and gathered with the others,
which gives parents[M] exactly.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from clear_strategies.core.gradients import ATTRIBUTES
from clear_strategies.density.base import DensityError
from clear_strategies.training.field import GaussianField
from clear_strategies.training.optim import Adam

ROWS: Final = "rows"  # the parameter that holds the row numbers


class Optimizer:
    """What a strategy of gsplat's shape may touch of a torch optimizer: one group, and its one parameter's moments."""

    def __init__(self, parameter: nn.Parameter, lr: float, moments: Mapping[str, Tensor]) -> None:
        self.param_groups: list[dict[str, Any]] = [{"params": [parameter], "lr": lr}]
        self.state: defaultdict[Tensor, dict[str, Tensor]] = defaultdict(dict, {parameter: dict(moments)})


class RowNumbers:
    """The row numbers as they were passed in; whether they were gathered is known without reading them."""

    def __init__(self, rows: nn.Parameter) -> None:
        self.rows, self._version = rows, rows._version

    def unchanged(self, now: Tensor) -> bool:
        return now is self.rows and now._version == self._version


@dataclass(frozen=True, slots=True, eq=False)
class ViewScores:
    """The scores of one view; `score` is the same tensor as `ordinary` where no strategy gives another."""

    score: Float[Tensor, " N"]
    ordinary: Float[Tensor, " N"]
    visible: Bool[Tensor, " N"]
    means2d: Float[Tensor, "N 2"]
    width: int
    height: int


class Info(dict[str, Any]):
    """gsplat's `info`, which records the keys that are read."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def __missing__(self, key: str) -> Any:
        raise DensityError(f"the strategy reads info[{key!r}]; this trainer has {', '.join(self)}.")


def lend(
    field: GaussianField, optimizer: Adam, rates: Mapping[str, float]
) -> tuple[dict[str, nn.Parameter], dict[str, Optimizer]]:
    """Field and moments as gsplat's dicts, sharing memory, with the row numbers as one more parameter."""
    params = {name: nn.Parameter(p) for name, p in field.raw().items()}
    steps = torch.tensor(float(optimizer.steps), device="cpu")  # as torch's Adam keeps it
    optimizers = {
        name: Optimizer(
            p, rates[name], {"step": steps, "exp_avg": optimizer.first[name], "exp_avg_sq": optimizer.second[name]}
        )
        for name, p in params.items()
    }
    # In float64: a parameter that an optimizer holds cannot be of integers, and these are exact up to 2⁵³.
    params[ROWS] = nn.Parameter(torch.arange(len(field), dtype=torch.float64, device=field.means.device))
    optimizers[ROWS] = Optimizer(params[ROWS], 0.0, {})
    return params, optimizers


def take_back(
    field: GaussianField,
    optimizer: Adam,
    params: Mapping[str, Tensor],
    optimizers: Mapping[str, Optimizer],
    kind: str = "the strategy",
    *,
    moved: bool = True,
) -> Int[Tensor, " M"]:
    """Copy a strategy's result into field and moments; returns parents[M].

    Args:
        moved: whether the row numbers may have changed.

    Raises:
        DensityError: the rows of parameters, moments and row numbers do not belong together.
    """
    rows = params[ROWS].detach()
    parents = rows.long()
    if moved and not bool(((parents == rows) & (parents >= 0) & (parents < len(field))).all()):
        raise DensityError(f"{kind} changed the parameter {ROWS!r}; row numbers may only be gathered.")
    for name in ATTRIBUTES:
        p = params[name]
        moments = optimizers[name].state.get(p, {})
        for found in (p, moments.get("exp_avg"), moments.get("exp_avg_sq")):
            if found is None or len(found) != len(parents):
                raise DensityError(
                    f"{kind} left {name} with {'no moments' if found is None else f'{len(found)} rows'} where {ROWS!r} "
                    f"has {len(parents)}; it must rewrite every entry of params and optimizers alike."
                )  # fmt: skip
        getattr(field, name).data = p.detach().contiguous()
        optimizer.first[name] = moments["exp_avg"].detach().contiguous()
        optimizer.second[name] = moments["exp_avg_sq"].detach().contiguous()
    if moved:
        field.filter_3d = field.filter_3d[parents]
    field.constrain()
    return parents


def info_of(seen: ViewScores) -> dict[str, Any]:
    """One camera's `info`, not packed; the screen gradient is the score, along x.

    gsplat takes the gradient in pixels to NDC by W/2 times the number of cameras; so its statistic is the score itself.
    """
    means2d = seen.means2d[None].clone().requires_grad_()
    means2d.grad = torch.zeros_like(means2d)
    means2d.grad[0, :, 0] = seen.score / (seen.width / 2)
    radii = seen.visible.float()[None]  # 1 where seen: our rasterizers report no size
    if _radii_by_axis():
        radii = radii[..., None].expand(-1, -1, 2)
    return {
        "means2d": means2d, "radii": radii, "width": seen.width, "height": seen.height, "n_cameras": 1,
        "gaussian_ids": None, "camera_ids": None,
    }  # fmt: skip


def gsplat_version() -> str | None:
    try:
        return metadata.version("gsplat")
    except metadata.PackageNotFoundError:
        return None


def _radii_by_axis() -> bool:
    """Whether radii are [C, N, 2], as since gsplat 1.5; before they are [C, N]."""
    version = gsplat_version()
    return version is None or tuple(int(part) for part in version.split(".")[:2]) >= (1, 5)
