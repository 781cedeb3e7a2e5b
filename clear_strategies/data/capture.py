"""Posed photos as readers return them: `Frame`, `SfmPoints` and `Capture`.

Readers only read files. `prepare.py` splits a capture, makes its images at both scales, and returns a `Scene`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.data.file_names import normalized
from clear_strategies.data.lenses import Lens
from clear_strategies.data.masks import check_mask, read_mask
from clear_strategies.data.photo_files import Header, read_header, read_layers
from clear_strategies.data.priors.interface import Prior
from clear_strategies.errors import DataError
from rasterizers.interface import Camera, Color

BLACK: Final = (0.0, 0.0, 0.0)
NO_PARALLAX: Final = "no parallax: the photos are all from one place, so nothing tells how far away anything is"
MORE_PHOTOS: Final = (
    "take more photos that overlap by two thirds, with the same camera and zoom, of a scene with texture"
)
STEP_ASIDE: Final = "take a step to the side from photo to photo, in place of turning on the spot"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One posed photo. `load` decodes its files, with mask and alpha; readers never call it."""

    name: str  # unique in its capture, e.g. the file's name
    camera: Camera  # a pinhole, that of what `load` returns
    load: Callable[[], Photo]
    split: str | None = None  # "train" or "test" where the data set itself defines the split (Blender)
    sfm_id: int | None = None  # in `SfmPoints.track_image`
    lens: Lens | None = None  # before undistortion; None: the data set gives `camera` itself

    @staticmethod
    def of_photo(
        name: str,
        path: Path | str,
        lens: Lens,
        pose: Float[Tensor, "4 4"],
        *,
        upright: bool | None = None,
        background: Color | None = None,
        split: str | None = None,
        sfm_id: int | None = None,
        mask: Path | str | None = None,
    ) -> Frame:
        """Make the frame of an image file, with the lens rescaled to the size of the image. Reads only the file's header.

        Args:
            lens: of the photo, and of its mask, at any resolution.
            pose: world to camera, OpenCV axes.
            upright: the lens is of the photo after its EXIF rotation. None: for a photo stored on its side, the aspect ratio of
                the lens decides; photos with another EXIF rotation are refused.
            background: behind transparent pixels; None: black, logged.
            mask: see `read_mask`; `masks_of` finds it.
        """
        path = Path(path)
        mask = None if mask is None else Path(mask)
        header = read_header(path)
        turn = _turned_as(header, lens) if upright is None else upright
        width, height = header.size(turn)
        fitted = lens.resized(width, height, path)
        pinhole = fitted.undistorted(path)
        camera = Camera(pose, pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, width, height)
        if mask is not None:
            check_mask(mask, fitted, turn)

        def load() -> Photo:
            image, through = read_layers(path, background=background, expect=(width, height), turn=turn)
            if fitted.distorts:
                image = fitted.undistort(image, pinhole)
                through = None if through is None else fitted.undistort(through, pinhole)
            shown = None if mask is None else read_mask(mask, fitted, pinhole, turn)
            return Photo(camera, image, shown, through)

        return Frame(normalized(name), camera, load, split, sfm_id, lens)


@dataclass(frozen=True, slots=True, eq=False)
class SfmPoints:
    """Triangulated points with their tracks, flattened: point `track_point[j]` is observed in frame `track_image[j]`."""

    means: Float[Tensor, "N 3"]
    colors: Float[Tensor, "N 3"]
    track_point: Int[Tensor, " M"]
    track_image: Int[Tensor, " M"]
    source: str

    @staticmethod
    def without_tracks(means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"], source: str) -> SfmPoints:
        none = torch.zeros(0, dtype=torch.long)
        return SfmPoints(means, colors, none, none, source)


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A set of posed photos, sorted by name unless the data set has an order of its own, and its points.

    Args:
        background: the colour behind the scene (white for Blender's RGBA).
        notes: label -> fact for the printed plan (the source of the poses, what was undistorted …).
        own_prior: makes the prior for `prior=auto` from functions that load the photos at HR, by the frames' names; None for
            real photos.
        unplaced: photos without a pose: the reason by the photo's name.
    """

    name: str
    frames: tuple[Frame, ...]
    points: SfmPoints | None = None
    background: Color = BLACK
    notes: dict[str, str] = field(default_factory=dict)
    own_prior: Callable[[Mapping[str, Callable[[], Float[Tensor, "H W 3"]]]], Prior] | None = None
    unplaced: Mapping[str, str] = field(default_factory=dict)


def rigid_inverse(file: Path, where: str, rotation: np.ndarray, center: np.ndarray) -> Float[Tensor, "4 4"]:
    """World-to-camera of a camera with these axes (columns) and centre; a DataError unless the axes are orthonormal and
    right-handed within 1e-3.
    """
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or abs(np.linalg.det(rotation) - 1) > 1e-3:
        problem = f"holds no rotation (determinant {np.linalg.det(rotation):.4g})"
        raise DataError(file, where, problem, "remove scale and reflection from the camera-to-world matrices")
    left, _, right = np.linalg.svd(rotation)  # the nearest exact rotation, because files keep six digits
    pose = np.eye(4)
    pose[:3, :3] = (left @ right).T
    pose[:3, 3] = -pose[:3, :3] @ center
    return torch.from_numpy(pose)


def sorted_by_name(frames: Sequence[Frame], file: Path) -> tuple[Frame, ...]:
    """Check the frames by `require_names`, and sort them by name."""
    require_names(frames, file)
    return tuple(sorted(frames, key=lambda frame: frame.name))


def require_names(frames: Sequence[Frame], file: Path) -> None:
    """Raise a DataError if there are no frames, two have the same name, or a name leads out of the folder it is relative to."""
    if not frames:
        raise DataError(file, "frames", "there is none", "give a capture with at least one posed photo")
    for name, following in itertools.pairwise(sorted(frame.name for frame in frames)):
        if name == following:
            raise DataError(file, "file name", f"{name!r} belongs to two frames", "give each photo one pose")
    for path in (PurePosixPath(frame.name) for frame in frames):
        if path.is_absolute() or ".." in path.parts:
            remedy = "put the photos, or links to them, below one folder"
            raise DataError(file, "file name", f"'{path}' leads out of the folder of the photos", remedy)


def lens_notes(frames: Sequence[Frame]) -> dict[str, str]:
    """Describe, for the printed plan, how lenses were rescaled and undistorted to the frames' cameras."""
    notes = {}
    pairs = [(frame.lens, frame.camera) for frame in frames if frame.lens is not None]
    scaled = [(a, b) for a, b in pairs if (a.width, a.height) != (b.width, b.height)]
    if scaled:
        lens, camera = scaled[0]
        notes["cameras"] = (
            f"{len(scaled)} of {len(frames)} rescaled to their photos, e.g. {lens.width}x{lens.height} to "
            f"{camera.width}x{camera.height}: x {camera.width / lens.width:.5g}, y {camera.height / lens.height:.5g}"
        )
    distorted = [(a, b) for a, b in pairs if a.distorts]
    if distorted:
        lens, camera = distorted[0]
        angle = math.degrees(2 * math.atan(camera.width / camera.fx / 2))
        notes["lens"] = (
            f"{len(distorted)} of {len(frames)} photos undistorted by OpenCV (bicubic, no borders), e.g. fx "
            f"{lens.fx * camera.width / lens.width:.5g} to {camera.fx:.5g} px, {angle:.0f} degrees wide"
        )
    return notes


def _turned_as(header: Header, lens: Lens) -> bool | None:
    """Choose `turn` of `read_image` by the aspect ratio of the lens; None where the ratio does not decide it."""
    width, height = header.stored
    if lens.width == lens.height or header.size(turn=True) == header.stored:
        return None
    return (width > height) != (lens.width > lens.height)
