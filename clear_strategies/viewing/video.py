"""Frames as a video: H.264 in MP4, which browsers play."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import UInt8

from clear_strategies import files
from clear_strategies.errors import SettingError

FPS: Final = 24.0  # along a path
_QUALITY: Final = "20"  # x264's CRF: 18 cannot be told from the frames, 23 is its default
# Without a word in the file, players guess BT.709 for large pictures and BT.601 for small ones; ffmpeg itself makes BT.601.
_HD: Final = "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709"

Pixels = UInt8[np.ndarray, "_ _ 3"]


def write_video(path: Path, frames: Iterable[Pixels], *, fps: float = FPS) -> None:
    """Write the frames into an MP4 file while they come; the file takes its name when it is whole.

    Args:
        frames: all of one size, with an even height and width.

    Raises:
        SettingError: imageio-ffmpeg or its program is missing, the file is no .mp4, or there is no frame.
    """
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except ImportError as error:
        raise SettingError("videos need imageio-ffmpeg: pip install imageio-ffmpeg.") from error
    except RuntimeError as error:
        problem = "videos need ffmpeg, and that of imageio-ffmpeg does not run here: install ffmpeg."
        raise SettingError(problem) from error
    if path.suffix != ".mp4":
        raise SettingError(f"{path}: a video must be .mp4. Choose this suffix.")
    coming = iter(frames)
    if (first := next(coming, None)) is None:
        raise SettingError("a video needs at least 1 frame.")
    with files.replacing(path.absolute()) as partial:  # ffmpeg takes "a:" at the beginning for a protocol
        writer = imageio_ffmpeg.write_frames(
            str(partial), first.shape[1::-1], fps=fps, codec="libx264", pix_fmt_out="yuv420p", quality=None,
            output_params=["-vf", _HD, "-crf", _QUALITY, "-preset", "medium", "-movflags", "+faststart"],
            macro_block_size=2, ffmpeg_log_level="error",
        )  # fmt: skip
        writer.send(None)
        try:
            for frame in itertools.chain([first], coming):
                writer.send(np.ascontiguousarray(frame))
        finally:
            writer.close()
