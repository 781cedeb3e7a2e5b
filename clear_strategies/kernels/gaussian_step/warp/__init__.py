"""The per-Gaussian step in Warp, for CUDA; tests also run the kernels on a CPU.

Counts stay on the device, as int64. Importing this package imports Warp; call `rasterizers.warp_runtime.require_warp` first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from ctypes import sizeof
from typing import Any, Final, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.gradients import CONFLICT_GROUPS
from clear_strategies.kernels.gaussian_step import Attribute, StepSettings
from clear_strategies.kernels.gaussian_step.warp import passes
from clear_strategies.kernels.reconcile.tables import weight_tables
from clear_strategies.kernels.reconcile.warp import product_table, products_of, weights_of
from rasterizers.warp_runtime import lanes_on, launch, on_stream, struct

LANES: Final = 128
"""Threads per block, see `lanes_on`."""

_STEP: Final = cast(Any, passes.AdamStep).ctype
_BYTES: Final = 4  # of each of its numbers
_WIDTHS: Final = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "detail": 3}
_MOST_ATTRIBUTES: Final = 256
_attributes: dict[tuple[Any, ...], Any] = {}


class WarpGaussianStep:
    """The gradients of one view's losses, as the rasterizer returns them, and the pass over them.

    Args:
        activation, lr, hr: as for `cpp.CppGaussianStep`, all on one device.

    Raises:
        TypeError, ValueError: a tensor is not float32, contiguous and on that device, or has a wrong shape.
    """

    recordable: Final = True

    def __init__(
        self, activation: Mapping[str, Tensor], lr: Mapping[str, Tensor], hr: Mapping[str, Tensor] | None
    ) -> None:
        self._like = activation["basis"]
        self._n, self._bases = self._like.shape
        if not 1 <= self._bases <= 16:
            raise ValueError(f"the basis must have 1 to 16 columns, got {self._bases}.")
        if 45 * self._n >= 2**31:
            raise ValueError(f"shN is indexed with 32 bits, which {self._n} Gaussians exceed. Set fit.fused=off.")
        self._kept = (activation, lr, hr)  # kept alive while kernels may read them
        self._has_hr, high = hr is not None, hr or {}
        inputs = {"scales": 3, "filtered": 3, "filter": 1, "sigmoid": 1, "factor": 1, "basis": self._bases}
        widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "rgb": 3}
        widths_of_hr = widths | {"detail": 3} if "detail" in high else widths
        self._gradients = (
            self._rows(passes.Activation, activation, inputs),
            self._rows(passes.Gradient, lr, widths),
            self._rows(passes.Gradient, high, widths_of_hr if high else {}),
        )

    def products(self) -> Products:
        if self._n and not self._has_hr:
            raise ValueError("there is no HR gradient to reconcile.")
        blocks = -(-self._n // lanes_on(self._like.device, LANES))
        table, counts = product_table(self._like, self._n, blocks)
        launch(passes.compare, [blocks], (*self._gradients, table, counts), block=LANES, together=True)
        return products_of(CONFLICT_GROUPS, table, counts)

    def step(
        self, attributes: Mapping[str, Attribute], weights: Weights, settings: StepSettings
    ) -> int | Int[Tensor, ""]:  # fmt: skip
        parameters = [self._attribute(attributes[name], width) for name, width in _WIDTHS.items()]
        bands = self._attribute(attributes["shN"], math.prod(attributes["shN"].p.shape[1:]))
        least, most = 3 * (self._bases - 1), min(bands.width, 45)
        if settings.width % 3 or not least <= settings.width <= most:
            raise ValueError(
                f"width must be a multiple of 3 from {least}, the active bands, to {most}, a row of shN; got {settings.width}."
            )
        colours = self._like.new_empty(self._n, 3)
        moving = self._like.new_empty(self._n, dtype=torch.bool)
        device, adam_step = self._like.device, settings.changing
        blocks = -(-self._n // lanes_on(device, LANES))
        stills = self._like.new_empty(blocks, dtype=torch.int32)
        if adam_step is None:
            adam_step = written(settings, {name: a.rate for name, a in attributes.items()}, device)
        options = struct(
            passes.StepOptions, skips=settings.skips, width=settings.width, merges=self._has_hr and settings.lambda_hr > 0
        )  # fmt: skip
        tables = weight_tables(weights, self._n, device)
        step = (
            *self._gradients, weights_of(tables), options, adam_step, *parameters, bands, colours, moving, stills,
        )  # fmt: skip
        of_bands = self._like, colours, moving, adam_step, bands
        with on_stream(device):
            launch(passes.step, [blocks], step, block=LANES, together=True)
            launch(passes.step_bands, [self._n, settings.width], of_bands, block=LANES)
        return stills.sum() if settings.skips else 0

    def _attribute(self, a: Attribute, width: int) -> Any:
        """The structure for the kernels, checked, and cached by the tensors' addresses, which stay between changes of the field's
        structure.
        """
        tensors = {"p": a.p, "m": a.m, "v": a.v, "hr": a.hr, "plus": a.plus}
        where = [None if x is None else (x.data_ptr(), x.numel(), x.dtype) for x in tensors.values()]
        key = *where, self._n, width, a.keep, a.limit
        if key not in _attributes:
            for name, tensor in tensors.items():
                if tensor is not None:
                    self._require(name, tensor, width)
            if len(_attributes) >= _MOST_ATTRIBUTES:
                _attributes.clear()
            _attributes[key] = struct(
                passes.Attribute, **tensors, width=width, bounded=a.keep != 1 or a.limit != math.inf, keep=a.keep, limit=a.limit
            )  # fmt: skip
        return _attributes[key]

    def _rows(self, kind: Any, tensors: Mapping[str, Tensor], widths: Mapping[str, int]) -> Any:
        """A structure of type `kind` from tensors, which must have n rows of `widths` numbers."""
        for name, width in widths.items():
            self._require(name, tensors[name], width)
        return struct(kind, **tensors)

    def _require(self, name: str, tensor: Tensor, width: int) -> None:
        """Check that a tensor has a row of `width` numbers for each Gaussian."""
        device = self._like.device
        if tensor.dtype is not torch.float32 or tensor.device != device or not tensor.is_contiguous():
            where = "in the CPU's memory" if device.type == "cpu" else f"on {device}"
            raise TypeError(f"{name} must be a contiguous float32 tensor {where}.")
        if tensor.dim() == 0 or tensor.shape[0] != self._n or tensor.numel() != self._n * width:
            raise ValueError(f"{name} must have {self._n} rows of {width} numbers, got shape {tuple(tensor.shape)}.")


def written(
    s: StepSettings, rates: Mapping[str, float], device: torch.device, *, lambda_hf: float = 0.0, out: Tensor | None = None
) -> Tensor:  # fmt: skip
    """The numbers of a step on the device, as a row of `passes.AdamStep`; written to `out` unless that is None.

    Args:
        rates: each attribute's, see `Attribute`. lambda_hf: λ_HR λ_HF.
    """
    if out is None:
        out = torch.empty(1, sizeof(_STEP) // _BYTES, dtype=torch.float32, device=device)
    numbers = struct(
        passes.AdamStep, rates=struct(passes.Rates, **{name: -rate for name, rate in rates.items()}), beta1=s.beta1,
        beta2=s.beta2, gain1=1 - s.beta1, gain2=1 - s.beta2, per_bias2=1 / s.bias2, eps=s.eps, lambda_hr=s.lambda_hr,
        lambda_hf=lambda_hf,
    )  # fmt: skip
    launch(passes.write, [1], (numbers, out), block=LANES)
    return out


def loss_weights(numbers: Tensor) -> Float[Tensor, " 2"]:
    """λ_HR and λ_HR λ_HF, as `written` has stored them."""
    first, last = (getattr(_STEP, name).offset // _BYTES for name in ("lambda_hr", "lambda_hf"))
    return numbers[0, first : last + 1]
