"""splat.html: a splat that turns in any browser, without a server and without a network.

The page is viser's own client, which its wheel brings, with the Gaussians in it. It sorts and blends on the graphics card and
knows neither view-dependent colour nor the Mip filters' compensation: `clear-strategies view` shows what the metrics see.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing import paths
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

FILE: Final = "splat.html"
MOST: Final = 250_000
"""Gaussians on a page, at most: 8 MB."""
_RADIUS: Final = 10.0  # world units of the page from the cameras to the scene: half floats hold covariances well there


def missing() -> str | None:
    """What is not installed that the page needs, with the remedy; None where nothing is."""
    return None if find_spec("viser") is not None else "splat.html needs viser: pip install 'clear-strategies[view]'"


def write_page(folder: Path, field: GaussianField, cameras: Sequence[Camera]) -> None:
    """Write splat.html, seen from the first of the cameras; without viser none, with a message."""
    if (lack := missing()) is not None:
        _log.info("no page is written: %s.", lack)
        return
    files.write_text(folder / FILE, page(field, cameras))


def page(field: GaussianField, cameras: Sequence[Camera]) -> str:
    """The text of the page. Of a field with more than `MOST` Gaussians it has the ones that cover most."""
    import viser

    splats = field.baked()
    means, rgb = splats.means.double().cpu(), _colors(field, cameras)
    R = rotation_matrix(splats.quats.double().cpu())
    spread = R * splats.scales.double().cpu()[:, None]
    covariances, opacities = spread @ spread.transpose(1, 2), splats.opacities.cpu().clamp(0, 1)
    if len(means) > MOST:
        size = splats.scales.cpu().log().sum(1) * (2 / 3) + opacities.log()
        kept = size.topk(MOST).indices
        means, rgb, covariances, opacities = means[kept], rgb[kept], covariances[kept], opacities[kept]
        _log.info("splat.html shows the %s largest of %s Gaussians.", f"{MOST:,}", f"{len(splats):,}")
    centers = torch.stack([camera.center.double() for camera in cameras])
    focus = torch.from_numpy(paths.look_at(cameras))
    times = _RADIUS / max(float((centers - focus).norm(dim=1).mean()), 1e-9)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints its address, which nobody needs
        server = viser.ViserServer(host="127.0.0.1", verbose=False)
    try:
        _aim(server, cameras, focus, times)
        server.scene.add_gaussian_splats(
            "/splat",
            centers=_array((means - focus) * times),
            covariances=_array(covariances * times**2),
            rgbs=_array(rgb),
            opacities=_array(opacities)[:, None],
        )
        return str(server.get_scene_serializer().as_html(dark_mode=True))
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def _aim(server: object, cameras: Sequence[Camera], focus: Tensor, times: float) -> None:
    """Begin at the first camera, upright as the cameras are."""
    first, axes = cameras[0], torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    up = -axes[:, 1].mean(0)
    server.scene.set_up_direction(tuple((up / up.norm().clamp_min(1e-9)).tolist()))  # type: ignore[attr-defined]
    start = server.initial_camera  # type: ignore[attr-defined]
    center = first.center.double()
    ahead = float((focus - center).norm()) * first.world_to_camera[2, :3].double()
    start.position = tuple(((center - focus) * times).tolist())
    start.look_at = tuple(((center + ahead - focus) * times).tolist())
    start.up = tuple((-first.world_to_camera[1, :3]).tolist())
    start.fov = 2 * math.atan(first.height / 2 / first.fy)


def _colors(field: GaussianField, cameras: Sequence[Camera]) -> Float[Tensor, "N 3"]:
    """Each Gaussian's colour as the cameras see it on average, f_det included."""
    splats = field.baked()
    sh = torch.cat([splats.sh0, splats.shN], dim=1).cpu()
    total = torch.zeros(len(splats), 3)
    for camera in cameras:
        toward = torch.nn.functional.normalize(splats.means.cpu() - camera.center.float(), dim=1)
        total += (spherical_harmonics(toward, splats.shN.shape[1])[:, :, None] * sh).sum(1)
    offset = 0.0 if splats.rgb_offset is None else splats.rgb_offset.cpu()
    return (total / len(cameras) + 0.5 + offset).clamp(0, 1)


def _array(values: Tensor) -> np.ndarray:
    return np.ascontiguousarray(values.detach().float().numpy())
