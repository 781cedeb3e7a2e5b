"""The settings of dense stereo."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from clear_strategies.core.checks import refuse, require_number, require_whole

# Changes for photos at HR in place of LR:
_WIDER: Final = 2  # pixels added to windows, since finer pixels contain less texture each
_MORE: Final = 1.5  # factor of `max_planes` and `reprojection`, since points move by more pixels
_APART: Final = 2.0  # largest factor of `spacing`


@dataclass(frozen=True, slots=True)
class StereoSettings:
    """Settings of stereo between the training photos, and of the points made from its depth.

    Args:
        enlarge: factor by which photos are enlarged (bicubic) before they are compared, if the result has at most 64,000
            pixels: small photos gain most, large ones would take minutes.
        max_pixels: larger photos are first reduced by a whole factor, so that time and memory are bounded.
        sources: largest number of photos that a photo is compared with.
        plane_step: largest shift in a source photo between neighbouring depth planes, pixels of the compared images.
        max_planes: largest number of depth planes of a photo; bounds time and memory.
        window: edge of the compared windows, pixels of the compared images, odd.
        small_step, large_step: penalties of the smoothing for neighbouring pixels whose planes differ by one, or by more,
            in units of the cost, which is 0 for equal windows and 0.5 for unrelated ones.
        min_correlation: least correlation of the windows at the depth found, in [0, 1]; with less, depth is unknown.
        tolerance: largest relative difference between the depths that two photos find of one point.
        reprojection: largest distance of a pixel from itself after going to the other photo and back, LR px.
        agreeing: number of other photos whose depth must agree, or all that see the point if they are fewer; None: 2 of at least
            12 photos, else 1.
        speckle: depth in groups of fewer connected pixels than this is unknown; 0: none is. Needs SciPy.
        spacing: distance of the points on the surface, LR px of the photo that sees them.
        trust: least share of a photo's pixels with known depth; with less, all of its depth is unknown.

    Raises:
        SettingError: a number is outside its range.
    """

    enlarge: int = 2
    max_pixels: int = 250_000
    sources: int = 4
    plane_step: float = 0.75
    max_planes: int = 128
    window: int = 5
    small_step: float = 0.08
    large_step: float = 0.6
    min_correlation: float = 0.3
    tolerance: float = 0.02
    reprojection: float = 1.5
    agreeing: int | None = None
    speckle: int = 10
    spacing: float = 1.5
    trust: float = 0.05

    def __post_init__(self) -> None:
        wholes = {"enlarge": 1, "max_pixels": 1, "sources": 1, "max_planes": 4, "window": 3, "speckle": 0}
        for name, least in wholes.items():
            require_whole(name, getattr(self, name), least=least)
        if self.window % 2 == 0:
            refuse("window", "must be odd", self.window, "window=5")
        if self.agreeing is not None:
            require_whole("agreeing", self.agreeing, least=1)
        for name in ("plane_step", "small_step", "large_step", "tolerance", "reprojection"):
            require_number(name, getattr(self, name), above=0)
        require_number("spacing", self.spacing, least=1)
        for name in ("min_correlation", "trust"):
            require_number(name, getattr(self, name), least=0, most=1)

    def finer(self, ratio: float) -> StereoSettings:
        """The settings for the same photos at `ratio` times their size: HR photos in place of LR photos."""
        return replace(
            self, enlarge=1, window=self.window + _WIDER, max_planes=round(_MORE * self.max_planes),
            reprojection=_MORE * self.reprojection, spacing=min(_APART, ratio) * self.spacing,
        )  # fmt: skip
