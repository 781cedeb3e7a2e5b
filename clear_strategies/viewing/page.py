"""splat.html, a page that needs neither a server nor a network: viser's client draws the splat by WebGL."""

from __future__ import annotations

import contextlib
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.viewing.paths import look_at
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from rasterizers.interface import Camera, Color, Splats

FILE: Final = "splat.html"
_DISTANCE: Final = 20.0  # of the first camera from the scene in the page: covariances are float16 there
_SEEN_FROM: Final = 16  # cameras whose colours are averaged, at most


def write_page(path: Path, splats: Splats, cameras: Sequence[Camera], title: str, background: Color) -> None:
    """Write the page, which begins at the first of the cameras and is black or white, whichever is closer to the background.

    Raises:
        OSError: the file cannot be written, or this machine has no loopback address.
    """
    import viser

    from clear_strategies.viewing.server import aim

    scale = _DISTANCE / max(float((cameras[0].center.double().cpu() - torch.from_numpy(look_at(cameras))).norm()), 1e-9)
    axes = rotation_matrix(splats.quats) * (scale * splats.scales)[:, None]
    gaussians = (scale * splats.means, axes @ axes.mT, colors_seen(splats, cameras), splats.opacities[:, None])
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False, label=title)
        try:
            serializer = server.get_scene_serializer()
            aim(server, cameras, scale)
            server.scene.add_gaussian_splats("/splat", *(tensor.cpu().numpy() for tensor in gaussians))
            text = serializer.as_html(dark_mode=sum(background) < 1.5)
        finally:
            server.stop()
    files.write_text(path, text.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1))


def colors_seen(splats: Splats, cameras: Sequence[Camera]) -> Float[Tensor, "N 3"]:
    """One colour of each Gaussian for all directions, in [0, 1]: the mean of those that the cameras see."""
    coefficients = torch.cat([splats.sh0, splats.shN], dim=1)
    base = 0.5 if splats.rgb_offset is None else 0.5 + splats.rgb_offset
    seen = []
    for camera in cameras[:: -(-len(cameras) // _SEEN_FROM)]:
        directions = torch.nn.functional.normalize(splats.means - camera.center.to(splats.means), dim=1)
        basis = spherical_harmonics(directions, splats.shN.shape[1])
        seen.append((base + (basis[..., None] * coefficients).sum(1)).clamp(0, 1))
    return torch.stack(seen).mean(0)
