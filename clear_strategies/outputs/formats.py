"""A splat in the formats of viewers: all by Python, but the page, which PlayCanvas's splat-transform writes.

splat-transform is a program of npm (MIT). One that is on the PATH is taken; else `npx` downloads it once.
"""

from __future__ import annotations

import json
import logging
import math
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float

from clear_strategies import files
from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.errors import SettingError
from clear_strategies.outputs.format_names import FORMATS
from clear_strategies.outputs.gltf import glb_bytes
from clear_strategies.outputs.packed import PACKED, packed_bytes
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera, Color

_log = logging.getLogger(__name__)

_CONVERTER: Final = "@playcanvas/splat-transform@2"


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """Where a page begins: at a camera, looking at a point, over a background.

    Args:
        focus: world units. background: RGB in [0, 1].
    """

    camera: Camera
    focus: Float[np.ndarray, " 3"]
    background: Color

    def settings(self) -> dict[str, Any]:
        """For PlayCanvas's viewer, which turns 3DGS files by 180° around z: y then points up."""
        center, turn = self.camera.center.double().cpu().numpy(), np.array([-1.0, -1.0, 1.0])
        return {
            "camera": {
                "fov": math.degrees(2 * math.atan(self.camera.height / 2 / self.camera.fy)),
                "position": (center * turn).tolist(),
                "target": (self.focus * turn).tolist(),
                "startAnim": "none",
            },
            "background": {"color": list(self.background)},
            "animTracks": [],
        }


def write_format(path: Path, g: GaussianPly, form: str, start: Start) -> None:
    """Write the Gaussians as one of `FORMATS`, atomically.

    Args:
        start: of the page; the other formats hold no camera.

    Raises:
        SettingError: there is no such format, or what it needs is not installed or failed.
    """
    if form not in FORMATS:
        raise SettingError(f"--to must be one of {', '.join(FORMATS)}, got {form}.")
    if form == "ply":
        write_gaussians(path, g)
    elif form == "splat":
        files.write_bytes(path, splat_bytes(g))
    elif form == "glb":
        files.write_bytes(path, glb_bytes(g))
    elif form in PACKED:
        files.write_bytes(path, packed_bytes(g, form))
    else:
        _write_page(path, g, start)


def export_ply(path: Path, field: GaussianField) -> None:
    """Write the standard 3DGS layout; f_det is folded into the colour, the 3D filter into scales and opacities.

    A viewer that honours the header's `SplatRenderMode: mip` draws the file with opacity compensation, as in training.
    """
    write_gaussians(path, gaussians_of(field))


def gaussians_of(field: GaussianField) -> GaussianPly:
    """The Gaussians of `export_ply`."""
    splats = field.baked()
    tiny = torch.finfo(torch.float32).eps
    offset = splats.rgb_offset if splats.rgb_offset is not None else torch.zeros_like(splats.means)
    higher = torch.zeros_like(field.shN.data)
    higher[:, : splats.shN.shape[1]] = splats.shN  # bands above the active degree were never rendered
    return GaussianPly(
        means=splats.means,
        sh0=splats.sh0 + offset[:, None] / SH_C0,
        shN=higher,
        opacities=torch.logit(splats.opacities.clamp(tiny, 1 - tiny)),
        scales=splats.scales.log(),
        quats=torch.nn.functional.normalize(splats.quats, dim=-1),
    )


def splat_bytes(g: GaussianPly) -> bytes:
    """The .splat file: position and scales as float32, RGBA and quaternion as bytes; the most visible Gaussians first."""
    alpha = g.opacities.sigmoid()
    order = (alpha.log() + g.scales.sum(1)).argsort(descending=True, stable=True)
    rgba = torch.cat([g.sh0[:, 0] * SH_C0 + 0.5, alpha[:, None]], dim=1)
    quats = torch.nn.functional.normalize(g.quats, dim=1)
    table = np.zeros(len(g), [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])
    for name, values in (
        ("means", g.means),
        ("scales", g.scales.exp()),
        ("rgba", (rgba.clamp(0, 1) * 255).round()),
        ("quats", (quats * 128 + 128).round().clamp(0, 255)),
    ):
        table[name] = values[order].cpu().numpy()
    return table.tobytes()


def converter() -> list[str]:
    """The command of splat-transform.

    Raises:
        SettingError: neither it nor npx is installed.
    """
    if (found := shutil.which("splat-transform")) is not None:
        return [found]
    if (npx := shutil.which("npx")) is not None:
        _log.info("npx runs %s; the first time it downloads about 70 MB.", _CONVERTER)
        return [npx, "--yes", _CONVERTER]
    raise SettingError(
        "--to html needs PlayCanvas's splat-transform and Node.js 20 or later: install Node.js from nodejs.org, or take the "
        "run's own splat.html, whose colours are the same from all sides."
    )


def _write_page(path: Path, g: GaussianPly, start: Start) -> None:
    command, on_gpu = converter(), torch.cuda.is_available()
    if not on_gpu:
        _log.info(
            "the page clusters view-dependent colours; without a GPU this takes minutes for large splats (--sh 0 is fast)."
        )
    with files.replacing(path.with_suffix(".html")) as target, tempfile.TemporaryDirectory() as folder:
        source, viewer = Path(folder) / "splat.ply", Path(folder) / "viewer.json"
        write_gaussians(source, g)
        viewer.write_text(json.dumps(start.settings()))
        options = ["--quiet", "--overwrite", *([] if on_gpu else ["--gpu", "cpu"]), "--viewer-settings", str(viewer)]
        _run([*command, *options, str(source), str(target)])
        if not target.is_file():
            raise SettingError(f"{command[0]} wrote no page. Choose another format, or install it anew.")


def _run(command: Sequence[str]) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
    except subprocess.CalledProcessError as error:
        said = " ".join((error.stderr or error.stdout or "").split())[-300:]
        raise SettingError(f"{Path(command[0]).name} failed: {said}. Choose another format.") from error
