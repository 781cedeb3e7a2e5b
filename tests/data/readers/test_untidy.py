"""Captures with poses as they are downloaded: each ends well, or with one line that names file and cure.

Folders of photos without poses are in test_untidy_photos.py.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import blender, colmap, llff, nerfstudio
from clear_strategies.errors import DataError
from tests.helpers import captures
from tests.helpers.captures import HEIGHT, NAMES, WIDTH

READERS = {
    "colmap": (captures.colmap_bin, colmap.read, "images"),
    "nerfstudio": (captures.nerfstudio, nerfstudio.read, "images"),
    "blender": (captures.blender, blender.read, "train"),
    "llff": (captures.llff, llff.read, "images_4"),
}
SKIPPING = ["colmap", "nerfstudio", "blender"]  # LLFF's table has rows without names: a missing photo is not known


def names(capture: Capture) -> list[str]:
    return [Path(frame.name).stem for frame in capture.frames]


def built(tmp_path: Path, reader: str) -> tuple[Path, Path, Callable[..., Capture]]:
    """(root, folder of the photos, read) of a tidy capture."""
    write, read, folder = READERS[reader]
    root = write(tmp_path / "capture")
    return root, root / folder, read


def one_line(refusal: pytest.ExceptionInfo[DataError], *parts: str) -> None:
    assert "\n" not in str(refusal.value)
    assert all(part in str(refusal.value) for part in parts), str(refusal.value)


@pytest.mark.parametrize("reader", SKIPPING)
def test_a_missing_photo_is_counted_and_named_with_its_cure_and_skipped_on_request(tmp_path, reader, caplog):
    root, folder, read = built(tmp_path, reader)
    (folder / "b.png").unlink()
    with pytest.raises(DataError) as refusal:
        read(root)
    one_line(refusal, "1 of ", "b.png", "data.missing=skip")
    assert names(read(root, missing="skip")) == ["a", "c"]
    assert "b.png. They are skipped." in caplog.text


def test_a_capture_without_any_photo_is_refused_even_where_missing_ones_are_skipped(tmp_path):
    root, folder, read = built(tmp_path, "nerfstudio")
    for name in NAMES:
        (folder / name).unlink()
    with pytest.raises(DataError, match=r"transforms\.json: photos: none of 3 can be used: check the path"):
        read(root, missing="skip")


@pytest.mark.parametrize("reader", READERS)
def test_a_truncated_photo_is_named_with_its_cure_and_skipped_on_request(tmp_path, reader, caplog):
    root, folder, read = built(tmp_path, reader)
    whole = (folder / "b.png").read_bytes()
    (folder / "b.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError) as refusal:
        [frame.load() for frame in read(root).frames]
    one_line(refusal, "b.png", "data.broken=skip")
    capture = read(root, broken="skip")
    assert names(capture) == ["a", "c"]
    assert all(bool(frame.load().isfinite().all()) for frame in capture.frames)
    assert "b.png" in caplog.text


@pytest.mark.parametrize("reader", READERS)
def test_linked_photos_are_followed_by_a_switch_that_the_refusal_names(tmp_path, reader):
    root, folder, read = built(tmp_path, reader)
    captures.link(folder, tmp_path / "elsewhere")
    with pytest.raises(DataError) as refusal:
        read(root)
    one_line(refusal, "leads out of", "data.reader.allow_outside=true")
    assert names(read(root, allow_outside=True)) == ["a", "b", "c"]


@pytest.mark.parametrize("rotate", [True, False])
def test_a_photo_on_its_side_is_turned_where_the_camera_is_not_that_of_the_stored_pixels(tmp_path, rotate):
    root, folder, read = built(tmp_path, "colmap")
    expected = captures.turn(folder / "b.png", 6, rotate=rotate)
    frame = read(root).frames[1]
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal((frame.load() * 255).round().to(torch.uint8), torch.from_numpy(expected))
