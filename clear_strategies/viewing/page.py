"""Pages that need neither a server nor a network: viser's client draws a splat, or points and cameras, by WebGL.

A splat's Gaussians have one colour for all directions: here the mean of those that the run's cameras see.
"""

from __future__ import annotations

import contextlib
import html
import io
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies import files
from clear_strategies.viewing import paths
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from rasterizers.interface import Camera, Color, Splats

if TYPE_CHECKING:
    import viser

_log = logging.getLogger(__name__)

FILE: Final = "splat.html"
_DISTANCE: Final = 20.0  # of the first camera from the scene in the page: covariances are float16 there
_SEEN_FROM: Final = 16  # cameras whose colours are averaged, at most
_SHARE: Final = 0.6  # of the length of a camera in the viewer, where one is shown at a time
_POINT: Final = 0.05  # size of a point, in lengths of a camera
_DARK: Final = 0.5  # mean of the background's RGB below which the page is dark

RGB = tuple[int, int, int]  # 0 to 255


@dataclass(frozen=True, slots=True, eq=False)
class ShownCamera:
    """A camera in a page of points.

    Args:
        image: in its frustum, uint8 [h, w, 3]; None: the frustum is empty.
    """

    camera: Camera
    label: str
    rgb: RGB
    image: np.ndarray | None = None


def missing() -> str | None:
    """Why no page can be written, with the remedy; None where viser is installed."""
    return None if find_spec("viser") is not None else "viser is not installed: pip install 'clear-strategies[view]'"


@contextlib.contextmanager
def optional(name: str) -> Iterator[None]:
    """Log a warning in place of an OSError: the other files of a run are worth more than its page of this name."""
    try:
        yield
    except OSError as error:
        _log.warning("%s could not be written: %s.", name, error)


def write_page(path: Path, splats: Splats, cameras: Sequence[Camera], title: str, background: Color) -> None:
    """Write the page; it begins at the first camera. viser must be installed, see `missing`.

    Args:
        splats: as exported, the filters in their scales and opacities.
        cameras: at least one.
        background: RGB in [0, 1]; the page is black or white, whichever is closer.

    Raises:
        OSError: the file cannot be written, or this machine has no loopback address.
    """
    with _page(path, cameras, title, dark=sum(background) / 3 < _DARK) as (server, times):
        colors = colors_seen(splats, [c.center for c in cameras[:: -(-len(cameras) // _SEEN_FROM)]])
        server.scene.add_gaussian_splats(
            "/splat", (splats.means * times).cpu().numpy(), (covariances(splats) * times**2).cpu().numpy(),
            colors.cpu().numpy(), splats.opacities[:, None].cpu().numpy(),
        )  # fmt: skip


def write_points_page(
    path: Path,
    means: Float[Tensor, "N 3"],
    rgb: Float[Tensor, "N 3"],
    shown: Sequence[ShownCamera],
    title: str,
    legend: Mapping[str, RGB],
) -> None:
    """Write a page of points and cameras; it begins behind and above them. viser must be installed, see `missing`.

    Args:
        rgb: colours of the points, in [0, 1].
        shown: at least one.
        legend: what each colour means.

    Raises:
        OSError: as `write_page`.
    """
    from clear_strategies.viewing.aim import add_camera, drawn_length

    cameras = [marked.camera for marked in shown]
    with _page(path, [paths.overview(cameras), *cameras], title, dark=False, above=_legend(legend)) as (server, times):
        length = _SHARE * times * drawn_length(cameras)
        points = (means * times).cpu().numpy()
        server.scene.add_point_cloud("/points", points, rgb.cpu().numpy(), point_size=_POINT * length)
        for i, marked in enumerate(shown):
            camera = _magnified(marked.camera, times)
            add_camera(server, f"/cameras/{i}", camera, length, color=marked.rgb, image=marked.image)
            server.scene.add_label(f"/cameras/{i}/name", marked.label)


@contextlib.contextmanager
def _page(
    path: Path, cameras: Sequence[Camera], title: str, *, dark: bool, above: str = ""
) -> Iterator[tuple[viser.ViserServer, float]]:
    """A server whose scene becomes the page, and how many times larger than the world it is.

    Args:
        above: HTML over the scene.
    """
    import viser

    from clear_strategies.viewing.aim import aim

    times = _DISTANCE / max(
        float(np.linalg.norm(cameras[0].center.double().cpu().numpy() - paths.look_at(cameras))), 1e-9
    )
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False, label=title)
        try:
            serializer = server.get_scene_serializer()
            aim(server, [_magnified(camera, times) for camera in cameras])
            yield server, times
            text = serializer.as_html(dark_mode=dark)
        finally:
            server.stop()
    text = text.replace("<title>Viser</title>", f"<title>{html.escape(title)}</title>", 1)
    files.write_text(path, text.replace("<body>", f"<body>{above}", 1))


def _legend(rows: Mapping[str, RGB]) -> str:
    """A list of colours in the lower left corner, through which the mouse reaches the scene."""
    listed = "".join(
        f'<div><span style="color:rgb{rgb}">&#9632;</span> {html.escape(label)}</div>' for label, rgb in rows.items()
    )
    style = "position:fixed;left:12px;bottom:12px;z-index:1;pointer-events:none;font:13px/1.5 sans-serif"
    return f'<div style="{style}">{listed}</div>'


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
