"""The losses, from images alone: their values and their cotangents, the gradients with respect to the render.  Eq. 4, 5"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.checks import require_choice, require_number, require_whole
from clear_strategies.core.step import Losses
from clear_strategies.errors import SettingError
from clear_strategies.kernels import losses as kernels
from clear_strategies.kernels.losses import Choice, LossAndGradient
from clear_strategies.schedules import WarmupDecay

LowFrom = Literal["lr", "hr"]


@dataclass(frozen=True, slots=True)
class Objective:
    """L = λ_LR L_LR + λ_HR(t) (L_base + λ_HF L_HF); the paper's λ_LR is 1.

    Args:
        lambda_hr: λ_HR(t).
        lambda_hf: λ_HF >= 0; 0 skips the high-frequency loss altogether.
        lambda_lr: λ_LR >= 0; at 0 the LR photos are not trained on: nothing is rendered at LR, L_LR is only logged.
        lr_from: "lr": Î_LR is rendered; "hr": it is the area mean of Î_HR, and only HR is rendered.
        lambda_ssim, lambda_ssim_hr: share of 1 - SSIM in L_LR and L_base, in [0, 1]; the rest is L1.
        haar_levels: levels of the Haar transform, at least 1; 1 is the top octave, 2 is the band that 4x SR adds (F18).
        clamp_render: compare renders clamped to [0, 1] (DropGaussian); 3DGS clamps for metrics only.
        kernels: what computes the losses: "cpp", "warp", "torch", or "auto", the fastest on the images' device.

    Raises:
        SettingError: a setting is outside its range, or no loss acts at the first iteration.
        BackendUnavailable: kernels="cpp" was not built, or "warp" is not installed.
    """

    lambda_hr: WarmupDecay = field(default_factory=WarmupDecay)
    lambda_hf: float = 0.2
    lambda_lr: float = 1.0
    lr_from: LowFrom = "lr"
    lambda_ssim: float = 0.2
    lambda_ssim_hr: float = 0.2
    haar_levels: int = 1
    clamp_render: bool = False
    kernels: Choice = "auto"

    def __post_init__(self) -> None:
        kernels.require(self.kernels)
        for name in ("lambda_ssim", "lambda_ssim_hr"):
            require_number(name, getattr(self, name), most=1)
        for name in ("lambda_lr", "lambda_hf"):
            require_number(name, getattr(self, name))
        require_choice("lr_from", self.lr_from, get_args(LowFrom))
        require_whole("haar_levels", self.haar_levels, least=1)
        if self.lambda_lr == 0 and not self.lambda_hr(1) > 0:
            raise SettingError(
                "without L_LR (lambda_lr=0) L_base must act from the first iteration, got "
                f"lambda_hr.peak={self.lambda_hr.peak}, start={self.lambda_hr.start}. Set lambda_hr.start=0 and full=0."
            )

    def weights(self, t: int) -> tuple[float, float]:
        """λ_HR(t) and λ_HR(t) λ_HF."""
        λ = self.lambda_hr(t)
        return λ, λ * self.lambda_hf

    def lr(
        self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"] | None = None
    ) -> Losses:
        """L_LR, and the cotangent of λ_LR L_LR.

        Args:
            shown: where it is False, the target counts as equal to the image, and the cotangent is 0.
        """
        compared, target = self._compared(image, target, shown)
        cotangents = compared.new_empty(1, *compared.shape)
        loss = kernels.photometric(compared, target, self.lambda_ssim, kernels=self.kernels, out=cotangents[0])  # Eq. 4
        if self.lambda_lr != 1:
            cotangents *= self.lambda_lr
        return self._losses({"lr": loss}, image, cotangents, shown)

    def hr(
        self,
        image: Float[Tensor, "H W 3"],
        target: Float[Tensor, "H W 3"],
        shown: Bool[Tensor, "H W"] | None = None,
        reuse: Float[Tensor, "K h w 3"] | None = None,
    ) -> Losses:
        """L_base and L_HF, two cotangents; L_base alone where λ_HF = 0. `shown` as for `lr`.

        Args:
            reuse: cotangents of an earlier call that are no longer needed; their memory is used if it fits.
        """
        (compared, target), use = self._compared(image, target, shown), self.kernels
        shape = (2 if self.lambda_hf > 0 else 1, *compared.shape)
        if reuse is None or (reuse.shape, reuse.dtype, reuse.device) != (shape, compared.dtype, compared.device):
            reuse = compared.new_empty(shape)
        cotangents: Tensor = reuse
        base = kernels.photometric(compared, target, self.lambda_ssim_hr, kernels=use, out=cotangents[0])  # Eq. 5
        losses = {"base": base}
        if self.lambda_hf > 0:
            losses["hf"] = kernels.haar_l1(compared, target, self.haar_levels, kernels=use, out=cotangents[1])  # Eq. 5
        return self._losses(losses, image, cotangents, shown)

    def _compared(
        self, image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"] | None
    ) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
        """Both images as the losses compare them, equal where the target is hidden."""
        image = image.clamp(0, 1) if self.clamp_render else image
        return image, target if shown is None else torch.where(shown[..., None], target, image)

    def _losses(
        self,
        losses: Mapping[str, LossAndGradient],
        image: Float[Tensor, "H W 3"],
        cotangents: Float[Tensor, "K H W 3"],
        shown: Bool[Tensor, "H W"] | None,
    ) -> Losses:
        if shown is not None:
            cotangents *= shown[..., None]
        if self.clamp_render:
            cotangents *= (image >= 0) & (image <= 1)
        return Losses({name: deferred.scalar(loss.value) for name, loss in losses.items()}, cotangents)
