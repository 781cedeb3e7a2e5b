"""Captures with poses: what all readers do alike, with tidy files and with those that people have.

Folders of photos without poses are in test_untidy_photos.py.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from clear_strategies.data.capture import Capture
from clear_strategies.errors import DataError
from tests.helpers import captures
from tests.helpers.captures import GOOD, HEIGHT, NAMES, READERS, WIDTH

PHOTOS = {"colmap": "images", "nerfstudio": "images", "blender": "train"}
# What is done to the photos, and parts of the message.
DEFECTS: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "missing": (lambda f: (f / "b.png").unlink(), ("1 of ", ": b", "data.reader.skip_faulty=true")),
    "truncated": (lambda f: os.truncate(f / "b.png", 200), ("b.png", "data.reader.skip_faulty=true")),
}
CASES = [(defect, reader) for defect in DEFECTS for reader in PHOTOS]


def built(tmp_path: Path, reader: str) -> tuple[Path, Path, Callable[..., Capture]]:
    """(root, folder of the photos, read) of a tidy capture."""
    root = GOOD[reader](tmp_path / "capture")
    return root, root / PHOTOS[reader], READERS[reader]


@pytest.mark.parametrize(("defect", "reader"), CASES)
def test_a_defect_is_refused_in_one_line_with_the_setting_that_goes_on(tmp_path, defect, reader, caplog):
    root, folder, read = built(tmp_path, reader)
    spoil, message = DEFECTS[defect]
    spoil(folder)
    with pytest.raises(DataError) as refusal:
        [frame.load() for frame in read(root).frames]
    assert "\n" not in str(refusal.value)
    assert all(part in str(refusal.value) for part in message), str(refusal.value)
    capture = read(root, skip_faulty=True)
    assert [Path(frame.name).stem for frame in capture.frames] == ["a", "c"]
    assert all(bool(frame.load().isfinite().all()) for frame in capture.frames)
    assert len([record for record in caplog.records if "skipped: " in record.message and "/b" in record.message]) == 1


def test_a_capture_without_any_photo_is_refused_even_where_faulty_ones_are_skipped(tmp_path):
    root, folder, read = built(tmp_path, "nerfstudio")
    for name in NAMES:
        (folder / name).unlink()
    with pytest.raises(DataError, match=r"transforms\.json: photos: none of 3 is in .*/images, such as a\.png"):
        read(root, skip_faulty=True)


@pytest.mark.parametrize("rotate", [True, False])
def test_a_photo_on_its_side_is_turned_where_the_camera_is_not_that_of_the_stored_pixels(tmp_path, rotate):
    root, folder, read = built(tmp_path, "colmap")
    expected = captures.turn(folder / "b.png", 6, rotate=rotate)
    frame = read(root).frames[1]
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal((frame.load() * 255).round().to(torch.uint8), torch.from_numpy(expected))


@pytest.mark.parametrize("kind", GOOD)
def test_reading_poses_decodes_no_photo(kind: str, tmp_path: Path) -> None:
    """Truncated photos still have their headers: they are read, and refused when they are loaded."""
    root = GOOD[kind](tmp_path)
    for path in root.rglob("*.png"):
        path.write_bytes(path.read_bytes()[:-60])
    for frame in READERS[kind](root).frames:
        with pytest.raises(DataError, match="pixels: cannot be decoded"):
            frame.load()
