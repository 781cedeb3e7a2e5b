"""Checks that find NaN and infinity before they reach a parameter, by one sum per tensor; only if it is not finite, they search.

A device's numbers are not read here, since that would make the host wait; `TrainState.require_finite` checks the parameters
there before every save.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.errors import DivergedError, counted


def is_finite(x: Tensor) -> bool:
    """Return True if every number is finite. The sum of finite numbers may overflow, which is checked one by one."""
    return x.numel() == 0 or math.isfinite(float(x.sum())) or bool(torch.isfinite(x).all())


def require_finite(where: str, tensors: Mapping[str, Tensor], *, waits: bool = False, remedy: str = "") -> None:
    """Check tensors with one row per Gaussian; those on a device are not read, unless the host waits for it anyway.

    Args:
        where: what they belong to, e.g. "t=12, view b.jpg: ∇L_LR". tensors: by name.
        remedy: a sentence at the end of the error.

    Raises:
        DivergedError: names the tensor and the first such Gaussian.
    """
    for name, x in tensors.items():
        if (waits or deferred.is_immediate(x)) and not is_finite(x):
            raise DivergedError(f"{where} of {name} {rows_not_finite(x)}. {remedy}".rstrip())


def rows_not_finite(x: Tensor) -> str:
    """Describe the rows of a tensor that are not finite."""
    bad = ~torch.isfinite(x)
    rows = bad.flatten(1).any(1) if x.dim() > 1 else bad
    return f"is not finite for {counted(int(rows.sum()), 'Gaussian')}, first Gaussian {int(rows.nonzero()[0])}"


def pixels_not_finite(x: Tensor) -> str:
    """Describe the pixels of an image that are not finite, or of several images [K, H, W, 3]."""
    bad = (~torch.isfinite(x)).any(-1).view(-1, *x.shape[-3:-1]).any(0)
    row, column = bad.nonzero()[0].tolist()
    return f"is not finite at {counted(int(bad.sum()), 'pixel')}, first pixel ({column}, {row})"


def require_finite_losses(where: str, losses: Mapping[str, Number], images: Mapping[str, Tensor]) -> None:
    """Check the losses of a view; those on a device are not read.

    Args:
        images: what they compare, [H, W, 3] by name, searched where a loss is not finite.

    Raises:
        DivergedError: names the loss, and the first pixel that is not finite.
    """
    for name, value in losses.items():
        if not isinstance(value, float) or math.isfinite(value):
            continue
        for image, x in images.items():
            if not is_finite(x):
                raise DivergedError(f"{where}: the loss {name} is {value}, since {image} {pixels_not_finite(x)}.")
        raise DivergedError(f"{where}: the loss {name} is {value} although both images are finite.")
