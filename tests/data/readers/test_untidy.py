"""Captures with poses and folders of photos as people have them: each ends well, or with a line that names file and remedy."""

import os
import shutil
import struct
import sys
import unicodedata
from collections.abc import Callable, Mapping
from pathlib import Path, PurePosixPath

import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from clear_strategies.commands.train import detect
from clear_strategies.data.capture import Capture
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.readers import photos
from clear_strategies.data.view_names import ViewFiles, matching
from clear_strategies.errors import DataError
from tests.helpers import captures
from tests.helpers.captures import GOOD, HEIGHT, NAMES, READERS, WIDTH

PHOTOS = {"colmap": "images", "nerfstudio": "images", "blender": "train"}


@pytest.mark.parametrize("reader", PHOTOS)
def test_a_photo_that_is_truncated_or_missing_is_refused_with_the_setting_that_goes_on(tmp_path, reader, caplog):
    root, read = GOOD[reader](tmp_path / "capture"), READERS[reader]
    photo = root / PHOTOS[reader] / "b.png"
    for spoil, said in ((lambda: os.truncate(photo, 200), r"b\.png: pixels: "), (photo.unlink, "photos: 1 of .*: b")):
        spoil()
        caplog.clear()
        with pytest.raises(DataError, match=rf"\A.*{said}.*data\.reader\.skip_faulty=true\Z"):
            [frame.load() for frame in read(root).frames]
        capture = read(root, skip_faulty=True)
        assert [Path(frame.name).stem for frame in capture.frames] == ["a", "c"]
        assert all(bool(frame.load().image.isfinite().all()) for frame in capture.frames)
        (skipped,) = (
            record.message for record in caplog.records if "skipped: " in record.message and "/b" in record.message
        )
        assert "data.reader.skip_faulty" not in skipped  # it is set


@pytest.mark.parametrize("rotate", [True, False])
def test_a_photo_on_its_side_is_turned_where_the_camera_is_not_that_of_the_stored_pixels(tmp_path, rotate):
    root = captures.colmap_bin(tmp_path)
    expected = captures.turn(root / "images/b.png", rotate=rotate)
    frame = READERS["colmap"](root).frames[1]
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)
    assert torch.equal((frame.load().image * 255).round().to(torch.uint8), torch.from_numpy(expected))


@pytest.mark.parametrize("kind", GOOD)
def test_reading_poses_decodes_no_photo(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Truncated photos still have their headers: they are read, and refused when they are loaded."""
    decoded, load = [], PngImageFile.load
    monkeypatch.setattr(PngImageFile, "load", lambda image: decoded.append(image.filename) or load(image))
    root = GOOD[kind](tmp_path)
    for path in root.rglob("*.png"):
        path.write_bytes(path.read_bytes()[:-60])
    frames = READERS[kind](root).frames
    assert not decoded
    for frame in frames:
        with pytest.raises(DataError, match="pixels: cannot be decoded"):
            frame.load()


def moved(old: str, new: str, empty: bool = False) -> Callable[[Path], None]:
    def move(root: Path) -> None:
        (root / new).parent.mkdir(parents=True, exist_ok=True)
        (root / old).rename(root / new)
        if empty:
            (root / old).mkdir(parents=True)

    return move


def appended(file: str, text: str) -> Callable[[Path], None]:
    return lambda root: (root / file).write_text((root / file).read_text() + text)


def encoded(file: str, encoding: str) -> Callable[[Path], None]:
    return lambda root: (root / file).write_text((root / file).read_text(), encoding=encoding)


def smaller_models(root: Path) -> None:
    """Of the first two photos in 0, and of none in 2; all are in 1."""
    for name in ("1", "2"):
        shutil.copytree(root / "sparse/0", root / "sparse" / name)
    lines = (root / "sparse/0/images.txt").read_text().splitlines(keepends=True)
    (root / "sparse/0/images.txt").write_text("".join(lines[:-2]))  # an image has two lines
    (root / "sparse/2/images.txt").write_text("")


def unused_cameras(root: Path) -> None:
    """A panorama and a camera of size 0 in front of the one in use."""
    file = root / "sparse/0/cameras.bin"
    others = struct.pack("<iiQQ", 7, 17, 100, 50) + struct.pack("<iiQQ3d", 8, 0, 0, 0, 1.0, 1.0, 1.0)
    file.write_bytes(struct.pack("<Q", 3) + others + file.read_bytes()[8:])


def unlisted_in_tracks(root: Path) -> None:
    """Both points are also seen by a photo 9 that is no longer listed."""
    if (text := root / "sparse/0/points3D.txt").is_file():
        text.write_text(text.read_text().replace(" 0\n", " 0 9 0\n"))
        return
    file = root / "sparse/0/points3D.bin"
    points = file.read_bytes()[8:]
    size, ends = 8 + 24 + 3 + 8 + 8 + 16, struct.pack("<ii", 9, 0)
    grown = [
        points[i : i + size - 24] + struct.pack("<Q", 3) + points[i + size - 16 : i + size] + ends for i in (0, size)
    ]
    file.write_bytes(struct.pack("<Q", 2) + b"".join(grown))


CAMERAS, LISTS = "sparse/0/cameras.txt", {"train_filenames": ["images/a.png", "images/gone.png"]}
ONE_IS_LEFT, OF_TRACKS = "there is no model in 0, and the one in {} is used", "2 of 6 entries of the tracks name images"
# How the capture is written, what is done to it, and the line that says so, empty where there is nothing to say.
POSED: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "sparse/1 beside an empty sparse/0": ("colmap", moved("sparse/0", "sparse/1", empty=True), ONE_IS_LEFT.format(1)),
    "sparse/12 alone": ("colmap_txt", moved("sparse/0", "sparse/12"), ONE_IS_LEFT.format(12)),
    "colmap/sparse/2 alone": ("colmap", moved("sparse/0", "colmap/sparse/2"), ONE_IS_LEFT.format(2)),
    "Sparse with a capital letter": ("colmap", moved("sparse", "Sparse"), ""),
    "an empty model and one of fewer photos beside the right one": (
        "colmap_txt",
        smaller_models,
        "The largest, 1 with 3 photos, is used; the others are not: 0 with 2, 2 with 0.",
    ),
    "an unused panoramic camera": ("colmap_txt", appended(CAMERAS, "2 EQUIRECTANGULAR 100 50\n"), ""),
    "an unused camera of an unknown model": ("colmap_txt", appended(CAMERAS, "2 PANORAMIC 100 50 x\n"), ""),
    "an unused camera of size 0": ("colmap_txt", appended(CAMERAS, "2 SIMPLE_PINHOLE 0 0 1 0 0\n"), ""),
    "a line of an unused camera that is cut": ("colmap_txt", appended(CAMERAS, "2 PINHOLE\n"), ""),
    "unused cameras in binary": ("colmap", unused_cameras, ""),
    "tracks of a photo that is not listed": ("colmap_txt", unlisted_in_tracks, OF_TRACKS),
    "the same in binary": ("colmap", unlisted_in_tracks, OF_TRACKS),
    "a split list that names a photo without a frame": (
        "nerfstudio",
        lambda root: captures.edit(root / "transforms.json", lambda value: value.update(LISTS)),
        "1 photo in its split lists, and no frame's file_path: images/gone.png",
    ),
    "a byte order mark": ("nerfstudio", encoded("transforms.json", "utf-8-sig"), ""),
    "UTF-16, as PowerShell writes it": ("nerfstudio", encoded("transforms.json", "utf-16"), ""),
    "UTF-16 in COLMAP's text": ("colmap_txt", encoded("sparse/0/images.txt", "utf-16"), ""),
    "photos in a folder of another name": ("colmap", moved("images", "photos"), ""),
    "photos two folders below": ("colmap", moved("images", "DCIM/100CANON"), ""),
}


@pytest.mark.parametrize("name", POSED)
def test_an_untidy_capture_is_read_whole_and_the_log_says_what_was_left_out(name, tmp_path, caplog):
    kind, spoil, line = POSED[name]
    root = GOOD[kind](tmp_path / "capture")
    spoil(root)
    assert detect(root) == kind.removesuffix("_txt")
    capture = READERS[kind](root, skip_faulty=True)
    captures.require_poses(capture)
    said = [record.getMessage() for record in caplog.records]
    assert (not line and not said) or any(line in message for message in said if line), said
    if "tracks" in line:
        assert sorted(capture.points.track_image.tolist()) == sorted(i for track in captures.TRACKS for i in track)


@pytest.mark.parametrize("kind", ["colmap_txt", "blender", "nerfstudio"])
def test_names_are_the_same_whether_their_letters_are_composed_or_not(kind: str, tmp_path: Path) -> None:
    """In lists, of photos, of their masks, of SR images, and on the command line."""

    def composed(path: str) -> str:
        return str(PurePosixPath(path).with_name(f"é{PurePosixPath(path).name}"))

    root = GOOD[kind](tmp_path / "capture", listed=composed)
    for photo in [*root.rglob("*.png")]:
        decomposed = photo.rename(photo.with_name(unicodedata.normalize("NFD", f"é{photo.name}")))
        (mask := root / "masks" / f"é{photo.name}").parent.mkdir(exist_ok=True)
        Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
        (tmp_path / "sr").mkdir(exist_ok=True)
        shutil.copy(decomposed, tmp_path / "sr")
    frames = READERS[kind](root).frames
    assert sorted(Path(frame.name).stem for frame in frames) == ["éa", "éb", "éc"]
    assert all(frame.load().shown is not None for frame in frames)
    files = ViewFiles(tmp_path / "sr", "SR image", "", "")
    assert all(files.file(frame.name, WIDTH, HEIGHT).is_file() for frame in frames)
    names = [frame.name for frame in frames]
    assert matching(names, unicodedata.normalize("NFD", names[0])) == [names[0]]


# ---- folders of photos as phones and people leave them: each ends well, or with one line that names the file and the remedy
Read = Callable[..., Capture]


@pytest.fixture
def of_photos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Read]:
    """A folder of three photos, and what reads it."""
    model = captures.colmap_bin(tmp_path / "model") / "sparse" / "0"
    monkeypatch.setattr(photos.features, "copy_name", lambda i: NAMES[i] if i < len(NAMES) else f"{i}.jpg")

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


def linked(folder: Path) -> None:
    """Links to the photos, which lie in another folder."""
    elsewhere = folder.rename(folder.parent / "elsewhere")
    folder.mkdir()
    for name in NAMES:
        (folder / name).symlink_to(elsewhere / name)


def without_model(folder: Path) -> None:
    (folder / "sparse/0").mkdir(parents=True)
    (folder / "sparse/0/points3D.bin").touch()


# What is done to the folder, the photos that are then used, and what is said.
ALL = list(NAMES)
READ: dict[str, tuple[Callable[[Path], object], list[str], str]] = {
    "HEIC among others": (lambda f: as_heic(f, "b.heic"), ["a.png", "b.heic", "c.png"], ""),
    "HEIC that calls itself JPEG": (lambda f: as_heic(f, "b.jpg"), ["a.png", "b.jpg", "c.png"], ""),
    "a photo saved as HEIC and as JPEG": (lambda f: beside(f, "b.HEIC"), ALL, "b.HEIC"),
    "what a Mac and a phone leave": (lambda f: beside(f, "._a.png", ".DS_Store", "clip.mov", "Thumbs.db"), ALL, "clip.mov"),
    "a preview beside the photos": (
        lambda f: image_of(f / "a.png").resize((2, 1)).save(f / "a_thumb.jpg"),
        ALL,
        "1 of the images have less than 1/64 of the pixels of the largest, and are not used: a_thumb.jpg",
    ),
    "links to another folder": (linked, ALL, ""),
    "a link to nowhere": (lambda f: (f / "d.png").symlink_to(f / "gone.png"), ALL, ""),
    "a browser's ending of JPEG": (lambda f: again(f, "b.jfif", format="JPEG"), ["a.png", "b.jfif", "c.png"], ""),
    "an ending in capitals, a name with spaces": (lambda f: again(f, "b é (1).JPG"), ["a.png", "b é (1).JPG", "c.png"], ""),
    "masks among the photos": (
        lambda f: [Image.new("L", (WIDTH, HEIGHT), 1).save(f / f"{n}.mask.png") for n in NAMES],
        ALL,
        "are masks of others",
    ),
    "a grey photo": (lambda f: image_of(f / "b.png").convert("L").save(f / "b.png"), ALL, ""),
    "a portrait of two pictures": (as_portrait, ["a.png", "b.jpg", "c.png"], ""),
    "a damaged EXIF block": (
        lambda f: again(f, "b.jpg", exif=b"Exif\0\0MM\0*\xff\xff\xff\xff" + bytes(20)),
        ["a.png", "b.jpg", "c.png"],
        "",
    ),
    "photos below those that are used": (
        lambda f: captures.write_photos(f / "cam2"),
        ALL,
        "the images in folders below it are not used: cam2 holds 3",
    ),
    "files that are no photos, and others that a camera saves beside one": (
        lambda f: beside(f, "a.CR2", "b.mov", "d.avif"),
        ALL,
        "photos: not used: images of another format (1): d.avif.",
    ),
    "a folder sparse that holds no model": (
        without_model,
        ALL,
        "sparse holds no model (cameras.bin and images.bin, or .txt): the poses are estimated anew",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_untidy_photos_that_can_be_read_are_read(of_photos, name, caplog):
    folder, read = of_photos
    make, expected, told = READ[name]
    make(folder)
    with caplog.at_level("INFO"):
        capture = read()
    assert name != "masks among the photos" or all(frame.load().shown is not None for frame in capture.frames)
    assert told in caplog.text if told else "not used" not in caplog.text
    assert [frame.name for frame in capture.frames] == expected
    assert all(bool(frame.load().image.isfinite().all()) for frame in capture.frames)


def test_photos_that_may_be_panoramas_are_told_with_the_command_that_cuts_them(of_photos, caplog):
    folder, read = of_photos
    captures.write_photos(folder, size=(24, 12))
    with pytest.raises(DataError, match="another shape"):  # the poses are of other photos
        read()
    assert "poses and splat would be wrong: cut panoramas into flat photos: ns-process-data" in caplog.text


def only(folder: Path, *names: str) -> None:
    """Only these files, in place of the photos."""
    for photo in folder.iterdir():
        photo.unlink()
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_bytes(b"never opened")


SKIP, BROKEN = {"skip_faulty": True}, "data.reader.skip_faulty=true"
# What is done to the folder, parts of the message, and the setting that goes on without the photo, if there is one.
REFUSED: dict[str, tuple[Callable[[Path], object], tuple[str, ...], dict[str, object] | None]] = {
    "a truncated photo": (lambda f: (f / "d.png").write_bytes((f / "b.png").read_bytes()[:200]), ("d.png", BROKEN), SKIP),
    "two files of one name": (lambda f: image_of(f / "a.png").save(f / "a.jpg"), ("'a' has several files", "keep one"), None),
    "two photos": (lambda f: (f / "b.png").unlink(), ("there are 2, poses need at least 3", "take more photos"), None),
    # No photo: what there is, and what makes photos of it; tests/mistakes.csv has more.
    "raw photos on a card": (
        lambda f: only(f, "DCIM/100CANON/IMG_1.CR3"), ("but raw photos (1): IMG_1.CR3: develop them",), None
    ),
    "an archive": (
        lambda f: only(f, "my photos.zip"), ("unpack them, and give the folder: unzip 'my photos.zip' -d FOLDER",), None
    ),
    "a video": (lambda f: only(f, "clip.MOV"), ("ffmpeg -i clip.MOV -vf thumbnail=15",), None),
    "what a Mac leaves of raw photos": (lambda f: only(f, "._IMG_1.CR2"), ("check the path",), None),
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
        assert all(bool(frame.load().image.isfinite().all()) for frame in capture.frames)


@pytest.mark.parametrize(
    ("place", "beside", "told"),
    [
        ("images", None, ""),
        ("Images", None, ""),
        ("DCIM/100CANON", None, "scene holds no image; those in DCIM/100CANON are used"),
        ("images/cam1", None, "scene holds no image; those in images/cam1 are used"),
        ("of_the_day", None, "scene holds no image; those in of_the_day are used"),
        ("images", "preview.png", "scene holds too few images (1); those in images are used"),
        ("cam1", "preview.png", "scene holds too few images (1); those in cam1 are used"),
    ],
)
def test_photos_in_the_only_folder_that_holds_enough_are_used_with_a_line(place, beside, told, of_photos, caplog):
    folder, _ = of_photos
    root = folder.parent / "scene"
    (root / place).parent.mkdir(parents=True)
    captures.write_photos(root / "masks")  # no photos
    folder.rename(root / place)
    if beside is not None:
        shutil.copy(root / place / "a.png", root / beside)
    capture = photos.read(root, folder.parent / "cache")
    assert (capture.name, [frame.name for frame in capture.frames]) == ("scene", ALL)
    assert told in caplog.text if told else not caplog.text


def test_photos_turned_by_exif_are_upright(of_photos):
    folder, read = of_photos
    upright = captures.turn(folder / "b.png")
    assert torch.equal((read().frames[1].load().image * 255).round().to(torch.uint8), torch.from_numpy(upright))


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
