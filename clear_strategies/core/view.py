"""A view of a scene at two scales: the photos at LR and HR, their cameras, and the depth of what they show."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from rasterizers.interface import Camera, Color
from rasterizers.sending import color_on

SMALLEST: Final = 12
"""Pixels on each side of what can be scored: GMSD halves the image, and SSIM needs room for its window."""
_WHOLE: Final = 0.99  # least share of a resized pixel that the mask shows, for the pixel to be shown
_KNOWN_SHARE: Final = 0.3  # of a block's pixels, for its depth to be known
_ONE_SURFACE: Final = 1.05  # ratio of two depths, up to which a depth between them lies on their surface


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """An image, float32 in [0, 1], and the camera on its pixel grid.

    Args:
        shown: False at hidden pixels (a mask): no loss compares them, and they have no depth. None: every pixel is shown.
        transparency: 1 - alpha, in [0, 1]: how far the background shows through. None: the photo has no alpha.
    """

    camera: Camera
    image: Float[Tensor, "H W 3"]
    shown: Bool[Tensor, "H W"] | None = None
    transparency: Float[Tensor, "H W"] | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.image.shape)
        if shape != (self.camera.height, self.camera.width, 3):
            raise ValueError(
                f"an image of {self.camera.width}x{self.camera.height} pixels has shape "
                f"({self.camera.height}, {self.camera.width}, 3), got {shape}."
            )
        for name in ("shown", "transparency"):
            if (layer := getattr(self, name)) is not None and layer.shape != shape[:2]:
                raise ValueError(f"{name} must be {shape[:2]}, one value for each pixel, got {tuple(layer.shape)}.")

    @property
    def visible(self) -> Bool[Tensor, "H W"]:
        """`shown`, or True everywhere without a mask."""
        if self.shown is not None:
            return self.shown
        return torch.ones(self.image.shape[:2], dtype=torch.bool, device=self.image.device)

    def to(self, device: torch.device | str) -> Photo:
        """The same photo with its image on `device`. The camera stays on the CPU, where kernels read its numbers."""
        return self._with(self.camera, lambda layer: layer.to(device))

    def _with(self, camera: Camera, change: Callable[[Tensor], Tensor]) -> Photo:
        """The photo with the same change of image, mask and transparency, as far as it has them."""
        shown, transparency = (None if x is None else change(x) for x in (self.shown, self.transparency))
        return Photo(camera, change(self.image), shown, transparency)

    def over(self, color: Color | None, background: Color) -> Photo:
        """The photo composited over `color` instead of `background`, and then opaque; itself if `color` is None."""
        if color is None or self.transparency is None:
            return self
        old, new = (color_on(c, self.image.device, self.image.dtype)[0] for c in (background, color))
        image = (self.image + self.transparency[..., None] * (new - old)).clamp(0, 1)
        return replace(self, image=image, transparency=None)

    def factor_to(self, max_pixels: int) -> int:
        """The smallest whole factor by which `reduced` gives at most `max_pixels`."""
        width, height = self.camera.width, self.camera.height
        return next(k for k in itertools.count(1) if (width // k) * (height // k) <= max_pixels)

    def cropped(self, multiple: int) -> Photo:
        """Without rows at the bottom and columns at the right, so that `multiple` divides both sizes."""
        height, width = (size - size % multiple for size in self.image.shape[:2])
        return self._with(replace(self.camera, width=width, height=height), lambda layer: layer[:height, :width])

    def resized(self, camera: Camera, kernel: DownKernel, layers: DownKernel | None = None) -> Photo:
        """The photo at the size of `camera`, which sees the same, by the operator D. A pixel is shown if its whole area is.

        Args:
            layers: D of the mask and the transparency; None: `kernel`.
        """
        size = (camera.width, camera.height)

        def layer(values: Float[Tensor, "H W"]) -> Float[Tensor, "h w"]:
            return images.resize(images.as_rgb(values), size, layers or kernel).mean(dim=2)

        shown = None if self.shown is None else layer(self.shown.float()) > _WHOLE
        through = None if self.transparency is None else layer(self.transparency)
        return Photo(camera, images.resize(self.image, size, kernel), shown, through)

    def reduced(self, factor: int) -> Photo:
        """The mean of each block of `factor` × `factor` pixels, hidden if one of them is. Pixels that fill no block, at the right
        and bottom, are cut off.
        """
        if factor == 1:
            return self
        whole = self.cropped(factor)

        def mean(layer: Tensor) -> Tensor:
            return images.area_mean(layer[..., None], factor)[..., 0]

        shown = None if whole.shown is None else mean(whole.shown.float()) == 1
        through = None if whole.transparency is None else mean(whole.transparency)
        return Photo(whole.camera.scaled(1 / factor), images.area_mean(whole.image, factor), shown, through)


@dataclass(frozen=True, slots=True, eq=False)
class DepthMap:
    """The depth of a photo's surfaces, as far as it is known.

    Args:
        depth: z in world units at each pixel's centre; nan where unknown.
        confidence: in [0, 1]; 0 where unknown.
    """

    depth: Float[Tensor, "h w"]
    confidence: Float[Tensor, "h w"]

    @property
    def known(self) -> Bool[Tensor, "h w"]:
        """Where there is depth."""
        return self.confidence > 0

    @property
    def coverage(self) -> float:
        """The share of pixels with depth."""
        return float(self.known.float().mean())

    def reduced(self, factor: int) -> DepthMap:
        """The median depth of each block of `factor` × `factor` pixels, and their mean confidence; unknown where less than
        `_KNOWN_SHARE` of them are known.
        """
        if factor == 1:
            return self
        depth, confidence = (
            x.unfold(0, factor, factor).unfold(1, factor, factor).flatten(2) for x in (self.depth, self.confidence)
        )
        known = (confidence > 0).float().mean(dim=-1)
        enough = known >= _KNOWN_SHARE
        mean = confidence.mean(dim=-1) / known.clamp_min(torch.finfo(known.dtype).tiny)
        nearer, farther = depth.nanmedian(dim=-1).values, -(-depth).nanmedian(dim=-1).values  # the two in the middle
        median = torch.where(farther <= _ONE_SURFACE * nearer, (nearer + farther) / 2, nearer)
        return DepthMap(torch.where(enough, median, torch.nan), torch.where(enough, mean, 0.0))

    def completed_by(self, other: DepthMap) -> DepthMap:
        """This map, and `other`, a map of the same photo, where depth is unknown."""
        depth = torch.where(self.known, self.depth, other.depth)
        return DepthMap(depth, torch.where(self.known, self.confidence, other.confidence))

    def to(self, device: torch.device | str) -> DepthMap:
        return DepthMap(self.depth.to(device), self.confidence.to(device))


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One view v: I_LR^v, I_HR^v and C^v at both scales; HR is exactly an integer times LR.

    Args:
        lr: the authentic low-resolution photo.
        hr: the super-resolved (SR) image of the prior.
        truth: the real photo at HR beside it, for evaluation only; None where it is unknown.
        sr_source: the prior's label, e.g. "onnx span_x4.onnx".
        depth: of the photo's surfaces, from stereo, on the pixels of `depth_photo`; None where nothing needs it, e.g. in
            test views.
        disagreement: |D(I) - I_LR| of the network's SR image I, by which P2G measures reliability. Back-projection, which makes
            `hr` of I, removes this difference. None if `hr` is I itself.
        background: RGB in [0, 1] behind the scene; pixels of this colour belong to no surface.
        hr_is_photo: `hr` is the photo itself in place of an SR image (`data.views.photos_are=both`).
    """

    name: str
    lr: Photo
    hr: Photo
    truth: Float[Tensor, "H W 3"] | None = None
    sr_source: str = "unknown"
    depth: DepthMap | None = None
    disagreement: Float[Tensor, "h w 3"] | None = None
    background: Color = (0.0, 0.0, 0.0)
    hr_is_photo: bool = False

    @property
    def factor(self) -> int:
        """HR pixels per LR pixel."""
        return self.hr.camera.width // self.lr.camera.width

    @property
    def true_hr(self) -> Float[Tensor, "H W 3"] | None:
        """The real photo at HR, whether `hr` is that or not; None where it is unknown."""
        return self.hr.image if self.hr_is_photo else self.truth

    @property
    def depth_photo(self) -> Photo:
        """The photo that `depth` belongs to: `lr`, or if HR is a photo too, `hr` reduced to the size of the depth map."""
        if self.depth is None or self.depth.depth.shape == self.lr.image.shape[:2]:
            return self.lr
        return self.hr.reduced(self.hr.camera.width // self.depth.depth.shape[1])

    def hiding(self, shown: Bool[Tensor, "h w"]) -> View:
        """The same view, at both scales without the LR pixels where `shown` is False."""
        fine = shown.repeat_interleave(self.factor, 0).repeat_interleave(self.factor, 1)
        return replace(self, lr=replace(self.lr, shown=shown), hr=replace(self.hr, shown=fine))

    def brightened(self, gain: Float[Tensor, " 3"]) -> View:
        """The same view with its images times a gain for each channel, clamped to [0, 1], and opaque: their background is not
        the view's, so another colour cannot replace it.
        """
        lr, hr = (
            replace(photo, image=(photo.image * gain).clamp(0, 1), transparency=None) for photo in (self.lr, self.hr)
        )
        truth = None if self.truth is None else (self.truth * gain).clamp(0, 1)
        disagreement = None if self.disagreement is None else self.disagreement * gain  # a difference of such images
        return replace(self, lr=lr, hr=hr, truth=truth, disagreement=disagreement)

    def to(self, device: torch.device | str) -> View:
        layers = {name: getattr(self, name) for name in ("lr", "hr", "truth", "depth", "disagreement")}
        return replace(self, **{name: layer.to(device) for name, layer in layers.items() if layer is not None})


@dataclass(frozen=True, slots=True, eq=False)
class ExtraView:
    """A picture that the field should match in addition to the view of an iteration, see `Strategy.extra_views`.

    Args:
        photo: the target, and its camera. Any size; the smaller, the cheaper.
        weight: >= 0 for each pixel, a multiple of λ_LR; 0 where the target is unknown.
        background: see `View.background`; what a transparent photo lies over.
        robust: parts of the photo may be invented. The weight is lower where the render differs from it much more than elsewhere,
            see `clear_strategies.core.images.agreement`.
    """

    photo: Photo
    weight: Float[Tensor, "h w"]
    background: Color = (0.0, 0.0, 0.0)
    robust: bool = False

    def to(self, device: torch.device | str) -> ExtraView:
        return replace(self, photo=self.photo.to(device), weight=self.weight.to(device))
