"""Captures with poses and folders of photos as people have them: each ends well, or with a line that names file and remedy."""

import os
import shutil
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import torch
from PIL import Image

from clear_strategies.data.capture import Capture
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.readers import photos
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


# ---- folders of photos as phones and people leave them: each ends well, or with one line that names the file and the remedy
Read = Callable[..., Capture]


@pytest.fixture
def of_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Read]:
    """A folder of three photos, and what reads it."""
    model = captures.colmap_bin(tmp_path / "model") / "sparse" / "0"
    monkeypatch.setattr(photos.sfm, "copy_name", lambda i: NAMES[i] if i < len(NAMES) else f"{i}.jpg")

    def reconstruct(root: Path, found: Mapping[Path, object], folder: Path, settings: object) -> None:
        for path in found:  # it makes copies of all of them
            read_image(path, turn=True)
        shutil.copytree(model, folder)
        (folder / photos.sfm.UNPLACED).write_text("{}")

    monkeypatch.setattr(photos.sfm, "reconstruct", reconstruct)
    captures.write_photos(tmp_path / "photos")
    return tmp_path / "photos", lambda **settings: photos.read(tmp_path / "photos", tmp_path / "cache", **settings)


def image_of(path: Path) -> Image.Image:
    with Image.open(path) as image:
        return image.convert("RGB")


def again(folder: Path, name: str, **saving) -> None:
    """Save b anew, under a name and in a form."""
    image = image_of(folder / "b.png")
    (folder / "b.png").unlink()
    image.save(folder / name, **saving)


def as_heic(folder: Path, name: str) -> None:
    heif = pytest.importorskip("pillow_heif")
    heif.register_heif_opener()
    image_of(folder / "b.png").resize((64, 48)).save(folder / "b.png")
    again(folder, name, format="HEIF")


def beside(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).write_bytes(b"never opened")


def as_portrait(folder: Path) -> None:
    """Two pictures in one JPEG, the second of them depth: what phones save as a portrait."""
    depth = image_of(folder / "b.png").convert("L").convert("RGB")
    again(folder, "b.jpg", format="MPO", save_all=True, append_images=[depth])


# What the folder holds, and the photos that are then used.
ALL = list(NAMES)
READ: dict[str, tuple[Callable[[Path], object], list[str]]] = {
    "HEIC among others": (lambda f: as_heic(f, "b.heic"), ["a.png", "b.heic", "c.png"]),
    "HEIC that calls itself JPEG": (lambda f: as_heic(f, "b.jpg"), ["a.png", "b.jpg", "c.png"]),
    "a photo saved as HEIC and as JPEG": (lambda f: beside(f, "b.HEIC"), ALL),
    "what a Mac and a phone leave": (lambda f: beside(f, "._a.png", ".DS_Store", "clip.mov", "Thumbs.db"), ALL),
    "links to another folder": (lambda f: captures.link(f, f.parent / "elsewhere"), ALL),
    "a link to nowhere": (lambda f: (f / "d.png").symlink_to(f / "gone.png"), ALL),
    "an ending in capitals, a name with spaces": (lambda f: again(f, "b é (1).JPG"), ["a.png", "b é (1).JPG", "c.png"]),
    "masks among the photos": (
        lambda f: [Image.new("L", (captures.WIDTH, captures.HEIGHT), 1).save(f / f"{n}.mask.png") for n in NAMES],
        ALL,
    ),
    "a grey photo": (lambda f: image_of(f / "b.png").convert("L").save(f / "b.png"), ALL),
    "a portrait of two pictures": (as_portrait, ["a.png", "b.jpg", "c.png"]),
    "a damaged EXIF block": (
        lambda f: again(f, "b.jpg", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff" + bytes(20)),
        ["a.png", "b.jpg", "c.png"],
    ),
}


@pytest.mark.parametrize("name", READ)
def test_untidy_photos_that_can_be_read_are_read(of_photos, name, caplog):
    folder, read = of_photos
    make, expected = READ[name]
    make(folder)
    with caplog.at_level("INFO"):
        capture = read()
    assert name != "masks among the photos" or all(frame.shown is not None for frame in capture.frames)
    assert name != "a photo saved as HEIC and as JPEG" or "b.HEIC" in caplog.text
    assert [frame.name for frame in capture.frames] == expected
    assert all(bool(frame.load().isfinite().all()) for frame in capture.frames)


SKIP, BROKEN = {"skip_faulty": True}, "data.reader.skip_faulty=true"
# What is done to the folder, parts of the message, and the setting that goes on without the photo, if there is one.
REFUSED: dict[str, tuple[Callable[[Path], object], tuple[str, ...], dict[str, object] | None]] = {
    "a truncated photo": (lambda f: (f / "d.png").write_bytes((f / "b.png").read_bytes()[:200]), ("d.png", BROKEN), SKIP),
    "an empty file": (lambda f: (f / "d.jpg").touch(), ("d.jpg", BROKEN), SKIP),
    "colours for print": (
        lambda f: image_of(f / "a.png").convert("CMYK").save(f / "d.jpg"), ("d.jpg", "CMYK", "convert the image"), SKIP
    ),
    "two files of one name": (lambda f: image_of(f / "a.png").save(f / "a.jpg"), ("'a' has several files", "keep one"), None),
    "two photos": (lambda f: (f / "b.png").unlink(), ("there are 2, poses need at least 3", "take more photos"), None),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_the_others_are_refused_in_one_line_with_the_file_and_the_remedy(of_photos, name):
    folder, read = of_photos
    spoil, message, setting = REFUSED[name]
    spoil(folder)
    with pytest.raises(DataError) as refusal:
        [frame.load() for frame in read().frames]
    assert "\n" not in str(refusal.value)
    assert all(part in str(refusal.value) for part in message), str(refusal.value)
    if setting is not None:
        capture = read(**setting)
        assert len(capture.frames) == 3
        assert all(bool(frame.load().isfinite().all()) for frame in capture.frames)


def test_photos_may_lie_in_the_folder_images(of_photos):
    folder, _ = of_photos
    (folder.parent / "scene").mkdir()
    folder.rename(folder.parent / "scene" / "images")
    capture = photos.read(folder.parent / "scene", folder.parent / "cache")
    assert (capture.name, len(capture.frames)) == ("scene", 3)


def test_photos_turned_by_exif_are_upright(of_photos):
    folder, read = of_photos
    for orientation in (3, 6, 8):
        captures.write_photos(folder)
        upright = captures.turn(folder / "b.png", orientation)
        assert torch.equal((read().frames[1].load() * 255).round().to(torch.uint8), torch.from_numpy(upright))


def test_poses_of_the_cache_are_refused_and_taken_as_those_just_estimated(of_photos):
    folder, read = of_photos  # estimating twice would fail: the model is there already
    for i in range(4):
        Image.new("RGB", (captures.WIDTH, captures.HEIGHT)).save(folder / f"z{i}.png")
    assert len(read(least_placed=0.4).frames) == 3
    with pytest.raises(DataError, match=r"only 3 of the 7 photos .*data\.reader\.least_placed=0\.428"):
        read(least_placed=0.5)


def test_heic_without_its_library_is_named_with_the_extra(of_photos, monkeypatch):
    folder, read = of_photos
    (folder / "b.png").unlink()
    (folder / "b.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(64))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(DataError, match=r"b\.heic.*clear-strategies\[heic\]"):
        read()
