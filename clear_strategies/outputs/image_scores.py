"""Image quality against the truth, in four numbers that need no trained network.

- **PSNR**, dB, and **SSIM**, as scikit-image defines them with data range 1; SSIM with the window of the paper (Wang et
  al. 2004: Gaussian, σ = 1.5, population covariance). Other definitions differ by as much as a row of an ablation.
- **GMSD**, gradient magnitude similarity deviation (Xue et al. 2014), 0 is perfect: how unevenly edges are preserved. It
  responds to wrong structure (ghosts, warped edges, floaters) that a mean over pixels hides.
- **Blur**, scikit-image's `blur_effect` (Crete et al. 2007) minus that of the truth, 0 is perfect: above 0 the image is
  blurrier than the truth, below 0 it has more fine contrast, such as invented texture.

On photographs of six real scenes each of the four ranks the truth first, then a ×4 network, bicubic ×4 and bicubic ×8.
Only PSNR, SSIM and GMSD respond to a shift by two pixels: blur ignores where contrast is. Noise on a blurred image brings
blur back to 0 while GMSD rises, so read the two together.

A run may add metrics of its own (`metrics.*`), such as LPIPS, which needs one.

Only shown pixels count: at pixels that a mask hides, the image is replaced by the truth, and PSNR, SSIM and GMSD leave them out.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core.view import SMALLEST
from clear_strategies.errors import one_line
from clear_strategies.kernels import native
from rasterizers.native import threads

_log = logging.getLogger(__name__)

Metric = Callable[[Tensor, Tensor], Any]
"""Computes a number, or a tensor with one element, from an image and the truth."""

PSNR_CAP: Final = 100.0  # dB, the PSNR of identical images
_GMSD_C: Final = 170 / 255**2
_LUMINANCE: Final = np.array([0.299, 0.587, 0.114])
_REACH: Final = 5  # of the window of SSIM: those that lie inside the image count


class ImageScores(msgspec.Struct, frozen=True, omit_defaults=True):
    """PSNR in dB, at most `PSNR_CAP`, and SSIM: more is better. GMSD: less is better. Blur: closer to 0 is better.

    Args:
        own: of the run's own metrics, by name.
    """

    psnr: float
    ssim: float
    gmsd: float
    blur: float
    own: dict[str, float] = msgspec.field(default_factory=dict)


class Truth:
    """The image that others are compared with, and the parts of the scores that depend on it alone.

    Args:
        shown: False at pixels that do not count: there the image is replaced by the truth. At least one is True. None: all count.
        own: metrics by name, of an image and the truth, both [H, W, 3] in [0, 1] on the CPU. One that raises gives NaN.
    """

    def __init__(
        self,
        image: Float[Tensor, "H W 3"],
        shown: Bool[Tensor, "H W"] | None = None,
        own: Mapping[str, Metric] | None = None,
    ) -> None:
        if min(image.shape[:2]) < SMALLEST:
            raise ValueError(f"images must be at least {SMALLEST} pixels on each side, got {tuple(image.shape)}.")
        self.image = image.detach().clamp(0, 1).cpu()
        self.shown = None if shown is None or bool(shown.all()) else shown.cpu()
        self.own = own or {}
        grey = _grey(self.image)
        self.edges, self.blur = _gradient_at_half_size(grey), _blur(grey)

    def score(self, image: Float[Tensor, "H W 3"]) -> ImageScores:
        """Compare an image, clamped to [0, 1], with the truth. All scores of an image that is not finite are NaN."""
        if image.shape != self.image.shape:
            sizes = f"{tuple(image.shape)} and {tuple(self.image.shape)}"
            raise ValueError(f"images must have the same size, got {sizes}.")
        if not bool(image.isfinite().all()):
            return ImageScores(math.nan, math.nan, math.nan, math.nan, own=dict.fromkeys(self.own, math.nan))
        image = image.detach().clamp(0, 1).cpu()
        if self.shown is not None:
            image = torch.where(self.shown[..., None], image, self.image)
        share = 1.0 if self.shown is None else float(self.shown.double().mean())
        mse = float((image - self.image).square().mean(dtype=torch.float64)) / share
        psnr = min(PSNR_CAP, 10 * math.log10(1 / mse)) if mse > 0 else PSNR_CAP
        grey = _grey(image)
        gmsd = _gmsd(_gradient_at_half_size(grey), self.edges, self.shown)
        own = {name: _measured(name, metric, image, self.image) for name, metric in self.own.items()}
        return ImageScores(psnr, _ssim(image, self.image, self.shown), gmsd, _blur(grey) - self.blur, own=own)


def mean_scores(scores: Sequence[ImageScores]) -> ImageScores:
    """The mean of each number of one or more images."""
    *four, own = zip(*map(msgspec.structs.astuple, scores), strict=True)
    means = {name: sum(numbers[name] for numbers in own) / len(own) for name in own[0]}
    psnr, ssim, gmsd, blur = (sum(numbers) / len(numbers) for numbers in four)
    return ImageScores(psnr, ssim, gmsd, blur, means)


@torch.no_grad()  # the mode is per thread
def _measured(name: str, metric: Metric, image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
    try:
        return float(metric(image, truth))
    except Exception as error:  # of a metric of the user's; the run must not fail by it
        _log.warning("metrics.%s: left out, %s: %s", name, type(error).__name__, one_line(error))
        return math.nan


def _ssim(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"], shown: Bool[Tensor, "H W"] | None) -> float:
    """Mean SSIM of the windows that lie inside the image about shown pixels: without a mask by the loss's kernel, in a thirtieth
    of scikit-image's time; they differ by less than 1e-6.
    """
    if shown is None and native.available():
        images = x.float().contiguous(), y.float().contiguous()
        _, dissimilarity = native.module().photometric(*images, None, 0.0, 1.0, _REACH, threads())
        return float(1 - dissimilarity)
    from skimage.metrics import structural_similarity

    how = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0, "channel_axis": 2}
    mean, values = structural_similarity(x.double().numpy(), y.double().numpy(), full=True, **how)
    if shown is None:
        return float(mean)
    within = np.s_[_REACH:-_REACH, _REACH:-_REACH]
    if bool(shown[within].any()):  # else only pixels beside the border are shown
        shown, values = shown[within], values[within]
    return float(values[shown.numpy()].mean())


def _grey(image: Float[Tensor, "H W 3"]) -> np.ndarray:
    return np.asarray(image.double().numpy() @ _LUMINANCE)


def _blur(grey: np.ndarray) -> float:
    from skimage.measure import blur_effect

    return float(blur_effect(grey))


def _gmsd(gx: np.ndarray, gy: np.ndarray, shown: Bool[Tensor, "H W"] | None) -> float:
    """Standard deviation of the similarity of two gradient magnitudes, over pixels at half size that are shown in part."""
    similarity = (2 * gx * gy + _GMSD_C) / (gx**2 + gy**2 + _GMSD_C)
    return float((similarity if shown is None else similarity[_at_half_size(shown.double().numpy()) > 0]).std())


def _gradient_at_half_size(image: np.ndarray) -> np.ndarray:
    """The magnitude of Prewitt's gradient of the image at half size."""
    from skimage.filters import prewitt_h, prewitt_v

    half = _at_half_size(image)
    return np.asarray(np.hypot(prewitt_h(half), prewitt_v(half)))


def _at_half_size(image: np.ndarray) -> np.ndarray:
    """Means of 2 x 2 pixels. The last row and column of an odd size count twice."""
    h, w = image.shape
    even = np.pad(image, ((0, h % 2), (0, w % 2)), mode="edge")
    return np.asarray(even.reshape((h + 1) // 2, 2, (w + 1) // 2, 2).mean(axis=(1, 3)))
