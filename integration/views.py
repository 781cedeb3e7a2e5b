"""A host's photos and cameras: as the views that strategies use, and as initial points by dense stereo."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.checks import refuse, require_whole
from clear_strategies.core.points import MAX_POINTS, PointCloud
from clear_strategies.core.view import Photo, View
from clear_strategies.data.priors.interface import super_resolved
from clear_strategies.data.view_names import write_pngs
from clear_strategies.errors import DataError, HostError
from clear_strategies.geometry import stereo
from clear_strategies.geometry.photos import camera_of, image_of, require_range, require_shape
from clear_strategies.geometry.projection import intrinsics
from rasterizers.interface import Camera
from rasterizers.modes import on_cpu_by_default

_log = logging.getLogger(__name__)
SAME_POSE: Final = 1e-3
"""Largest difference between the entries of two poses of one camera."""
_SHOWN: Final = 0.5  # a mask above it shows its pixel
_OVERSHOOT: Final = 0.5  # by which a network's images may leave [0, 1] at edges

SuperResolve = Callable[[str, Float[Tensor, "h w 3"], int], Float[Tensor, "H W 3"]]
"""I_HR of a view from its name, its LR image and the factor: a prior of `clear_strategies.data.priors`, or your function."""
Points = Literal["own", "stereo"]
"""The initial points: the host's own, or dense stereo."""


@dataclass(frozen=True, slots=True, eq=False)
class HostPhoto:
    """A training photo as its host trains on it.

    Args:
        name: name of the file, with the folder if the host has it.
        image: RGB in [0, 1] or 8 bits; further channels are left out.
        world_to_camera: OpenCV axes (x right, y down, z forward).
        K: focal lengths and principal point in pixels of `image`; pixel (0, 0) spans [0, 1)².
        mask: in [0, 1]; the host's loss multiplies its rendering by it. None: nothing is hidden.

    Raises:
        DataError: one has another shape, or values outside of [0, 1]; or pose and K are no camera.
    """

    name: str
    image: Float[Tensor, "h w C"]
    world_to_camera: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    mask: Float[Tensor, "h w"] | None = None

    def __post_init__(self) -> None:
        _ = self.posed

    @property
    def posed(self) -> Photo:
        """The photo with its camera, RGB in [0, 1]; the mask stays apart."""
        image = image_of(self.name, "image", self.image, alpha=True, overshoot=_OVERSHOOT)
        pose = "world_to_camera", self.world_to_camera.float()
        camera = camera_of(self.name, pose, ("K", self.K), image)
        if self.mask is not None:
            require_shape(self.name, "mask", self.mask, image.shape[:2], "give [h, w] of its photo")
            require_range(self.name, "mask", self.mask, overshoot=_OVERSHOOT)
        return Photo(camera, image.clamp(0, 1))  # reduced photos may overshoot

    @on_cpu_by_default
    def view(self, sr: SuperResolve, factor: int) -> View:
        """See `view`."""
        lr = self.posed
        image, camera = lr.image, lr.camera
        result = super_resolved(sr, self.name, image.cpu(), factor)
        sr_image = result.image.to(image)
        require_range(self.name, "SR image", sr_image, overshoot=_OVERSHOOT)
        sr_image = sr_image.clamp(0, 1)
        mask = None if self.mask is None else self.mask.to(image)
        if mask is not None:
            image = image * mask[..., None]
            sr_image = sr_image * enlarged_mask(mask, factor)[..., None]
        view = View(
            self.name, Photo(camera, image), Photo(camera.scaled(factor), sr_image),
            sr_source=getattr(sr, "label", "unknown"),
            disagreement=None if result.disagreement is None else result.disagreement.to(image),
        )  # fmt: skip
        return view if mask is None else view.hiding(mask > _SHOWN)


def view(
    name: str,
    image: Float[Tensor, "h w 3"] | np.ndarray,
    world_to_camera: Float[Tensor, "4 4"] | np.ndarray,
    K: Float[Tensor, "3 3"] | np.ndarray,
    sr: SuperResolve,
    factor: int = 4,
    mask: Float[Tensor, "h w"] | np.ndarray | None = None,
) -> View:
    """One training view of a host, on the device of its image.

    Args:
        name, image, world_to_camera, K: see `HostPhoto`; numpy arrays are accepted.
        sr: makes the SR image. factor: HR pixels per LR pixel.
        mask: see `HostPhoto`. Photo and SR image are multiplied by it, so a pixel that the host hides is hidden at both scales;
            multiply the HR rendering as well, see `enlarged_mask`.

    Raises:
        DataError: photo, mask, pose or K has another shape, or is no array of numbers; the SR image is not `factor` times as
            large as the photo; an image lies outside of [0, 1] by more than a network's overshoot.
        SettingError: sr cannot be called, or factor is no whole number of at least 1.
    """
    require_whole("factor", factor, least=1)
    if not callable(sr):
        refuse(
            "sr",
            "must be a function or a prior",
            sr,
            "of a folder of SR images, clear_strategies.data.priors.Images(folder)",
        )
    given = {"image": image, "world_to_camera": world_to_camera, "K": K}
    tensors = {field: _tensor(name, field, value) for field, value in given.items()}
    return HostPhoto(name, **tensors, mask=None if mask is None else _tensor(name, "mask", mask)).view(sr, factor)


def _tensor(name: str, field: str, value: object) -> Tensor:
    if isinstance(value, Tensor):
        return value
    array = np.asarray(value)
    if array.dtype.kind not in "bfiu":
        raise DataError(
            name, field, f"must be a tensor or an array of numbers, got a {type(value).__name__}", "give one"
        )
    return torch.tensor(np.ascontiguousarray(array))


def require_unique(names: Iterable[str]) -> None:
    """Raise a DataError if two photos have the same name, which identifies views and SR images."""
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        remedy = "give each its own; where folders have equal file names, name the views with their folders"
        raise DataError(twice[0], "name", "is that of two photos", remedy)


def save_photos(photos: Iterable[HostPhoto], folder: Path | str) -> None:
    """Write the photos as PNG files by their names, black where a mask hides them, for an SR tool to enlarge.

    Raises:
        DataError: two photos would have the same file.
    """

    def shown(photo: HostPhoto) -> Float[Tensor, "h w 3"]:
        image = photo.posed.image
        return image if photo.mask is None else image * photo.mask.to(image)[..., None]

    written = write_pngs(Path(folder), ((photo.name, shown(photo)) for photo in photos))
    _log.info("%d LR photos written to %s. Enlarge them and pass the folder of the results as sr.", written, folder)


def enlarged_mask(mask: Float[Tensor, "h w"], factor: int) -> Float[Tensor, "H W"]:
    """The mask at HR: every HR pixel has the value of the LR pixel that it lies in."""
    return mask.repeat_interleave(factor, 0).repeat_interleave(factor, 1)


def require_intrinsics(name: str, drawn: Sequence[float], photo: Camera, remedy: str) -> None:
    """Raise a HostError if a rendering has other intrinsics than its photo, and so shows other pixels.

    Args:
        name: of the rendering. drawn: its fx, fy, cx, cy. remedy: a sentence.
    """
    known = (photo.fx, photo.fy, photo.cx, photo.cy)
    if not all(abs(a - b) <= SAME_POSE * max(map(abs, known)) for a, b in zip(drawn, known, strict=True)):
        given, own = ("fx={:.6g}, fy={:.6g}, cx={:.6g}, cy={:.6g}".format(*numbers) for numbers in (drawn, known))
        raise HostError(
            f"{name} is rendered with {given}, but its photo has {own}, so that they show other pixels. {remedy}"
        )


def no_stereo(problem: str) -> HostError:
    """The error of a host whose points cannot be replaced, with the remedy."""
    remedy = "Leave points at own, and write points3D.ply for the host to read: docs/how-to/stereo.md shows how."
    return HostError(f"points=stereo: {problem}. {remedy}")


def stereo_points(photos: Sequence[HostPhoto]) -> PointCloud:
    """Dense stereo between a host's training photos; one line of the log sums them up.

    Args:
        photos: in the host's world. Pixels whose mask is below 0.5 are hidden and get no points. Stereo runs on their device.

    Returns:
        At most `MAX_POINTS` points on the CPU: world units, RGB in [0, 1]. More are reduced to a reproducible random choice.

    Raises:
        DataError: there are fewer than two photos, or stereo confirms no depth.
    """
    posed = [photo.posed for photo in photos]
    dense = stereo(
        [photo.image for photo in posed],
        torch.stack([photo.camera.world_to_camera for photo in posed]) if posed else torch.zeros(0, 4, 4),
        torch.stack([intrinsics(photo.camera) for photo in posed]) if posed else torch.zeros(0, 3, 3),
        masks=[None if photo.mask is None else photo.mask >= 0.5 for photo in photos],
    )
    cloud = PointCloud(dense.means.cpu(), dense.colors.cpu(), dense.summary)
    kept = cloud.at_most(MAX_POINTS)
    chosen = "" if len(kept) == len(cloud) else f"; {len(kept):,} of them, chosen at random, are used"
    _log.info("points=stereo: %s%s.", dense.summary, chosen)
    return kept
