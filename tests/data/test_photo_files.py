"""The image reader keeps every bit it can read and refuses what it cannot."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from clear_strategies.data import photo_files, photo_folders
from clear_strategies.errors import DataError

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


def test_sixteen_bit_grey_with_alpha_is_composited(tmp_path: Path) -> None:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 16, 4, 0, 0, 0))  # 16 bits, grey with alpha
    pixels = chunk(b"IDAT", zlib.compress(b"\0" + struct.pack(">HH", 65535, 13107)))  # white, alpha 0.2
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + pixels + chunk(b"IEND", b""))
    torch.testing.assert_close(photo_files.read_image(path), torch.full((1, 1, 3), 0.2))


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_turned_photo_is_read_as_it_is_stored_or_upright(ending: str, orientation: int, tmp_path: Path) -> None:
    left_above = np.zeros((12, 16, 3), np.uint8)
    left_above[:6, :4] = 255
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = save(tmp_path / f"a{ending}", left_above, exif=exif)
    upright = ImageOps.exif_transpose(Image.open(save(tmp_path / "turned.png", left_above, exif=exif)))
    for turn, expected in ((False, left_above), (True, np.asarray(upright))):
        if ending == ".tiff" and orientation > 1 and not turn:  # Pillow knows its upright pixels alone
            with pytest.raises(DataError, match=f"EXIF orientation: is {orientation}"):
                photo_files.read_image(path, turn=turn)
            continue
        found = photo_files.read_image(path, turn=turn, expect=(expected.shape[1], expected.shape[0]))
        assert np.array_equal(found.numpy() > 0.5, expected > 127)
        assert photo_files.image_size(path, turn=turn) == found.shape[1::-1]


def test_images_are_listed_by_name_and_by_ending(tmp_path: Path) -> None:
    for name in ("b.JPG", "a.png", "notes.txt", "c.tif"):
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert [p.name for p in photo_folders.list_images(tmp_path)] == ["a.png", "b.JPG", "c.tif"]


def test_the_first_of_the_usual_folders_is_taken_and_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="has none of the folders"):
        photo_folders.image_folder(tmp_path)
    (tmp_path / "images_8").mkdir()
    (tmp_path / "images_4").mkdir()
    found = photo_folders.image_folder(tmp_path)
    assert photo_folders.folder_note(found) == "images_4 (there are also images_8)"
    assert photo_folders.image_folder(tmp_path, "images_8").name == "images_8"
    with pytest.raises(DataError, match="choose one of images_4, images_8"):
        photo_folders.image_folder(tmp_path, "images")
