"""Colours of the Gaussians in the viewer: by f_det, by opacity, and by the maps of training views carried over to them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.data import strict_json
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.view_names import file_stem
from clear_strategies.geometry.projection import seen_pixels
from clear_strategies.viewing.cameras import SavedCamera
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera

_MAPS: Final = ("reliability", "demand", "weight", "corrected", "conflict")
_UNSEEN: Final = 0.25  # grey of Gaussians that no map shows
_BEHIND: Final = 0.05  # a Gaussian this share of its depth behind the surface is not on the map
_TOP: Final = 0.98  # quantile of |f_det| at the end of its colours


def names(folder: Path | None) -> list[str]:
    """The names of `colors`: opacity, f_det, and the maps in a run's folder."""
    maps = [name for name in _MAPS if folder is not None and any(folder.glob(f"maps/*/{name}.png"))]
    return ["opacity", "f_det", *maps]


def colors(painter: Painter, folder: Path | None, cameras: Sequence[SavedCamera]) -> dict[str, Float[Tensor, "N 3"]]:
    """RGB of each Gaussian, by the names of `names`: viridis from 0 to 1, f_det up to its 98 % quantile, grey where no map shows
    the Gaussian.
    """
    field = painter.field
    detail = field.detail.data.norm(dim=1).cpu()
    top = float(np.quantile(detail.numpy(), _TOP)) if len(detail) else 0.0
    values = {"opacity": field.filtered_opacities().data.cpu(), "f_det": detail / max(top, 1e-9)}
    if folder is not None:
        for name in names(folder)[2:]:
            values[name] = on_gaussians(painter, _maps(folder, name, cameras))
    return {name: _viridis(value) for name, value in values.items()}


def on_gaussians(painter: Painter, maps: Sequence[tuple[Camera, Float[Tensor, "H W"]]]) -> Float[Tensor, " N"]:
    """The mean of the maps where each Gaussian appears in them; nan for those that none shows."""
    means = painter.field.means.data.cpu()
    total, count = torch.zeros(len(means)), torch.zeros(len(means))
    for camera, values in maps:
        inside, row, column, z = seen_pixels(camera, means)
        shown = z <= painter.depth(camera)[row, column] * (1 + _BEHIND)  # false where no depth is known
        which = inside.nonzero()[:, 0][shown]
        total[which] += values[row[shown], column[shown]].float()
        count[which] += 1
    return torch.where(count > 0, total / count.clamp_min(1), torch.nan)


def _maps(folder: Path, name: str, cameras: Sequence[SavedCamera]) -> list[tuple[Camera, Float[Tensor, "H W"]]]:
    by_name = {saved.name: saved.camera for saved in cameras}
    maps = []
    for view in strict_json.read_object(folder / "maps" / "maps.json").get("views", {}):
        path = folder / "maps" / file_stem(view) / f"{name}.png"
        if view in by_name and path.is_file():
            camera = by_name[view]
            maps.append((camera, read_image(path, expect=(camera.width, camera.height))[..., 0]))
    return maps


def _viridis(values: Float[Tensor, " N"]) -> Float[Tensor, "N 3"]:
    from matplotlib import colormaps

    rgb = torch.from_numpy(colormaps["viridis"](values.clamp(0, 1).nan_to_num().numpy())[:, :3]).float()
    return torch.where(values.isnan()[:, None], torch.full_like(rgb, _UNSEEN), rgb)
