"""Error, coverage and run time of the depth of the training photos.

The reference is the capture's exact depth where it is known (the demo), else the SfM points that a photo observes. These come
from all photos, test views too; stereo does not use them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pandas as pd
import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.bench.results import Results
from clear_strategies.compose import composed, tree
from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.prepare import lr_photos
from clear_strategies.data.view_settings import split
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.projection import seen_pixels
from clear_strategies.geometry.sift import triangulate
from clear_strategies.jobs.scene import DataSettings
from clear_strategies.settings import build

_CLOSE: Final = (0.03, 0.10)  # relative errors of depth whose shares the table gives


def measure(results: Results, *, overrides: Sequence[str]) -> None:
    """Fill `results` with a row for each training photo, and one for all of them together.

    Raises:
        SettingError, DataError: the overrides, or the data, cannot be used.
    """
    data: DataSettings = build(tree(composed(list(overrides), "config"))["data"], "data")
    capture = data.reader()
    frames, _ = split(capture, data.views)
    photos = lr_photos(frames, capture, data.views)
    start = time.perf_counter()
    features = triangulate(photos, data.cloud.triangulation)
    triangulated = time.perf_counter()
    maps = depth_maps(photos, features.means, data.cloud.stereo, capture.background)
    end = time.perf_counter()
    errors, rows, points = list[Tensor](), list[dict[str, str | float]](), 0
    for frame, photo, depth in zip(frames, photos, maps, strict=True):
        error, of_view = _errors(capture, frame, photo, depth)
        rows.append({"view": Path(frame.name).stem, "coverage": depth.coverage, **_shares(error, of_view)})
        errors.append(error)
        points += of_view
    mean_coverage = sum(depth.coverage for depth in maps) / len(maps)
    rows.append({"view": "all", "coverage": mean_coverage, **_shares(torch.cat(errors), points)})
    results.tables["stereo"] = pd.DataFrame(rows)
    size = f"{photos[0].camera.width}x{photos[0].camera.height}"
    results.note(
        f"{capture.name}, {len(photos)} photos, the first of {size}: depth in {end - triangulated:.1f} s after "
        f"{triangulated - start:.1f} s for {len(features)} triangulated points, {torch.get_num_threads()} threads."
    )
    if points == 0:
        results.note("there is nothing to compare with: the scene has neither SfM points nor known depth.")


def _shares(errors: Float[Tensor, " K"], points: int) -> dict[str, float]:
    """Reference points, the share of them where depth is known, and the shares of these within each relative error."""
    within = {f"within {limit:.0%}": float((errors <= limit).double().mean()) for limit in _CLOSE}
    return {"points": float(points), "known": len(errors) / points if points else float("nan"), **within}


def _errors(capture: Capture, frame: Frame, photo: Photo, estimate: DepthMap) -> tuple[Float[Tensor, " K"], int]:
    """(|z / z_reference - 1| where the depth is known, the number of reference points)."""
    pixels, depth = _reference(capture, frame, photo)
    error = (estimate.depth.cpu().double()[pixels[:, 1], pixels[:, 0]] / depth - 1).abs()
    return error[error.isfinite()], len(depth)


def _reference(capture: Capture, frame: Frame, photo: Photo) -> tuple[Int[Tensor, "N 2"], Float[Tensor, " N"]]:
    """(columns and rows, depth) of the reference points of a photo."""
    if capture.depth is not None:
        exact = capture.depth(photo.camera).double()
        row, column = torch.nonzero(exact.isfinite(), as_tuple=True)
        return torch.stack((column, row), dim=1), exact[row, column]
    if capture.points is None:
        return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, dtype=torch.float64)
    seen = torch.unique(capture.points.track_point[capture.points.track_image == frame.sfm_id])
    _, row, column, depth = seen_pixels(photo.camera, capture.points.means[seen])
    return torch.stack((column, row), dim=1), depth
