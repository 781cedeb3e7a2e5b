"""The image reader keeps every bit that it can read, turns colours to sRGB, and refuses what it cannot read."""

import struct
import subprocess
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageCms, ImageOps

from clear_strategies.data import photo_files, photo_folders
from clear_strategies.data.photo_folders import FRAMES, HDR
from clear_strategies.errors import DataError
from tests.helpers.image_files import exif_orientation, png, png_chunk

ENDINGS = (".png", ".jpg", ".webp", ".tiff")


def save(path: Path, pixels: np.ndarray, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


@pytest.mark.parametrize(
    ("pixels", "background", "expected"),
    [
        ([[[0, 51, 255], [102, 204, 1]]], None, [[[0.0, 0.2, 1.0], [0.4, 0.8, 1 / 255]]]),
        ([[51]], None, [[[0.2, 0.2, 0.2]]]),
        ([[[255, 0, 0, 51], [9, 9, 9, 0]]], (1.0, 1.0, 0.5), [[[1.0, 0.8, 0.4], [1.0, 1.0, 0.5]]]),
        ([[[255, 0, 0, 51]]], None, [[[0.2, 0.0, 0.0]]]),
    ],
    ids=["RGB", "grey", "straight alpha over a background", "alpha over black"],
)
def test_eight_bits_become_their_share_of_255(tmp_path: Path, pixels, background, expected) -> None:
    path = save(tmp_path / "a.png", np.array(pixels, np.uint8))
    torch.testing.assert_close(photo_files.read_image(path, background=background), torch.tensor(expected))
    with Image.open(path) as image:
        image.convert("RGB").quantize(8).save(tmp_path / "palette.png")
        rgb = torch.tensor(np.asarray(image.convert("RGB"), np.float32)) / 255
    torch.testing.assert_close(photo_files.read_image(tmp_path / "palette.png"), rgb)


@pytest.mark.parametrize("turn", [None, True])
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("ending", [".png", ".tiff"])
def test_sixteen_bits_stay_sixteen_bits(channels: int, ending: str, turn: bool | None, tmp_path: Path) -> None:
    values = np.array([[[1000, 2000, 65535, 65535]], [[257, 1, 0, 65535]]], np.uint16)
    stored = {1: values[..., 0], 3: values[..., 2::-1], 4: values[..., [2, 1, 0, 3]]}[channels]  # OpenCV writes BGR(A)
    path = tmp_path / f"a{ending}"
    assert cv2.imwrite(str(path), stored)
    expected = (values[..., [0, 0, 0]] if channels == 1 else values[..., :3]) / 65535
    torch.testing.assert_close(photo_files.read_image(path, turn=turn), torch.tensor(expected, dtype=torch.float32))


@pytest.mark.parametrize(
    ("channels", "plain", "other"),
    [(1, (262, 3, 1, 1), (262, 3, 1, 0)), (3, (284, 3, 1, 1), (284, 3, 1, 2)), (4, (339, 3, 4), (338, 3, 1, 1))],
    ids=["white is 0", "a plane for each channel", "colours multiplied by alpha"],
)
def test_a_sixteen_bit_tiff_that_would_be_read_wrongly_is_refused(channels, plain, other, tmp_path: Path) -> None:
    path = tmp_path / "a.tiff"
    cv2.imwrite(str(path), np.zeros((2, 3, channels), np.uint16), [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    entry = struct.pack("<HHIH"[: len(plain) + 1], *plain)  # tag, type, count, value
    at = path.read_bytes().index(entry)
    data = bytearray(path.read_bytes())
    data[at : at + 10] = struct.pack("<HHIH", *other)
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"a\.tiff: pixels: are 16-bit in a layout that is not known"):
        photo_files.read_image(path)


def test_a_png_file_that_lacks_its_palette_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.new("P", (4, 3)).save(path)
    data = path.read_bytes()
    at = data.index(b"PLTE") - 4
    path.write_bytes(data[:at] + data[at + 12 + int.from_bytes(data[at : at + 4], "big") :])
    for read in (photo_files.read_header, photo_files.read_image):
        with pytest.raises(DataError, match=r"a\.png: file: is no readable image"):
            read(path)


def test_sixteen_bit_grey_with_alpha_is_composited(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(png(1, 1, 16, 4, b"\0" + struct.pack(">HH", 65535, 13107)))  # grey with alpha: white, alpha 0.2
    torch.testing.assert_close(photo_files.read_image(path), torch.full((1, 1, 3), 0.2))


@pytest.mark.parametrize("mode", ["L", "P", "RGB", "RGBA"])
def test_a_photo_of_too_many_pixels_is_read_as_their_means_and_its_size_is_that(mode, tmp_path, monkeypatch, caplog):
    pixels = np.random.default_rng(0).integers(0, 255, (13, 23, 3), dtype=np.uint8)
    Image.fromarray(pixels).convert(mode).save(tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as image:
        whole = np.asarray(image.convert("RGB"), np.float32) / 255
    monkeypatch.setattr(photo_files, "_MAX_PIXELS", 100)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 50)  # Pillow's own, which it refuses twice of
    photo_files._reduction_factor.cache_clear()
    caplog.set_level("INFO")
    for _ in range(2):
        found = photo_files.read_image(tmp_path / "a.png")
        assert photo_files.read_header(tmp_path / "a.png").size(None) == found.shape[1::-1] == (12, 7)
    expected = torch.from_numpy(whole[:12, :22].reshape(6, 2, 11, 2, 3).mean(axis=(1, 3)))
    torch.testing.assert_close(found[:6, :11], expected, atol=1 / 255, rtol=0)
    assert caplog.messages == ["photos of 0 megapixels are read at 1/2 of their width and height."]
    assert Image.MAX_IMAGE_PIXELS == 50
    cv2.imwrite(str(tmp_path / "b.png"), pixels.astype(np.uint16))
    with pytest.raises(DataError, match=r"23x13 is more than 100 pixels: reduce it: mogrify -resize 50% .*b.png"):
        photo_files.read_header(tmp_path / "b.png").size(None)
    photo_files._reduction_factor.cache_clear()


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("channels", [(), (3,)])
def test_a_turned_photo_is_read_as_it_is_stored_or_upright(channels, ending, orientation, tmp_path) -> None:
    left_above = np.zeros((12, 16, *channels), np.uint8)
    left_above[:6, :4] = 255
    exif = exif_orientation(orientation)
    path = save(tmp_path / f"a{ending}", left_above, exif=exif)
    upright = ImageOps.exif_transpose(Image.open(save(tmp_path / "turned.png", left_above, exif=exif)))
    for turn, expected in ((False, left_above), (True, np.asarray(upright))):
        if ending == ".tiff" and orientation > 1 and not turn:  # Pillow knows its upright pixels alone
            with pytest.raises(DataError, match=f"EXIF orientation: is {orientation}"):
                photo_files.read_image(path, turn=turn)
            continue
        found = photo_files.read_image(path, turn=turn, expect=(expected.shape[1], expected.shape[0]))
        assert np.array_equal(found.numpy()[..., 0] > 0.5, expected.reshape(*found.shape[:2], -1)[..., 0] > 127)
        assert photo_files.read_header(path).size(turn) == found.shape[1::-1]


def test_a_rotation_that_a_png_file_has_behind_its_pixels_is_known_before_they_are_decoded(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", np.zeros((12, 16, 3), np.uint8), exif=exif_orientation(6))
    data = path.read_bytes()
    first, last = data.index(b"eXIf") - 4, data.index(b"IDAT") - 4
    path.write_bytes(data[:first] + data[last:-12] + data[first:last] + data[-12:])  # IEND has 12 bytes
    assert photo_files.read_header(path).size(turn=True) == (12, 16)
    with pytest.raises(DataError, match="EXIF orientation: is 6"):
        photo_files.read_header(path).size(None)


def test_images_are_listed_by_name_and_ending_and_the_first_of_the_usual_folders_is_taken(tmp_path: Path) -> None:
    (tmp_path / "images_8").mkdir()
    (tmp_path / "images_4").mkdir()
    found = photo_folders.image_folder(tmp_path)
    assert photo_folders.folder_note(found) == "images_4 (there are also images_8)"
    assert photo_folders.image_folder(tmp_path, "images_8").name == "images_8"
    for name in ("b.JPG", "a.png", "notes.txt", "c.tif"):
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert [p.name for p in photo_folders.list_images(tmp_path)] == ["a.png", "b.JPG", "c.tif"]


# ---- photos with a colour profile of their own become sRGB; photos of sRGB keep their bits
LEVELS = np.random.default_rng(0).integers(30, 200, (8, 8, 3), np.uint8)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
# Red is green, and green is red.
SWAPPED = SRGB.replace(b"rXYZ", b"....").replace(b"gXYZ", b"rXYZ").replace(b"....", b"gXYZ")
# With the exponent 2.36 in place of 2.4: two levels apart at most.
OF_A_MAKER = SRGB.replace(struct.pack(">I", round(2.4 * 65536)), struct.pack(">I", round(2.36 * 65536)))


@pytest.fixture(autouse=True)
def forgotten_profiles():
    photo_files._to_srgb.cache_clear()
    photo_files._warn_of_colors.cache_clear()


def in_srgb(levels: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(levels[..., [1, 0, 2]] / 255).float()


def write(path: Path, levels: np.ndarray, **options: object) -> Path:
    if path.suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
        options["quality"] = -1  # lossless
        options["chroma"] = 444
        levels = np.repeat(np.repeat(levels, 8, 0), 8, 1)
    Image.fromarray(levels).save(path, **options)
    return path


@pytest.mark.parametrize(
    ("ending", "allowed"), [(".png", 1.5), (".tiff", 1.5), (".jpg", 12), (".webp", 1.5), (".heic", 8)]
)
def test_another_profile_becomes_srgb_with_one_line(tmp_path: Path, ending: str, allowed: float, caplog) -> None:
    levels = LEVELS if ending != ".jpg" else np.broadcast_to(LEVELS[:1, :1], LEVELS.shape)  # JPEG blurs noise
    lossless = {"lossless": True} if ending == ".webp" else {"quality": 100} if ending == ".jpg" else {}
    with caplog.at_level("INFO"):
        for name in ("a", "b"):
            path = write(tmp_path / f"{name}{ending}", levels, icc_profile=SWAPPED, **lossless)
            read = photo_files.read_image(path)
            step = len(read) // 8
            assert float((read[::step, ::step] - in_srgb(levels)).abs().max()) < allowed / 255
    assert caplog.text.count("photos have the colours of sRGB built-in: they are converted to sRGB.") == 1


def test_alpha_and_16_bits_keep_their_photos_colours(tmp_path: Path) -> None:
    rgba = np.dstack([LEVELS, np.full((8, 8), 128, np.uint8)])
    read = photo_files.read_image(write(tmp_path / "a.png", rgba, icc_profile=SWAPPED), background=(1, 1, 1))
    assert torch.allclose(read, in_srgb(LEVELS) * 128 / 255 + 127 / 255, atol=1.5 / 255)
    file = tmp_path / "b.png"
    assert cv2.imwrite(str(file), LEVELS[..., ::-1].astype(np.uint16) * 257)
    data = file.read_bytes()  # the header's chunk ends at byte 33
    file.write_bytes(data[:33] + png_chunk(b"iCCP", b"own\0\0" + zlib.compress(SWAPPED)) + data[33:])
    assert torch.allclose(photo_files.read_image(file), in_srgb(LEVELS), atol=1.5 / 255)


@pytest.mark.parametrize("mode", ["RGB", "L", "P"])
def test_profiles_of_srgb_and_damaged_ones_change_no_bit(tmp_path: Path, mode: str, caplog) -> None:
    image = Image.fromarray(LEVELS).convert(mode)
    image.save(tmp_path / "plain.png")
    plain = photo_files.read_image(tmp_path / "plain.png")
    for profile, warned in ((OF_A_MAKER, False), (b"no profile", True)):
        image.save(tmp_path / "a.png", icc_profile=profile)
        assert torch.equal(photo_files.read_image(tmp_path / "a.png"), plain)
        assert ("colour profile that cannot be used" in caplog.text) is warned


def test_hdr_without_a_profile_and_adobe_rgb_that_only_exif_tells_are_told(tmp_path: Path, caplog) -> None:
    path = write(tmp_path / "a.heic", LEVELS)
    photo_files.read_image(path)
    assert not caplog.text
    with photo_files._opened(path) as image:
        image.info["nclx_profile"] = {"color_primaries": 9, "transfer_characteristics": 16}
        photo_files._to_srgb_of(image)
    assert "primaries 9 and the transfer 16 of ITU-T H.273 (HDR, or a wide gamut)" in caplog.text
    exif = Image.Exif()
    exif[0x8769] = {0xA005: {1: "R03"}}
    photo_files.read_image(write(tmp_path / "a.jpg", LEVELS, exif=exif))
    assert "photos have the colours of Adobe RGB (EXIF), and are taken as sRGB. Export them in sRGB." in caplog.text


def test_the_line_for_clips_in_hdr_gives_photos_in_srgb(tmp_path: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    color, clip = (200, 60, 40), tmp_path / "clip.mkv"
    wide = "p=bt2020:t=smpte2084:m=bt2020nc:r=limited:npl=203"
    made = f"format=gbrp,zscale=pin=bt709:tin=iec61966-2-1:min=gbr:rin=full:{wide},format=yuv420p10le"
    source = ["-f", "lavfi", "-i", "color=c=0xC83C28:s=64x64:d=1:r=30", "-vf", made, "-c:v", "ffv1", str(clip)]
    if subprocess.run([ffmpeg, "-v", "error", *source], check=False).returncode:
        pytest.skip("this ffmpeg cannot make the clip")
    line = FRAMES.replace("FILE", str(clip)).replace("FOLDER", str(tmp_path)).split()
    line[line.index("-vf") + 1] = HDR.split()[1]
    subprocess.run([ffmpeg, "-v", "error", *line[1:]], check=True)
    photos = sorted(tmp_path.glob("*.jpg"))
    assert len(photos) == 2
    assert float((photo_files.read_image(photos[0])[32, 32] * 255 - torch.tensor(color)).abs().max()) < 6
