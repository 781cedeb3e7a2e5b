"""Captures with poses as they are downloaded: each ends well, or with one line that names file and cure.

Folders of photos without poses are in test_untidy_photos.py.
"""

from __future__ import annotations

import os
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
# What happens to photos, what the refusal says, the setting that goes on without them, and the photos that are then used.
DEFECTS: dict[str, tuple[Callable[[Path], object], tuple[str, ...], dict[str, object], str]] = {
    "missing": (lambda f: (f / "b.png").unlink(), ("1 of ", "b.png", "data.missing=skip"), {"missing": "skip"}, "ac"),
    "truncated": (lambda f: os.truncate(f / "b.png", 200), ("b.png", "data.broken=skip"), {"broken": "skip"}, "ac"),
    "linked": (lambda f: captures.link(f, f.parents[1] / "elsewhere"), ("leads out of", "data.reader.allow_outside=true"),
               {"allow_outside": True}, "abc"),
}  # fmt: skip
# LLFF's table has rows without names: a missing photo is not known.
CASES = [(defect, reader) for defect in DEFECTS for reader in READERS if (defect, reader) != ("missing", "llff")]


def built(tmp_path: Path, reader: str) -> tuple[Path, Path, Callable[..., Capture]]:
    """(root, folder of the photos, read) of a tidy capture."""
    write, read, folder = READERS[reader]
    root = write(tmp_path / "capture")
    return root, root / folder, read


@pytest.mark.parametrize(("defect", "reader"), CASES)
def test_a_defect_is_refused_in_one_line_with_the_setting_that_goes_on(tmp_path, defect, reader, caplog):
    root, folder, read = built(tmp_path, reader)
    spoil, says, cure, used = DEFECTS[defect]
    spoil(folder)
    with pytest.raises(DataError) as refusal:
        [frame.load() for frame in read(root).frames]
    assert "\n" not in str(refusal.value)
    assert all(part in str(refusal.value) for part in says), str(refusal.value)
    capture = read(root, **cure)
    assert [Path(frame.name).stem for frame in capture.frames] == list(used)
    assert all(bool(frame.load().isfinite().all()) for frame in capture.frames)
    assert ("b.png" in caplog.text) == (used == "ac")


def test_a_capture_without_any_photo_is_refused_even_where_missing_ones_are_skipped(tmp_path):
    root, folder, read = built(tmp_path, "nerfstudio")
    for name in NAMES:
        (folder / name).unlink()
    with pytest.raises(DataError, match=r"transforms\.json: photos: none of 3 can be used: check the path"):
        read(root, missing="skip")


@pytest.mark.parametrize("rotate", [True, False])
def test_a_photo_on_its_side_is_turned_where_the_camera_is_not_that_of_the_stored_pixels(tmp_path, rotate):
    root, folder, read = built(tmp_path, "colmap")
    expected = captures.turn(folder / "b.png", 6, rotate=rotate)
    frame = read(root).frames[1]
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal((frame.load() * 255).round().to(torch.uint8), torch.from_numpy(expected))
