"""Depth of photos from files, as phones measure it and networks estimate it (`data.cloud.depth`).

Stereo finds no depth on surfaces without texture. There, the depth of files completes it.
"""

from __future__ import annotations

import io
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.data.capture import Frame
from clear_strategies.data.file_names import some
from clear_strategies.data.lenses import Lens
from clear_strategies.data.view_names import ViewFiles
from clear_strategies.errors import DataError
from clear_strategies.files import read_bytes
from clear_strategies.geometry.photos import is_background
from clear_strategies.geometry.projection import seen_pixels
from rasterizers.interface import Camera, Color

_log = logging.getLogger(__name__)

SUFFIXES: Final = (".npy", ".png", ".tif", ".tiff")
_MILLIMETRES: Final = 1e-3  # world units, of whole numbers where the photos do not tell the unit
_ENOUGH: Final = 50  # depths of a photo from which the scale of its file is computed
_DISAGREES: Final = 0.1  # median relative difference, from which a file is left out
_FORMATS: Final = "z along the camera's axis, in .npy, or in PNG or TIFF of 16 or 32 bits and one channel"


@dataclass(frozen=True, slots=True)
class DepthFile:
    """A file with the depth of a photo, z along the camera's axis, in any unit; unknown where it is 0 or not finite.

    Args:
        lens: of the photo as it was taken, and so of the file, at any resolution.
        pinhole: what the photo was undistorted for. `camera` has the same pixels, and intrinsics that may be refined since.
    """

    path: Path
    lens: Lens
    pinhole: Lens
    camera: Camera

    @staticmethod
    def of(path: Path, frame: Frame) -> DepthFile:
        c = frame.camera
        lens = frame.lens or Lens(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        return DepthFile(path, lens, lens.resized(c.width, c.height, path).undistorted(path), c)

    def at(self, camera: Camera) -> Float[Tensor, "h w"]:
        """Read the depth at the pixels of `camera`, that of the resized and cropped photo; nan where unknown.

        Raises:
            DataError: the file is damaged, holds no depth, or has another shape than its photo.
        """
        values = _read(self.path)
        values = np.where(np.isfinite(values) & (values > 0), values, np.nan)
        height, width = values.shape
        lens, photo, p = self.lens.resized(width, height, self.path), self.camera, self.pinhole
        x, y = photo.fx / camera.fx, photo.fy / camera.fy  # pixels of the photo per pixel of `camera`
        cx, cy = camera.cx + (p.cx - photo.cx) / x, camera.cy + (p.cy - photo.cy) / y
        return torch.from_numpy(lens.sampled(values, Lens(camera.width, camera.height, p.fx / x, p.fy / y, cx, cy)))


def depth_files(folder: Path, frames: Sequence[Frame]) -> list[DepthFile]:
    """Find the depth file of each frame by `ViewFiles`, whose errors it raises."""
    remedy = "give each training photo a depth file of its name, see data.cloud.depth"
    files = ViewFiles(folder, "depth file", remedy, "", suffixes=SUFFIXES)
    return [DepthFile.of(files.find(frame.name), frame) for frame in frames]


def completed_by_files(
    maps: Sequence[DepthMap],
    files: Sequence[DepthFile],
    photos: Sequence[Photo],
    points: Float[Tensor, "N 3"],
    background: Color | None = None,
) -> list[DepthMap]:
    """Complete the depth of photos, where it is unknown, by that of their files.

    A file is multiplied by the median ratio to its own depth of the map's, and of that of `points` in the photo. Where fewer
    than 50 pixels have both, it is the median over the other files. A file that differs by more than 10 % (median) after that
    is left out, with a warning.

    Args:
        points: of the surfaces, world units, such as triangulated features.
        background: the colour of pixels without a surface, RGB in [0, 1].
    """
    given = [file.at(photo.camera) for file, photo in zip(files, photos, strict=True)]
    ratios = [_ratios(*each, points) for each in zip(given, maps, photos, strict=True)]
    scales = [float(ratio.median()) if len(ratio) >= _ENOUGH else None for ratio in ratios]
    common = _common_scale([scale for scale in scales if scale is not None], files)
    completed, left_out, differences = list[DepthMap](), list[str](), list[float]()
    for file, depth, depth_map, photo, ratio, own in zip(files, given, maps, photos, ratios, scales, strict=True):
        scale = common if own is None else own
        difference = 0.0 if own is None else float((ratio / scale - 1).abs().median())
        if difference > _DISAGREES:
            left_out.append(f"{file.path.name} ({difference:.0%})")
            completed.append(depth_map)
            continue
        differences.append(difference)
        known = depth.isfinite() & photo.visible.cpu()
        if background is not None:
            known &= ~is_background(photo.image.cpu(), background)
        whole = DepthMap(torch.where(known, scale * depth, torch.nan), known.float())
        completed.append(depth_map.completed_by(whole.to(depth_map.depth.device)))
    folder = files[0].path.parent
    if left_out:
        message = (
            "%s: %d of %d depth files differ from stereo and features in their photos, and are left out: %s (median). "
            "They must hold %s, not its inverse."
        )
        _log.warning(message, folder, len(left_out), len(files), some(left_out), _FORMATS)
    if differences:
        before, after = (sum(m.coverage for m in each) / len(files) for each in (maps, completed))
        used = [common if scale is None else scale for scale in scales]
        _log.info(
            "%s: depth is known at %.0f%% of the pixels by stereo, and at %.0f%% with the files, which are multiplied by "
            "%.4g to %.4g, and then differ by %.1f%% (median).",
            folder, 100 * before, 100 * after, min(used), max(used), 100 * float(np.median(differences)),
        )  # fmt: skip
    return completed


def _ratios(
    depth: Float[Tensor, "h w"], depth_map: DepthMap, photo: Photo, points: Float[Tensor, "N 3"]
) -> Float[Tensor, " R"]:
    """The ratios of what stereo and features know to the depth of the file, at the pixels that have both."""
    _, row, column, z = seen_pixels(photo.camera, points.cpu())
    known = depth_map.known.cpu()
    ratios = torch.cat((depth_map.depth.cpu()[known] / depth[known], z / depth[row, column]))
    return ratios[ratios.isfinite()]


def _common_scale(scales: Sequence[float], files: Sequence[DepthFile]) -> float:
    """The median scale; without any, whole numbers are taken for millimetres, and others for world units."""
    if scales:
        return float(np.median(scales))
    scale = _MILLIMETRES if np.issubdtype(_read(files[0].path).dtype, np.integer) else 1.0
    _log.warning(
        "%s: the photos do not tell the unit of these depth files, since stereo and features find too little; it is taken for "
        "%g world units.", files[0].path.parent, scale,
    )  # fmt: skip
    return scale


def _read(path: Path) -> np.ndarray:
    """The numbers of a file, [h, w]."""
    import cv2

    data = read_bytes(path)
    try:
        if path.suffix.lower() == ".npy":
            values = np.load(io.BytesIO(data))  # refuses pickles
        else:
            values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except Exception as error:  # NumPy and OpenCV raise many types of error on damaged bytes
        raise DataError(path, "depth", f"cannot be read ({error})", f"give {_FORMATS}") from error
    if values is None:
        raise DataError(path, "depth", "cannot be decoded", f"give {_FORMATS}")
    values = np.asarray(values).squeeze()
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype.itemsize < 2:
        raise DataError(path, "depth", f"holds {values.dtype} of shape {[*values.shape]}", f"give {_FORMATS}")
    return values
