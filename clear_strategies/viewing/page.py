"""splat.html, a page that needs neither a server nor a network: viser's client draws the splat by WebGL.

A Gaussian has one colour for all directions there: the mean of those that the run's cameras see.
"""

from __future__ import annotations

import contextlib
import html
import io
from collections.abc import Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.viewing import paths
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from rasterizers.interface import Camera, Color, Splats

FILE: Final = "splat.html"
_DISTANCE: Final = 20.0  # of the first camera from the scene in the page: covariances are float16 there
_SEEN_FROM: Final = 16  # cameras whose colours are averaged, at most
_DARK: Final = 0.5  # mean of the background's RGB below which the page is dark


def missing() -> str | None:
    """Why no page can be written, with the remedy; None where viser is installed."""
    return None if find_spec("viser") is not None else "viser is not installed: pip install 'clear-strategies[view]'"


def write_page(path: Path, splats: Splats, cameras: Sequence[Camera], title: str, background: Color) -> None:
    """Write the page; it begins at the first camera. viser must be installed, see `missing`.

    Args:
        splats: as exported, the filters in their scales and opacities.
        cameras: at least one.
        background: RGB in [0, 1]; the page is black or white, whichever is closer.

    Raises:
        OSError: the file cannot be written, or this machine has no loopback address.
    """
    import viser

    from clear_strategies.viewing.aim import aim

    distance = float(np.linalg.norm(cameras[0].center.double().cpu().numpy() - paths.look_at(cameras)))
    times = _DISTANCE / max(distance, 1e-9)
    colors = colors_seen(splats, [c.center for c in cameras[:: -(-len(cameras) // _SEEN_FROM)]])
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False, label=title)
        try:
            serializer = server.get_scene_serializer()
            aim(server, [_magnified(camera, times) for camera in cameras])
            server.scene.add_gaussian_splats(
                "/splat", (splats.means * times).cpu().numpy(), (covariances(splats) * times**2).cpu().numpy(),
                colors.cpu().numpy(), splats.opacities[:, None].cpu().numpy(),
            )  # fmt: skip
            text = serializer.as_html(dark_mode=sum(background) / 3 < _DARK)
        finally:
            server.stop()
    files.write_text(path, text.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1))


def covariances(splats: Splats) -> Float[Tensor, "N 3 3"]:
    """R diag(s²) Rᵀ of every Gaussian."""
    axes = rotation_matrix(splats.quats) * splats.scales[:, None]
    return axes @ axes.transpose(1, 2)


def colors_seen(splats: Splats, centers: Sequence[Float[Tensor, " 3"]]) -> Float[Tensor, "N 3"]:
    """The mean colour of every Gaussian over these points of view, in [0, 1]."""
    coefficients = torch.cat([splats.sh0, splats.shN], dim=1)
    base = 0.5 if splats.rgb_offset is None else 0.5 + splats.rgb_offset
    total = torch.zeros_like(splats.means)
    for center in centers:
        directions = torch.nn.functional.normalize(splats.means - center.to(splats.means), dim=1)
        basis = spherical_harmonics(directions, splats.shN.shape[1])
        total += (base + (basis[..., None] * coefficients).sum(1)).clamp(0, 1)
    return total / len(centers)


def _magnified(camera: Camera, times: float) -> Camera:
    """The camera in a world that is so many times larger."""
    pose = camera.world_to_camera.clone()
    pose[:3, 3] *= times
    return replace(camera, world_to_camera=pose)
