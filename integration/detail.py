"""The detail feature f_det in hosts, which have no such parameter: its Adam, and how it shows in the colours."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.merging.detail import DetailRates
from rasterizers.geometry import SH_C0

DETAIL_EPS: Final = 1e-15
"""Adam's, as in 3DGS: gradients of mean losses are near 1e-6."""


def detail_adam(detail: torch.nn.Parameter, rates: DetailRates) -> torch.optim.Adam:
    """An Adam for f_det that steps all Gaussians. A loop may pass it the visible ones, as gsplat's SelectiveAdam takes them: the
    argument is dropped, since others are visible at HR.
    """
    fused = detail.device.type in ("cpu", "cuda")  # one operation
    adam = torch.optim.Adam([detail], lr=rates.rate, eps=DETAIL_EPS, fused=fused)
    adam.register_step_pre_hook(lambda _, args, kwargs: (
        tuple(value for value in args if not isinstance(value, Tensor)),
        {name: value for name, value in kwargs.items() if name != "visibility"},
    ))  # fmt: skip
    return adam


def sh0_offset(detail: Float[Tensor, "N 3"], sh0: Float[Tensor, "N ..."]) -> Float[Tensor, "N ..."]:
    """f_det as an offset of the constant SH band."""
    return (detail / SH_C0).view_as(sh0)
