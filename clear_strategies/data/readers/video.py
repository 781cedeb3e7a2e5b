"""A video of a still scene: its sharpest frames, evenly spread over the camera's path, as photos without poses.

The frames are cached by the video's content; `photos` reads their folder as any other.
"""

from __future__ import annotations

import hashlib
import logging
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image

from clear_strategies import files
from clear_strategies.core.progress import Progress
from clear_strategies.data.priors import cache_folder
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

CHOICE: Final = "choice.txt"

_FEWEST_OF_ALL: Final = 3  # places that poses need
_WIDTH: Final = 320  # px of the frames whose sharpness and movement are measured
_STEP: Final = 0.12  # of the width: how far the picture moves from one chosen frame to the next, by default
_FEWEST, _MOST = 12, 40  # frames that are chosen by default
_STILL: Final = 0.002  # of the width: a frame that moves less shows the same as the one before
_BLURRED: Final = 0.5  # of the median sharpness around it
_AROUND: Final = 15  # frames before and after that the median is taken of
_REMEDY: Final = "name a video of the scene, or the folder of its photos"

Pixels = UInt8[np.ndarray, "h w c"]


def frames_of(path: Path, count: int | None) -> Path:
    """The folder of the chosen frames of a video, JPEG files and a summary of the choice in `CHOICE`.

    Args:
        count: how many; None: one for each eighth of the width that the picture moves, at least 12 and at most 40.

    Raises:
        DataError: ffmpeg cannot read the video, or it shows too few places.
    """
    folder = cache_folder() / "video" / _key(path, count)
    if not (folder / CHOICE).is_file():
        _write_chosen(path, count, folder)
    _log.info("%s: %s: %s", path.name, (folder / CHOICE).read_text(), folder)
    return folder


def choose(
    sharpness: Float[np.ndarray, " n"], movement: Float[np.ndarray, " n"], count: int | None
) -> tuple[Int[np.ndarray, " c"], str]:
    """The sharpest frame of each of `count` equally long parts of the path, by their numbers, and a summary of the choice.

    Args:
        sharpness: of each frame, any unit.
        movement: from the frame before, as a share of the width.
        count: None: by the length of the path.
    """
    usual = np.array([np.median(sharpness[max(i - _AROUND, 0) : i + _AROUND + 1]) for i in range(len(sharpness))])
    relative, path = sharpness / np.maximum(usual, 1e-12), np.cumsum(movement)
    if count is None:
        count = int(np.clip(round(path[-1] / _STEP), _FEWEST, _MOST))
    part = np.minimum((path / max(path[-1], 1e-12) * count).astype(int), count - 1)
    kept = [members[np.argmax(relative[members])] for k in range(count) if len(members := np.flatnonzero(part == k))]
    blurred, still = int((relative < _BLURRED).sum()), int((movement[1:] < _STILL).sum())
    summary = f"{len(kept)} of {len(sharpness)} frames ({blurred} blurred, {still} without movement)"
    return np.array(kept, dtype=int), summary


def _write_chosen(path: Path, count: int | None, folder: Path) -> None:
    """Write the chosen frames and the summary of the choice into `folder`, which appears when it is complete."""
    chosen, summary = choose(*_scores(path), count)
    if len(chosen) < _FEWEST_OF_ALL:
        problem = f"shows only {len(chosen)} places, because the camera hardly moves"
        raise DataError(path, "video", problem, "walk around the scene while you record")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as work:
        frames = Path(work) / "frames"
        frames.mkdir()
        pixels = _frames(path, f"select={_any_of(chosen.tolist())}", "rgb24")
        written = 0
        for written, frame in enumerate(pixels, start=1):
            Image.fromarray(frame).save(frames / f"{path.stem}_{written:03d}.jpg", quality=95, subsampling=0)
        if written != len(chosen):
            raise DataError(path, "video", f"gives {written} of the {len(chosen)} chosen frames", _REMEDY)
        (frames / CHOICE).write_text(summary)
        files.install(frames, folder, CHOICE)


def _any_of(numbers: Sequence[int]) -> str:
    """The expression that selects these frames in ffmpeg, a balanced tree: its parser refuses a long sum."""
    if len(numbers) == 1:
        return f"eq(n\\,{numbers[0]})"
    half = len(numbers) // 2
    return f"({_any_of(numbers[:half])}+{_any_of(numbers[half:])})"


def _scores(path: Path) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """(sharpness, movement) of each frame."""
    import cv2

    flow_of: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    sharpness, movement = [], []
    last: Any = None
    progress = Progress(f"{path.name}: looking for sharp frames", "frames", total=1 << 30)
    for pixels in _frames(path, f"scale={_WIDTH}:-2", "gray"):
        frame = pixels[..., 0]
        sharpness.append(float(cv2.Laplacian(frame, cv2.CV_32F).var()) / max(float(frame.var()), 1.0))
        flow = np.zeros((1, 1, 2)) if last is None else flow_of.calc(last, frame, None)
        movement.append(float(np.median(np.hypot(flow[..., 0], flow[..., 1]))) / frame.shape[1])
        last = frame
        progress(len(sharpness))
    if len(sharpness) < _FEWEST_OF_ALL:
        raise DataError(path, "video", f"ffmpeg finds {len(sharpness)} frames in it", _REMEDY)
    return np.array(sharpness), np.array(movement)


def _frames(path: Path, filters: str, layout: Literal["gray", "rgb24"]) -> Iterator[Pixels]:
    """The frames of a video behind ffmpeg's filters, upright; none where ffmpeg cannot read it.

    Raises:
        DataError: imageio-ffmpeg is not installed.
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise DataError("video", "ffmpeg", "is not installed", "pip install 'clear-strategies[train]'") from error
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns of frames of another size than the file's
    channels = {"gray": 1, "rgb24": 3}[layout]
    reader = imageio_ffmpeg.read_frames(
        f"file:{path}",  # without "file:", the part before a colon, as in 10:30.mp4, is a protocol
        layout, bits_per_pixel=8 * channels, output_params=["-vf", filters, "-fps_mode", "passthrough"],
    )  # fmt: skip
    try:
        width, height = next(reader)["size"]
        for data in reader:
            yield np.frombuffer(data, np.uint8).reshape(height, width, channels)
    except (OSError, RuntimeError) as error:
        _log.debug("%s: %s", path, error)


def _key(path: Path, count: int | None) -> str:
    digest = hashlib.sha256(repr(("all frames by path and sharpness, by Pillow", count, path.stem)).encode())
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()[:24]
