"""How good an image is, without a learned judge: four numbers, and their table over a scene.

- **PSNR**, dB, and **SSIM**, both as scikit-image defines them, data range 1; SSIM with the window of its first paper
  (Wang et al. 2004: Gaussian, σ = 1.5, population covariance). Other definitions differ by as much as an ablation row.
- **GMSD**, gradient magnitude similarity deviation (Xue et al. 2014), 0 is perfect: how unevenly edges are preserved. It
  notices wrong structure (ghosts, warped edges, floaters) that a mean hides.
- **Blur**, scikit-image's `blur_effect` (Crete et al. 2007) minus that of the truth, 0 is perfect: above, the image is
  blurrier than the truth; below, it has more fine contrast than the truth, as invented texture does.

On photographs of six real scenes each of the four ranks truth, a ×4 network, bicubic ×4, bicubic ×8 in this order, and
GMSD alone of the last two sees a shift by two pixels. Blur has no notion of place: noise on a blurred image brings it
back to 0 while GMSD rises, so read the two together.

metrics.json: {"scene", "method", "strategies", "seed", "iterations", "gaussians", "seconds", "conflict",
"synthetic_prior", "note", "test": TABLE, "train": TABLE, "provenance"}, where TABLE is {"against", "views": {view:
{image: scores}}, "mean": {image: scores}}. "method" is the baseline's name, null where none was asked for. The images
are "ours", "bicubic" (U of the view's own LR photo) and "prior" (its SR reference); `against` says what they were
compared with: "HR photos", or "LR photos" after D where HR is unknown, or "HR and LR photos" where that differs between
views. A number that is not finite is null.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final

import numpy as np
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.view import View
from clear_strategies.data.scene import Scene
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

PSNR_CAP: Final = 100.0  # of identical images, dB
_SMALLEST: Final = 12  # GMSD halves the image and needs a window left
_GMSD_C: Final = 170 / 255**2
NOTE: Final = (
    "bicubic and prior see the view's own LR photo, which a render of a test view never does: they bound what "
    "appearance could be, they synthesise no view"
)


@dataclass(frozen=True, slots=True)
class ImageScores:
    """PSNR in dB, at most `PSNR_CAP`, and SSIM: more is better. GMSD: less is better. Blur: nearer to 0 is better."""

    psnr: float
    ssim: float
    gmsd: float
    blur: float


Table = dict[str, dict[str, ImageScores]]
"""view -> method -> scores."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Scores of every view and method, what each part was compared with, and the renders of the test views."""

    test: Table
    train: Table
    against: Mapping[str, str]
    renders: Mapping[str, Float[Tensor, "H W 3"]]

    def mean(self, part: str, method: str = "ours") -> ImageScores | None:
        """Mean over the views of a part ("test", "train") that have this method."""
        return mean_scores([row[method] for row in getattr(self, part).values() if method in row])


def score(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> ImageScores:
    """Compare an image, clamped to [0, 1], with the truth. An image that is not finite scores NaN throughout.

    Raises:
        ValueError: sizes differ, or are too small to be compared.
    """
    from skimage.metrics import structural_similarity

    if image.shape != truth.shape:
        raise ValueError(f"images of one size can be compared, got {tuple(image.shape)} and {tuple(truth.shape)}.")
    if min(image.shape[:2]) < _SMALLEST:
        raise ValueError(f"images must be at least {_SMALLEST} pixels on each side, got {tuple(image.shape)}.")
    if not bool(image.isfinite().all()):
        return ImageScores(math.nan, math.nan, math.nan, math.nan)
    x, y = (photo.detach().clamp(0, 1).double().cpu().numpy() for photo in (image, truth))
    mse = float(np.mean((x - y) ** 2))
    ssim = structural_similarity(
        x, y, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0, channel_axis=2
    )
    grey_x, grey_y = _luminance(x), _luminance(y)
    psnr = min(PSNR_CAP, 10 * math.log10(1 / mse)) if mse > 0 else PSNR_CAP
    return ImageScores(psnr, float(ssim), _gmsd(grey_x, grey_y), _blur(grey_x) - _blur(grey_y))


def mean_scores(scores: Sequence[ImageScores]) -> ImageScores | None:
    """Each number's mean; None of nothing."""
    if not scores:
        return None
    return ImageScores(*(sum(getattr(s, f.name) for s in scores) / len(scores) for f in fields(ImageScores)))


def evaluate(
    scene: Scene, render: Callable[[Camera], Float[Tensor, "H W 3"]], *, down: DownKernel = "bicubic"
) -> Evaluation:
    """Render and score every view. Where HR is unknown, D of the render is compared with the LR photo."""
    renders: dict[str, Tensor] = {}
    tables: dict[str, Table] = {"test": {}, "train": {}}
    against = {"test": _against(scene.test), "train": _against(scene.train)}
    for part, views in (("test", scene.test), ("train", scene.train)):
        for view in views:
            image = render(view.hr.camera).clamp(0, 1)
            if not bool(image.isfinite().all()):
                _log.warning("%s: its render is not finite and has no scores.", view.name)
            if part == "test":
                renders[view.name] = image
            tables[part][view.name] = _scores_of(view, image, down)
        if "LR" in against[part]:
            _log.info("%s views: HR is unknown; images reduced by %s were compared with the LR photos.", part, down)
    return Evaluation(tables["test"], tables["train"], against, renders)


def to_json(evaluation: Evaluation, **facts: Any) -> dict[str, Any]:
    """The content of metrics.json; `facts` are its other keys."""
    content: dict[str, Any] = {**facts, "note": NOTE}
    for part in ("test", "train"):
        table: Table = getattr(evaluation, part)
        methods = sorted({method for row in table.values() for method in row})
        means = {method: evaluation.mean(part, method) for method in methods}
        content[part] = {
            "against": evaluation.against[part],
            "views": {view: {m: asdict(s) for m, s in row.items()} for view, row in table.items()},
            "mean": {method: asdict(mean) for method, mean in means.items() if mean is not None},
        }
    return content


def _against(views: Sequence[View]) -> str:
    kinds = {"LR" if view.truth is None else "HR" for view in views}
    return f"{' and '.join(sorted(kinds))} photos" if kinds else "nothing"


def _scores_of(view: View, image: Float[Tensor, "H W 3"], down: DownKernel) -> dict[str, ImageScores]:
    if view.truth is None:
        reduced = images.downsample(image, view.factor, down)
        reference = images.downsample(view.hr.image, view.factor, down)
        return {"ours": score(reduced, view.lr.image), "prior": score(reference, view.lr.image)}
    return {
        "ours": score(image, view.truth),
        "bicubic": score(images.upsample(view.lr.image, view.factor), view.truth),
        "prior": score(view.hr.image, view.truth),
    }


def _luminance(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb @ np.array([0.299, 0.587, 0.114]))


def _gmsd(x: np.ndarray, y: np.ndarray) -> float:
    """Standard deviation of the similarity of Prewitt gradient magnitudes, at half size."""
    gx, gy = _gradient(_halved(x)), _gradient(_halved(y))
    similarity = (2 * gx * gy + _GMSD_C) / (gx**2 + gy**2 + _GMSD_C)
    return float(similarity.std())


def _halved(image: np.ndarray) -> np.ndarray:
    h, w = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    return np.asarray(image[:h, :w].reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3)))


def _gradient(image: np.ndarray) -> np.ndarray:
    from skimage.filters import prewitt_h, prewitt_v

    return np.asarray(np.hypot(prewitt_h(image), prewitt_v(image)))


def _blur(image: np.ndarray) -> float:
    from skimage.measure import blur_effect

    return float(blur_effect(image))
