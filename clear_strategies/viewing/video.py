"""Frames as a video: H.264 in MP4, which browsers play, and GIF."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import UInt8

from clear_strategies import files
from clear_strategies.errors import SettingError

GIF_WIDTH: Final = 480  # px, at most
_GIF_FPS: Final = 15
_QUALITY: Final = "20"  # x264's CRF: 18 cannot be told from the frames, 23 is its default
# Without a word in the file, players guess BT.709 for large pictures and BT.601 for small ones; ffmpeg itself makes BT.601.
_HD: Final = "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709"
_SMALLER: Final = "fps={fps},scale='min({width},iw)':-2:flags=lanczos,split[a][b]"
_ONE_PALETTE: Final = "[a]palettegen=stats_mode=diff[p];[b][p]paletteuse=dither=bayer"  # of all colours of the GIF

Frame = UInt8[np.ndarray, "_ _ 3"]


def missing() -> str | None:
    """Why no video can be written, with the remedy; None where imageio-ffmpeg and a program of ffmpeg are installed."""
    if find_spec("imageio_ffmpeg") is None:
        return "videos need imageio-ffmpeg: pip install imageio-ffmpeg"
    import imageio_ffmpeg

    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        return "videos need ffmpeg, and that of imageio-ffmpeg does not run here: install ffmpeg"
    return None


def write_videos(paths: Iterable[Path], frames: Iterable[Frame], *, fps: float) -> None:
    """Write the same frames into every file, `.mp4` or `.gif`, while they come. GIFs are at most `GIF_WIDTH` wide.

    Args:
        frames: all of one size, with an even height and width.

    Raises:
        SettingError: ffmpeg is missing, a suffix is another one, or there is no frame.
    """
    if (problem := missing()) is not None:
        raise SettingError(f"{problem}.")
    with ExitStack() as stack:
        sends: list[Callable[[Any], Any]] = []
        for frame in frames:
            if not sends:
                sends = [_opened(stack, path, frame.shape[1], frame.shape[0], fps) for path in paths]
            for send in sends:
                send(np.ascontiguousarray(frame))
        if not sends:
            raise SettingError("a video needs at least 1 frame.")


def _opened(stack: ExitStack, path: Path, width: int, height: int, fps: float) -> Callable[[Any], Any]:
    """Start ffmpeg on a file that takes its name when the stack ends without an error."""
    import imageio_ffmpeg

    if path.suffix == ".mp4":
        codec, pixels = "libx264", "yuv420p"
        extra = ["-vf", _HD, "-crf", _QUALITY, "-preset", "medium", "-movflags", "+faststart"]
    elif path.suffix == ".gif":
        codec, pixels = "gif", "pal8"
        smaller = _SMALLER.format(fps=min(fps, _GIF_FPS), width=GIF_WIDTH)
        extra = ["-filter_complex", f"{smaller};{_ONE_PALETTE}", "-loop", "0"]
    else:
        raise SettingError(f"{path}: a video must be .mp4 or .gif. Choose another suffix.")
    partial = stack.enter_context(files.replacing(path.absolute()))  # ffmpeg takes "a:" at the beginning for a protocol
    writer: Any = imageio_ffmpeg.write_frames(
        str(partial), (width, height), fps=fps, codec=codec, pix_fmt_out=pixels, quality=None, output_params=extra,
        macro_block_size=2, ffmpeg_log_level="error",
    )  # fmt: skip
    stack.callback(writer.close)
    writer.send(None)
    send: Callable[[Any], Any] = writer.send
    return send
