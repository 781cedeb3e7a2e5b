"""A video of a still scene: its sharpest frames, evenly spread over the camera's path, as photos without poses.

The frames lie in the cache, by the video's content; `photos` reads their folder as it does any other.
"""

from __future__ import annotations

import hashlib
import logging
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int, UInt8

from clear_strategies import files
from clear_strategies.core.progress import Progress
from clear_strategies.data.priors import cache_folder
from clear_strategies.errors import DataError

_log = logging.getLogger(__name__)

CHOICE: Final = "choice.txt"

_FEWEST_OF_ALL: Final = 3  # places without which there are no poses
_WIDTH: Final = 320  # px at which frames are judged
_STEP: Final = 0.12  # of the width: how far the picture moves from one chosen frame to the next, by default
_FEWEST, _MOST = 12, 40  # frames that are chosen by default
_STILL: Final = 0.002  # of the width: a frame that moves less shows what the one before shows
_BLURRED: Final = 0.5  # of the median sharpness around it
_AROUND: Final = 15  # frames before and after that the median is taken of
# Readers of JPEG files take BT.601 for granted; videos are mostly BT.709, and ffmpeg would leave them so.
_AS_JPEG: Final = "scale=out_color_matrix=bt601:out_range=full"
_REMEDY: Final = "name a video of the scene, or the folder of its photos"

Grey = UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, slots=True)
class Choice:
    """The frames that are kept, by their numbers, and why the others are not.

    Args:
        blurred, still: how many frames are less than half as sharp as those around them, and how many show nothing new.
    """

    frames: Int[np.ndarray, " n"]
    total: int
    blurred: int
    still: int

    def summary(self) -> str:
        return f"{len(self.frames)} of {self.total} frames ({self.blurred} blurred, {self.still} without movement)"


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


def choose(sharpness: Float[np.ndarray, " n"], movement: Float[np.ndarray, " n"], count: int | None) -> Choice:
    """The sharpest frame of each of `count` parts of the path that are equally long.

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
    return Choice(np.array(kept, dtype=int), len(sharpness), blurred, still)


def _write_chosen(path: Path, count: int | None, folder: Path) -> None:
    """Choose frames, and write them and the summary of the choice into a folder that appears when it is complete."""
    choice = choose(*_judged(path), count)
    if len(choice.frames) < _FEWEST_OF_ALL:
        problem = f"shows only {len(choice.frames)} places, because the camera hardly moves"
        raise DataError(path, "video", problem, "walk around the scene while you record")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{folder.name}.", dir=folder.parent) as work:
        made = Path(work) / "frames"
        made.mkdir()
        pattern = str(made / f"{path.stem.replace('%', '_')}_%03d.jpg")
        chosen = f"select={_any_of(choice.frames.tolist())},{_AS_JPEG}"
        command = [*_filtered(path, chosen), "-q:v", "1", pattern]
        ended = subprocess.run(command, check=False, stdin=subprocess.DEVNULL)  # noqa: S603 - ffmpeg, by arguments
        written = len(list(made.iterdir()))
        if ended.returncode != 0 or written != len(choice.frames):
            problem = f"ffmpeg wrote {written} of the {len(choice.frames)} chosen frames (exit code {ended.returncode})"
            raise DataError(path, "video", problem, f"see what it says above, and the space left in {folder.parent}")
        (made / CHOICE).write_text(choice.summary())
        files.install(made, folder, CHOICE)


def _any_of(numbers: Sequence[int]) -> str:
    """The expression of these frames in ffmpeg, a balanced tree: its parser refuses a long sum."""
    if len(numbers) == 1:
        return f"eq(n\\,{numbers[0]})"
    half = len(numbers) // 2
    return f"({_any_of(numbers[:half])}+{_any_of(numbers[half:])})"


def _judged(path: Path) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """(sharpness, movement) of each frame."""
    import cv2

    flow_of: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    sharpness, movement = [], []
    before: Any = None
    progress = Progress(f"{path.name}: looking for sharp frames", "frames", total=1 << 30)
    for frame in _small_frames(path):
        sharpness.append(float(cv2.Laplacian(frame, cv2.CV_32F).var()) / max(float(frame.var()), 1.0))
        flow = np.zeros((1, 1, 2)) if before is None else flow_of.calc(before, frame, None)
        movement.append(float(np.median(np.hypot(flow[..., 0], flow[..., 1]))) / frame.shape[1])
        before = frame
        progress(len(sharpness))
    if len(sharpness) < _FEWEST_OF_ALL:
        raise DataError(path, "video", f"ffmpeg finds {len(sharpness)} frames in it", _REMEDY)
    return np.array(sharpness), np.array(movement)


def _small_frames(path: Path) -> Iterator[Grey]:
    """Every frame, upright, grey and `_WIDTH` wide: ffmpeg writes them as PGM, each with its size."""
    command = [*_filtered(path, f"scale={_WIDTH}:-2,format=gray"), "-f", "image2pipe", "-c:v", "pgm", "-"]
    with subprocess.Popen(  # noqa: S603 - ffmpeg, by arguments
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        if process.stdout is None:
            return
        while process.stdout.readline().strip() == b"P5":
            width, height = (int(word) for word in process.stdout.readline().split())
            process.stdout.readline()  # the largest value
            data = process.stdout.read(width * height)
            if len(data) < width * height:
                return
            yield np.frombuffer(data, np.uint8).reshape(height, width)


def _filtered(path: Path, filters: str) -> list[str]:
    """The command that gives a video's frames, filtered, by imageio-ffmpeg's ffmpeg; a DataError if that is not installed."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise DataError("video", "ffmpeg", "is not installed", "pip install 'clear-strategies[train]'") from error
    ffmpeg = str(imageio_ffmpeg.get_ffmpeg_exe())
    file = f"file:{path}"  # what stands before a colon, as in 10:30.mp4, would be a protocol
    return [ffmpeg, "-v", "error", "-i", file, "-vf", filters, "-fps_mode", "passthrough"]


def _key(path: Path, count: int | None) -> str:
    digest = hashlib.sha256(repr(("all frames by path and sharpness, BT.601", count, path.stem)).encode())
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()[:24]
