"""Captures as they are downloaded and copied from phones: each ends well, or with one line that names file and cure."""

from __future__ import annotations

import logging
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.data.capture import Capture
from clear_strategies.data.readers import blender, colmap, llff, nerfstudio, photos
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
def test_a_missing_photo_is_counted_and_named_with_its_cure(tmp_path, reader):
    root, folder, read = built(tmp_path, reader)
    (folder / "b.png").unlink()
    with pytest.raises(DataError) as refusal:
        read(root)
    one_line(refusal, "1 of ", "b.png", "data.missing=skip")


@pytest.mark.parametrize("reader", SKIPPING)
def test_missing_photos_are_skipped_on_request(tmp_path, reader, caplog):
    root, folder, read = built(tmp_path, reader)
    (folder / "b.png").unlink()
    capture = read(root, missing="skip")
    assert names(capture) == ["a", "c"]
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
    elsewhere = tmp_path / "elsewhere"
    shutil.move(folder, elsewhere)
    folder.mkdir()
    for name in NAMES:
        (folder / name).symlink_to(elsewhere / name)
    with pytest.raises(DataError) as refusal:
        read(root)
    one_line(refusal, "leads out of", "data.reader.allow_outside=true")
    assert names(read(root, allow_outside=True)) == ["a", "b", "c"]


def turn(path: Path, orientation: int, *, rotate: bool) -> np.ndarray:
    """Store a photo turned, as its EXIF block then says; its upright pixels. `rotate` keeps the upright view the same."""
    with Image.open(path) as image:
        upright = image.convert("RGB")
    stored = upright.transpose(Image.Transpose.ROTATE_90) if rotate else upright
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored.save(path, exif=exif)
    return np.asarray(upright)


def test_a_photo_on_its_side_is_turned_where_the_camera_is_upright(tmp_path):
    root, folder, read = built(tmp_path, "colmap")
    upright = turn(folder / "b.png", 6, rotate=True)
    frame = read(root).frames[1]
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal((frame.load() * 255).round().to(torch.uint8), torch.from_numpy(upright.copy()))


def test_a_photo_on_its_side_stays_where_the_camera_is_that_of_the_stored_pixels(tmp_path):
    root, folder, read = built(tmp_path, "colmap")
    stored = turn(folder / "b.png", 6, rotate=False)
    frame = read(root).frames[1]
    assert torch.equal((frame.load() * 255).round().to(torch.uint8), torch.from_numpy(stored.copy()))


def test_a_photo_upside_down_is_refused_because_no_camera_tells(tmp_path):
    root, folder, read = built(tmp_path, "colmap")
    turn(folder / "b.png", 3, rotate=False)
    with pytest.raises(DataError) as refusal:
        read(root)
    one_line(refusal, "b.png", "EXIF orientation", "mogrify -auto-orient")


# What follows are folders of photos; structure from motion is replaced by a model that is there already.


@pytest.fixture
def of_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Callable[..., Capture]]:
    """A folder of three photos, and what reads it."""
    model = captures.colmap_bin(tmp_path / "model") / "sparse" / "0"
    monkeypatch.setattr(photos.sfm, "copy_name", lambda i: NAMES[i])
    monkeypatch.setattr(photos.sfm, "reconstruct", lambda root, found, folder, settings: shutil.copytree(model, folder))
    captures.write_photos(tmp_path / "photos")
    return tmp_path / "photos", lambda **settings: photos.read(tmp_path / "photos", tmp_path / "cache", **settings)


def test_photos_turned_by_exif_are_upright_whatever_the_turn(of_photos):
    folder, read = of_photos
    upright = turn(folder / "b.png", 6, rotate=True)
    assert torch.equal((read().frames[1].load() * 255).round().to(torch.uint8), torch.from_numpy(upright.copy()))
    turn(folder / "a.png", 3, rotate=False)
    read()  # also upside down


def test_heic_is_read_whatever_its_name_says(of_photos):
    heif = pytest.importorskip("pillow_heif")
    folder, read = of_photos
    with Image.open(folder / "b.png") as image:
        large = image.convert("RGB").resize((64, 48))
    (folder / "b.png").unlink()
    heif.register_heif_opener()
    large.save(folder / "b.jpg", format="HEIF")
    capture = read()
    assert [frame.name for frame in capture.frames] == ["a.png", "b.jpg", "c.png"]
    assert capture.frames[1].load().shape == (48, 64, 3)


def test_heic_without_its_library_is_named_with_the_extra(of_photos, monkeypatch):
    folder, read = of_photos
    (folder / "b.png").unlink()
    (folder / "b.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(DataError) as refusal:
        read()
    one_line(refusal, "b.heic", "clear-strategies[heic]")


def test_a_photo_that_is_there_twice_is_used_once(of_photos, caplog):
    folder, read = of_photos
    (folder / "b.HEIC").write_bytes(b"never opened")
    with caplog.at_level(logging.INFO):
        assert len(read().frames) == 3
    assert "b.HEIC" in caplog.text


def test_what_a_mac_and_a_phone_leave_beside_photos_is_no_photo(of_photos):
    folder, read = of_photos
    (folder / "._a.png").write_bytes(b"AppleDouble")
    (folder / "clip.mov").write_bytes(b"video")
    (folder / "Thumbs.db").write_bytes(b"thumbs")
    assert names(read()) == ["a", "b", "c"]


def test_a_text_file_among_the_photos_is_named_and_skipped_on_request(of_photos):
    folder, read = of_photos
    (folder / "d.jpg").write_text("404 not found")
    with pytest.raises(DataError) as refusal:
        read()
    one_line(refusal, "d.jpg", "data.broken=skip")
    assert names(read(broken="skip")) == ["a", "b", "c"]


def test_too_few_usable_photos_are_refused_with_advice(of_photos):
    folder, read = of_photos
    (folder / "b.png").write_bytes(b"")
    with pytest.raises(DataError, match="there are 2, poses need at least 3: take more photos"):
        read(broken="skip")


def test_a_link_to_nowhere_is_no_photo(of_photos):
    folder, read = of_photos
    (folder / "d.png").symlink_to(folder / "gone.png")
    assert names(read()) == ["a", "b", "c"]


def test_different_exposures_are_said(of_photos, caplog):
    folder, read = of_photos
    for name, time in (("a", 0.01), ("b", 0.04), ("c", 0.01)):
        exif = Image.Exif()
        exif[0x8769] = {0x829A: time, 0x829D: 2.0, 0x8827: 100}
        with Image.open(folder / f"{name}.png") as image:
            image.save(folder / f"{name}.png", exif=exif)
    assert read().notes["exposure"].startswith("differs by 2.0 stops between a.png and b.png")
    assert "exposure" in caplog.text


def test_an_empty_folder_and_a_wrong_path_are_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    for folder, what in ((tmp_path / "empty", "holds no image"), (tmp_path / "nowhere", "is not there")):
        with pytest.raises(DataError) as refusal:
            photos.read(folder, tmp_path / "cache")
        one_line(refusal, folder.name, what, "check the path")
