"""Rendering a field by the run's rasterizer, colouring depth, and writing videos: H.264 in MP4, which browsers play."""

from __future__ import annotations

import errno
import itertools
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from clear_strategies import files
from clear_strategies.errors import SettingError
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import constant_band, depths
from rasterizers.interface import Camera, Rasterizer

_SOLID: Final = 0.5  # alpha of a pixel from which it has a depth
_EXTREMES: Final = (0.02, 0.98)  # quantiles of depth at the ends of the range
_UNKNOWN: Final = "#cccccc"
FPS: Final = 24.0  # along a path
_QUALITY: Final = "20"  # x264's CRF: 18 cannot be told from the frames, 23 is its default
# If the file does not name the colour matrix, players assume BT.709 for large pictures and BT.601 for small ones; ffmpeg writes
# BT.601 by default.
_HD: Final = "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709"

Pixels = UInt8[np.ndarray, "_ _ 3"]


class Painter:
    """Renders a field, by the rasterizer of the run (`rasterizer`).

    Args:
        make: returns that rasterizer; takes fields of `RasterSettings`, which override the run's.
    """

    def __init__(self, field: GaussianField, make: Callable[..., Rasterizer]) -> None:
        self.field, self.rasterizer = field, make()
        self._over_black = make(background=(0.0, 0.0, 0.0))

    @torch.no_grad()
    def color(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """Render the image, in [0, 1], on the CPU."""
        image = self.rasterizer(self.field.baked(), camera).image
        return image.clamp(0, 1).nan_to_num().cpu()

    @torch.no_grad()
    def depth(self, camera: Camera) -> Float[Tensor, "H W"]:
        """Render the mean depth z of each pixel, world units, on the CPU; nan where alpha is below 1/2."""
        means = self.field.means.data
        z = depths(means, camera.world_to_camera.to(means))
        drawn = self.numbers(camera, torch.stack([z, torch.ones_like(z), torch.zeros_like(z)], dim=1))
        z_sum, alpha = drawn[..., 0], drawn[..., 1]
        return torch.where(alpha >= _SOLID, z_sum / alpha.clamp_min(_SOLID), torch.nan).cpu()

    @torch.no_grad()
    def numbers(self, camera: Camera, values: Float[Tensor, "N 3"]) -> Float[Tensor, "H W 3"]:
        """Render three numbers >= 0 per Gaussian in place of its colour, over 0, on the device of the field."""
        splats = self.field.baked()
        painted = replace(splats, sh0=constant_band(values), shN=splats.shN[:, :0], rgb_offset=None)
        return self._over_black(painted, camera).image


def depth_range(depth: Float[Tensor, "*shape"]) -> tuple[float, float]:
    """The range of depths, world units, for `colored`; without those that are not finite, or (0, 1) if none is."""
    known = depth[depth.isfinite()].cpu().numpy()  # torch.quantile takes 16 million numbers at most
    if not len(known):
        return 0.0, 1.0
    near, far = (float(np.quantile(known, q)) for q in _EXTREMES)
    return near, max(far, near * (1 + 1e-6) + 1e-6)


def colored(depth: Float[Tensor, "H W"], near: float, far: float) -> UInt8[np.ndarray, "H W 3"]:
    """Map depth to colours: near is bright, and grey where it is not finite."""
    from matplotlib import colormaps

    colors = colormaps["viridis_r"].with_extremes(bad=_UNKNOWN)
    return np.asarray(colors(((depth - near) / (far - near)).numpy(), bytes=True)[..., :3])


def write_video(path: Path, frames: Iterable[Pixels]) -> None:
    """Write frames to an MP4 file as the iterable yields them; the file gets its name when it is complete.

    Args:
        frames: at least one, all of one size, with an even height and width.

    Raises:
        SettingError: imageio-ffmpeg or its program is missing.
        OSError: ffmpeg could not write the file, e.g. on a full disk.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except ImportError as error:
        raise SettingError("videos need imageio-ffmpeg: pip install imageio-ffmpeg.") from error
    except RuntimeError as error:
        problem = "videos need ffmpeg, and that of imageio-ffmpeg does not run here: install ffmpeg."
        raise SettingError(problem) from error
    rest = iter(frames)
    first = next(rest)
    with files.replacing(path.absolute()) as partial:  # ffmpeg interprets "a:" at the beginning as a protocol
        writer = imageio_ffmpeg.write_frames(
            str(partial), first.shape[1::-1], fps=FPS, codec="libx264", pix_fmt_out="yuv420p", quality=None,
            output_params=["-vf", _HD, "-crf", _QUALITY, "-preset", "veryfast", "-movflags", "+faststart"],
            macro_block_size=2, ffmpeg_log_level="error",
        )  # fmt: skip
        writer.send(None)
        try:
            for n, frame in enumerate(itertools.chain([first], rest), 1):  # noqa: B007 - their number
                writer.send(np.ascontiguousarray(frame))
        finally:
            writer.close()
        _require_frames(partial, n)


def _require_frames(path: Path, n: int) -> None:
    """Raise an OSError if the video does not have n frames: imageio-ffmpeg does not tell that ffmpeg failed at the end, as on a
    full disk.
    """
    import imageio_ffmpeg

    found = 0
    with suppress(RuntimeError):  # the file cannot be read at all
        found, _ = imageio_ffmpeg.count_frames_and_secs(path)
    if found != n:
        raise OSError(errno.EIO, f"ffmpeg could write {found} of {n} frames", str(path))
