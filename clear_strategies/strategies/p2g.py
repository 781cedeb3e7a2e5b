"""P2G: evidence-guided patch-to-Gaussian routing.  Eq. 9, 10, 12, 14

For each patch of a view, P2G estimates how well the SR image agrees with the authentic LR photo and how
much detail it adds. Each Gaussian looks both up at its projected centre; they weight its high-frequency
gradient and its densification.
"""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.weak import TensorWeakRef

from clear_strategies.core.checks import refuse, require_choice, require_number, require_whole
from clear_strategies.core.evidence import Evidence, PatchMaps
from clear_strategies.core.gradients import ScreenGradients, Shot
from clear_strategies.core.images import DownKernel, downsample, patch_means, quantize, upsample
from clear_strategies.core.step import Step
from clear_strategies.core.view import View
from clear_strategies.kernels import per_gaussian
from clear_strategies.strategies.base import Strategy
from rasterizers.torch_internals import version

_log = logging.getLogger(__name__)

ScoreBy = Literal["evidence", "gradient", "sum"]


@dataclass(frozen=True)
class P2G(Strategy):
    """Weigh SR detail by evidence.

    Args:
        reliability_scale: τ_r > 0, the mean |D(I_HR) - I_LR| (images in [0, 1]) at which R falls to 1/e; "relative:k" is k
            times the view's own mean, so that R covers its range whatever the prior is.
        floor: q_min in [0, 1], the share of its high-frequency gradient that every Gaussian keeps.
        normalize: divide m by its mean over the visible Gaussians. Detail then moves to where it is reliable and needed;
            as printed, m <= 1 only ever takes detail away, 60 % of it on average (F25).
        patch: edge of a patch in LR pixels; in HR pixels it is that times the SR factor.
        down: D, the operator that made the LR images (F21).
        detail_eps: ε of Eq. 9, image units; below it (1/40 of a grey level) differences are rounding, not detail (F23).
        score_by: the densification score: "evidence" S_i alone (the paper; large splats of a sparse initial cloud then
            rarely split), the ordinary "gradient", or their "sum" at equal mean (F9).

    Raises:
        SettingError: a setting is outside its range.
    """

    reliability_scale: float | str = 0.01
    floor: float = 0.25
    normalize: bool = True
    patch: int = 16
    down: DownKernel = "bicubic"
    detail_eps: float = 1e-4
    score_by: ScoreBy = "sum"

    def __post_init__(self) -> None:
        _tau_r(self.reliability_scale, 1.0)
        require_number("floor", self.floor, most=1)
        require_whole("patch", self.patch, least=1)
        require_number("detail_eps", self.detail_eps, above=0)
        for name, kind in (("down", DownKernel), ("score_by", ScoreBy)):
            require_choice(name, getattr(self, name), get_args(kind))

    def observe(self, step: Step, hr: Shot) -> Evidence:
        """q_i and a_i of every Gaussian that is visible in this view."""
        maps = self.looked_up(step.view) if step.looked_up is None else step.looked_up
        edge, visible = self.patch * step.view.factor, hr.visible
        e = per_gaussian.evidence(maps, hr.means2d, visible, edge)  # R and A at p(u_i)  Eq. 10
        self.log("mean_q", lambda: e.means(visible)[0])
        self.log("mean_w", lambda: e.means(visible)[1])
        return e

    def route(self, step: Step) -> Float[Tensor, " N"]:
        """m_i = q_min + (1 - q_min) w_i, over its mean where `normalize`; undefined for invisible Gaussians."""
        if step.evidence is None or step.visible is None:
            raise ValueError("P2G routes by evidence, but there is none for this view; call P2G.observe first.")
        return per_gaussian.route(step.evidence, step.visible, self.floor, self.normalize)  # Eq. 12

    def score(self, step: Step, screen: ScreenGradients) -> Float[Tensor, " N"] | None:
        """S_i = w_i ‖∇_u L_HF‖, alone or joined with the ordinary statistic; None (ordinary) where λ_HF = 0."""
        e = step.evidence
        if self.score_by == "gradient" or e is None or screen.hf is None:
            return None
        return per_gaussian.evidence_score(e, screen.hf, screen.ordinary, self.score_by == "sum")  # Eq. 14

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        if lambda_hr == 0:
            return "lambda_HR is 0 throughout"
        return "lambda_HF is 0, and it routes the high-frequency loss alone" if lambda_hf == 0 else None

    def patch_maps(self, view: View) -> PatchMaps:
        """R and A of this view."""
        return PatchMaps(*self.patch_evidence(view.lr.image, view.hr.image, view.factor, view.disagreement), self.patch)

    def patch_evidence(
        self,
        lr: Float[Tensor, "h w 3"],
        hr: Float[Tensor, "H W 3"],
        factor: int,
        disagreement: Float[Tensor, "h w 3"] | None = None,
    ) -> tuple[Float[Tensor, "ph pw"], Float[Tensor, "ph pw"]]:
        """R_p, agreement with the LR photo, and A_p, share of detail relative to twice the image's mean.  Eq. 9

        A is 0 in a flat image, and 1/2 in a patch with the image's mean detail.

        Args:
            disagreement: in place of |D(I_HR) - I_LR|, see `View.disagreement`.

        Raises:
            ValueError: an image lies outside [0, 1] (τ_r and ε are in that unit).
        """
        for name, image in (("I_LR", lr), ("I_HR", hr)):
            low, high = float(image.min()), float(image.max())
            if not (low >= -1e-3 and high <= 1 + 1e-3):
                raise ValueError(f"{name} must lie in [0, 1], got {low:.3g}..{high:.3g}. Divide 8-bit values by 255.")
        reduced = downsample(hr, factor, self.down)
        if disagreement is None:
            disagreement = (reduced - lr).abs()
        tau_r = _tau_r(self.reliability_scale, float(disagreement.mean()))
        R = torch.exp(-patch_means(disagreement, self.patch) / tau_r)  # Eq. 9
        # All kernels of D but "area" round to 8 bits. In an SR image with more bits, what rounding loses is not detail.
        shown = hr if self.down == "area" else quantize(hr)
        residual = (shown - upsample(reduced, factor)).abs()
        A = (patch_means(residual, self.patch * factor) / (2 * residual.mean() + self.detail_eps)).clamp(0, 1)  # Eq. 9
        return R, A

    def looked_up(self, view: View) -> Float[Tensor, "2 ph pw"]:
        """R and A, computed anew where a view of this name has other images, such as another crop of its photo."""
        key, images = (view.name, view.factor), [view.lr.image, view.hr.image]
        images += [] if view.disagreement is None else [view.disagreement]
        known: _LookedUp | None = self.cache.get(key)
        if known is not None and known.is_of(images):
            return known.maps
        # A loop that keeps its images needs no digest; for one that reads them anew, it takes an eighth of the time of the maps.
        digest = None if known is None else _digest(images)
        if known is None or known.digest != digest:
            maps = self.patch_maps(view)
            R, A = maps.reliability, maps.demand
            _log.debug(
                "%s: reliability R %.2f..%.2f (mean %.3f), detail demand A mean %.3f over %dx%d patches.",
                view.name, float(R.min()), float(R.max()), float(R.mean()), float(A.mean()), R.shape[1], R.shape[0],
            )  # fmt: skip
            known = _LookedUp((), digest, torch.stack((R, A)))
        self.cache[key] = known._replace(images=[(TensorWeakRef(x), version(x)) for x in images])
        return known.maps


class _LookedUp(NamedTuple):
    """R and A of a view.

    Args:
        images: what they were computed from, each with its version; a loop may free them.
        digest: of their content; None for the first images of a view.
    """

    images: Sequence[tuple[TensorWeakRef, int]]
    digest: bytes | None
    maps: Float[Tensor, "2 ph pw"]

    def is_of(self, images: Sequence[Tensor]) -> bool:
        """Return True if these are the images, and no operation has changed them."""
        return len(images) == len(self.images) and all(
            of() is x and seen == version(x) for (of, seen), x in zip(self.images, images, strict=True)
        )


def _digest(images: Sequence[Tensor]) -> bytes:
    digest = hashlib.sha256(repr([x.shape for x in images]).encode())
    for x in images:
        digest.update(x.detach().contiguous().cpu().numpy().data)
    return digest.digest()


# Rounding to 8 bits changes an image by a quarter of a grey level on average; a smaller scale would measure rounding.
_ROUNDING: Final = 0.25 / 255


def _tau_r(scale: float | str, mean: float) -> float:
    """τ_r of a view with this mean disagreement."""
    kind, _, number = str(scale).rpartition(":")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if kind not in ("", "relative") or not 0 < value < math.inf:
        refuse("reliability_scale", 'must be a number > 0, or "relative:<number > 0>"', scale, "reliability_scale=0.01")
    return value * max(mean, _ROUNDING) if kind else value
