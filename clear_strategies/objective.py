"""Floor 3: what the images should look like. Images in, losses and image-space cotangents out; knows no Gaussian.
Eq. 4, 5
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

from clear_strategies import kernels
from clear_strategies.kernels import Choice, LossAndGradient
from clear_strategies.schedules import WarmupDecay


class Losses(NamedTuple):
    """Scalars by name, and the cotangents of one image in the order of the names."""

    values: Mapping[str, float]
    cotangents: Float[Tensor, "K H W 3"]


@dataclass(frozen=True, slots=True)
class Objective:
    """L = L_LR + λ_HR(t) (L_base + λ_HF L_HF).

    Args:
        lambda_hr: λ_HR(t).
        lambda_hf: λ_HF >= 0; 0 skips the high-frequency loss altogether.
        lambda_ssim, lambda_ssim_hr: share of 1 - SSIM in L_LR and L_base, in [0, 1]; the rest is L1.
        haar_levels: levels of the Haar transform; 1 is the top octave, 2 is exactly the band that 4x SR adds.
        clamp_render: compare renders clamped to [0, 1] (DropGaussian); 3DGS clamps for metrics only.
        kernels: what computes the losses: "cpp", "torch", or "auto", the fastest that runs here.

    Raises:
        ValueError: a setting is outside its range.
        BackendUnavailable: kernels="cpp" was not built.
    """

    lambda_hr: WarmupDecay = field(default_factory=WarmupDecay)
    lambda_hf: float = 0.2
    lambda_ssim: float = 0.2
    lambda_ssim_hr: float = 0.2
    haar_levels: int = 1
    clamp_render: bool = False
    kernels: Choice = "auto"

    def __post_init__(self) -> None:
        kernels.require(self.kernels)
        for name in ("lambda_ssim", "lambda_ssim_hr"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must lie in [0, 1], got {getattr(self, name)}.")
        if self.lambda_hf < 0:
            raise ValueError(f"lambda_hf must be >= 0, got {self.lambda_hf}.")
        if self.haar_levels < 1:
            raise ValueError(f"haar_levels must be at least 1, got {self.haar_levels}.")

    def lr(self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Losses:
        """L_LR, one cotangent."""
        shown = self._shown(image)
        cotangents = shown.new_empty(1, *shown.shape)
        loss = kernels.photometric(shown, target, self.lambda_ssim, kernels=self.kernels, out=cotangents[0])  # Eq. 4
        return self._losses({"lr": loss}, image, cotangents)

    def hr(self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"]) -> Losses:
        """L_base and L_HF, two cotangents; L_base alone where λ_HF = 0."""
        shown, use = self._shown(image), self.kernels
        cotangents = shown.new_empty(2 if self.lambda_hf > 0 else 1, *shown.shape)
        base = kernels.photometric(shown, target, self.lambda_ssim_hr, kernels=use, out=cotangents[0])  # Eq. 5
        losses = {"base": base}
        if self.lambda_hf > 0:
            losses["hf"] = kernels.haar_l1(shown, target, self.haar_levels, kernels=use, out=cotangents[1])  # Eq. 5
        return self._losses(losses, image, cotangents)

    def _shown(self, image: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
        return image.clamp(0, 1) if self.clamp_render else image

    def _losses(
        self,
        losses: Mapping[str, LossAndGradient],
        image: Float[Tensor, "H W 3"],
        cotangents: Float[Tensor, "K H W 3"],
    ) -> Losses:
        if self.clamp_render:
            cotangents *= (image >= 0) & (image <= 1)
        return Losses({name: float(loss.value) for name, loss in losses.items()}, cotangents)
