"""The per-Gaussian pass in Warp, the same one as in C++ (`step`): for CUDA, and on a CPU the same kernels, to check them.

What is counted stays on the device: a `Comparison` and a `Stepped` hold tensors there, counts int64 and sums float64, and
nobody waits for them. To be imported once `rasterizers.warp_backend.launch.require` has found Warp.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import torch
import warp as wp
from torch import Tensor

from clear_strategies.kernels.gaussian_step.cpp import Attribute, Comparison, Correction, Step, Stepped
from clear_strategies.kernels.gaussian_step.warp import adam, conflict, pulled, sweeps
from rasterizers.warp_backend.launch import array, on_stream

LANES: Final = {"cuda": 128, "cpu": 1}
"""Threads a block; on a CPU Warp's blocks have one."""

_GROUPS: Final = int(conflict.GROUPS)
_WIDTHS: Final = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "detail": 3}


class GaussianPass:
    """The gradients of one view's losses, as a rasterizer left them, and the sweeps over them.

    Args:
        activation, lr, base, hf: as for `step.GaussianPass`, all on one device.

    Raises:
        TypeError, ValueError: a tensor is not float32, contiguous and on that device, or has another shape.
    """

    def __init__(
        self,
        activation: Mapping[str, Tensor | None],
        lr: Mapping[str, Tensor],
        base: Mapping[str, Tensor] | None,
        hf: Mapping[str, Tensor] | None,
        lambda_hf: float,
    ) -> None:
        self._like = lr["basis"]
        self._n, self._bases = self._like.shape
        if not 1 <= self._bases <= 16:
            raise ValueError(f"the basis must have 1 to 16 columns, got {self._bases}.")
        if 45 * self._n >= 2**31:
            raise ValueError(f"numbers of shN are counted in 32 bits, got {self._n} Gaussians. Set fit.fused=off.")
        if base is None and hf is not None:
            raise ValueError("hf needs base, got None.")
        self._kept = (activation, lr, base, hf)  # while kernels may read them
        self._has_base, self._hr_basis = base is not None, (lr if base is None else base)["basis"]
        self._one_basis = self._hr_basis.data_ptr() == lr["basis"].data_ptr()
        view = pulled.View()
        view.n, view.bases, view.one_basis, view.lambda_hf = self._n, self._bases, self._one_basis, lambda_hf
        view.has_base, view.has_hf, view.routed = self._has_base, hf is not None, activation["route"] is not None
        drawn = {"scales": 3, "filtered": 3, "filter": 1, "sigmoid": 1, "factor": 1, "route": 1}
        widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "rgb": 3, "basis": self._bases}
        self._gradients = (
            self._structure("activation", pulled.Activation, activation, drawn, optional=("route",)),
            self._structure("lr", pulled.Gradient, lr, widths),
            pulled.Gradient() if base is None else self._structure("base", pulled.Gradient, base, widths),
            pulled.Gradient() if hf is None else self._structure("hf", pulled.Gradient, hf, widths),
            view,
        )

    def compare(self, products: Tensor | None = None) -> Comparison:
        if self._n and not self._has_base:
            raise ValueError("there is no HR gradient to compare with.")
        if products is not None:
            self._required("products", products, (_GROUPS, self._n), torch.float64)
        counts, norms = self._blocks(sweeps.Counts, torch.int32), self._blocks(sweeps.Norms, torch.float64)
        with on_stream(self._like.device):
            self._launch_tiled(
                sweeps.compare, *self._gradients, products is not None, array(products),
                array(counts, sweeps.Counts), array(norms, sweeps.Norms),
            )  # fmt: skip
        (comparable, opposed), (norm_lr, norm_hr) = counts.sum(0).view(2, -1), norms.sum(0).view(2, -1)
        return Comparison(comparable, opposed, norm_lr, norm_hr)

    def step(self, attributes: Mapping[str, Attribute], correction: Correction | None, step: Step) -> Stepped:
        if self._n and correction is not None and not self._has_base:
            raise ValueError("there is no HR gradient to correct.")
        parameters = {name: self._attribute(name, attributes[name], width) for name, width in _WIDTHS.items()}
        bands = self._attribute("shN", attributes["shN"], math.prod(attributes["shN"].p.shape[1:]))
        if step.width % 3 or not 3 * (self._bases - 1) <= step.width <= min(bands.width, 45):
            raise ValueError(
                "width must be a multiple of 3 between the active bands' numbers and an shN row's, got "
                f"{step.width} beside {3 * (self._bases - 1)} and {bands.width}."
            )
        if step.visible is not None:
            self._required("visible", step.visible, (self._n,), torch.uint8)
        colours = self._like.new_empty(1 if self._one_basis else 2, self._n, 3)
        moving = self._like.new_empty(self._n, dtype=torch.bool)
        counts, omegas = self._blocks(sweeps.Counts, torch.int32), self._blocks(conflict.Six, torch.float64)
        (rule, *numbers), adam_step = self._rule(correction), _adam(step)
        with on_stream(self._like.device):
            self._launch_tiled(
                sweeps.step, *self._gradients, rule, *(array(x) for x in numbers), self._sweep(correction, step),
                adam_step, *parameters.values(), bands, array(step.visible), array(colours), array(moving),
                array(counts, sweeps.Counts), array(omegas, conflict.Six),
            )  # fmt: skip
            wp.launch(
                sweeps.step_bands, (self._n, step.width), device=self._device, block_dim=self._lanes,
                inputs=[
                    self._gradients[-1], array(self._like), array(self._hr_basis), array(colours),
                    array(moving), adam_step, bands,
                ],
            )  # fmt: skip
        corrected, at_lower_bound, (still, invisible) = torch.split(counts.sum(0), [_GROUPS, _GROUPS, 2])
        return Stepped(
            corrected, omegas.sum(0), at_lower_bound,
            still if step.skips else 0, 0 if step.visible is None else invisible,
        )  # fmt: skip

    @property
    def _lanes(self) -> int:
        return LANES[self._like.device.type]

    @property
    def _device(self) -> Any:
        return wp.device_from_torch(self._like.device)

    def _launch_tiled(self, kernel: Any, *arguments: Any) -> None:
        """A thread per Gaussian, in blocks that add up together."""
        wp.launch_tiled(
            kernel, dim=[-(-self._n // self._lanes)], inputs=arguments, block_dim=self._lanes, device=self._device
        )

    def _blocks(self, row: Any, dtype: torch.dtype) -> Tensor:
        """Room for what each block counts."""
        return self._like.new_empty(-(-self._n // self._lanes), len(row()), dtype=dtype)

    def _attribute(self, name: str, a: Attribute, width: int) -> Any:
        tensors = {"p": a.p, "m": a.m, "v": a.v, "anchor": a.anchor, "merged": a.merged}
        widths = dict.fromkeys(tensors, width)
        out = self._structure(name, adam.Attribute, tensors, widths, optional=("anchor", "merged"))
        out.width, out.anchored, out.merges = width, a.anchor is not None, a.merged is not None
        out.bounded = a.keep != 1 or a.limit != math.inf
        out.stiffness, out.rate, out.keep, out.limit = a.stiffness, -a.rate, a.keep, a.limit
        return out

    def _sweep(self, correction: Correction | None, step: Step) -> Any:
        out = sweeps.Sweep()
        out.lambda_hr, out.skips, out.width = step.lambda_hr, step.skips, step.width
        out.corrects, out.chooses = correction is not None, step.visible is not None
        return out

    def _rule(self, c: Correction | None) -> tuple[Any, Tensor | None, Tensor | None, Tensor | None]:
        """The settings, and ε of the cosine, ε of the correction and q where they are read."""
        rule = conflict.Rule()
        if c is None:
            return rule, None, None, None
        rule.groups = sum(on << k for k, on in enumerate(c.groups))
        rule.tolerance, rule.weight_min, rule.weight_max = c.tolerance, c.weight_min, c.weight_max
        rule.rotation_noise, rule.bounds_hold_omega = c.rotation_noise, c.bounds_hold_omega
        eps_cos, eps_corr = (
            torch.as_tensor(x, dtype=torch.float64, device=self._like.device) for x in (c.eps_cos, c.eps_corr)
        )
        if not len(c.groups) == len(eps_cos) == len(eps_corr) == _GROUPS:
            raise ValueError(f"groups, eps_cos and eps_corr must have one entry for each of {_GROUPS} conflict groups.")
        rule.judged = c.reliability is not None
        if c.reliability is not None:
            self._required("reliability", c.reliability, (self._n,), torch.float32)
        return rule, eps_cos, eps_corr, c.reliability

    def _structure(
        self,
        owner: str,
        kind: Any,
        tensors: Mapping[str, Tensor | None],
        widths: Mapping[str, int],
        optional: Sequence[str] = (),
    ) -> Any:
        """A structure of `kind` over tensors of n rows each, `widths` numbers wide."""
        fields = tuple(
            (name, self._required(name, tensors[name], (self._n, width), torch.float32).data_ptr(), self._n * width)
            for name, width in widths.items()
            if name not in optional or tensors[name] is not None
        )
        return _structure(owner, kind, fields, str(self._like.device))

    def _required(self, name: str, tensor: Tensor | None, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        device, (rows, width) = self._like.device, (shape[0], math.prod(shape[1:]))
        if tensor is None or tensor.dtype != dtype or tensor.device != device or not tensor.is_contiguous():
            where = "in the CPU's memory" if device.type == "cpu" else f"on {device}"
            raise TypeError(f"{name} must be a contiguous {str(dtype).removeprefix('torch.')} tensor {where}.")
        if tensor.dim() == 0 or tensor.shape[0] != rows or tensor.numel() != rows * width:
            raise ValueError(f"{name} must have {rows} rows of {width} numbers, got shape {tuple(tensor.shape)}.")
        return tensor


@lru_cache(maxsize=4096)
def _structure(owner: str, kind: Any, fields: tuple[tuple[str, int, int], ...], device: str) -> Any:
    """Arrays (name, address, length) in a structure of their owner's, made once for as long as they stay where they are:
    to describe a tensor to Warp takes longer than to launch a kernel. A launch copies it, with the numbers set by then.
    """
    out = kind()
    for name, address, length in fields:
        setattr(out, name, wp.array(ptr=address, dtype=wp.float32, shape=(length,), device=device))
    return out


def _adam(s: Step) -> Any:
    out = adam.AdamStep()
    out.beta1, out.beta2, out.gain1, out.gain2 = s.beta1, s.beta2, 1 - s.beta1, 1 - s.beta2
    out.per_bias2, out.eps = 1 / s.bias2, s.eps
    return out
