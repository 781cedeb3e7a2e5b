"""Masks as tools write them: their names, sizes and values, and masks that hide too much."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.lenses import Lens
from clear_strategies.data.masks import masks_of
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.readers import blender, colmap, nerfstudio
from clear_strategies.errors import DataError
from tests.helpers import captures as tiny

LEFT = np.repeat(np.arange(tiny.WIDTH)[None] >= 4, tiny.HEIGHT, axis=0)  # shown: all but four columns


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values.astype(np.uint8) if values.dtype == int else values).save(path)


VALUES = {
    "0 and 255": ("png", 255 * LEFT),
    "0 and 1": ("png", LEFT.astype(int)),
    "0 and 1 in colour": ("png", np.dstack([LEFT.astype(int)] * 3)),
    "one bit": ("png", LEFT),
    "numbers of objects": ("png", LEFT * np.arange(tiny.WIDTH)),
    "16 bits": ("png", LEFT.astype(np.uint16)),
    "alpha": ("png", np.dstack([np.full((*LEFT.shape, 3), 255), 255 * LEFT])),
    "JPEG, with noise where it hides": ("jpg", np.where(LEFT, 255, 12)),
}


@pytest.mark.parametrize("kind", VALUES)
def test_what_is_not_0_is_shown(tmp_path: Path, kind: str) -> None:
    ending, values = VALUES[kind]
    save(tiny.colmap_bin(tmp_path) / f"masks/a.{ending}", values)
    assert torch.equal(colmap.read(tmp_path).frames[0].load().shown, torch.from_numpy(LEFT))


def test_photo_and_mask_of_a_frame_may_be_named_by_texts(tmp_path: Path) -> None:
    for name in ("photo.png", "mask.png"):
        save(tmp_path / name, 255 * LEFT)
    lens = Lens(tiny.WIDTH, tiny.HEIGHT, 9.0, 9.0, tiny.WIDTH / 2, tiny.HEIGHT / 2)
    frame = Frame.of_photo("a", f"{tmp_path}/photo.png", lens, torch.eye(4), mask=f"{tmp_path}/mask.png")
    assert torch.equal(frame.load().image[..., 0] > 0, frame.load().shown)


NAMED = ("a.png", "a.PNG", "a.jpg", "A.png", "a.png.png", "dynamic_mask_a.png", "a_mask.png", "mask-a.jpeg")


@pytest.mark.parametrize(
    ("reader", "name"), [*(("colmap", name) for name in NAMED), ("nerfstudio", "a_mask.png"), ("blender", "a.png.png")]
)
def test_a_mask_is_found_by_the_names_that_tools_give_it(tmp_path: Path, reader: str, name: str, caplog) -> None:
    save(tiny.GOOD[reader](tmp_path) / "masks" / name, 255 * LEFT)
    first = tiny.READERS[reader](tmp_path).frames[0]
    assert torch.equal(first.load().shown, torch.from_numpy(LEFT))
    assert "belong to no photo" not in caplog.text


@pytest.mark.parametrize("folder", ["masks", "mask", "images/masks", "masks/images"])
def test_masks_may_lie_beside_the_photos_or_in_their_folder(tmp_path: Path, folder: str) -> None:
    save(tiny.colmap_bin(tmp_path) / folder / "b.png", 1 * LEFT)
    assert [frame.load().shown is not None for frame in colmap.read(tmp_path).frames] == [False, True, False]


@pytest.mark.parametrize(
    ("reader", "name"), [("colmap", "b.png.mask.png"), ("colmap", "b_mask.jpg"), ("nerfstudio", "mask_b.PNG")]
)
def test_marked_masks_may_lie_among_the_photos(tmp_path: Path, reader: str, name: str) -> None:
    save(tiny.GOOD[reader](tmp_path) / "images" / name, 255 * LEFT)
    capture = tiny.READERS[reader](tmp_path)
    assert [frame.load().shown is not None for frame in capture.frames] == [False, True, False]
    assert "without pose" not in capture.notes


def test_files_among_the_masks_that_belong_to_no_photo_are_named(tmp_path: Path, caplog) -> None:
    tiny.colmap_bin(tmp_path)
    for name in ("a.png", "a_mask.png", "frame_7.png"):
        save(tmp_path / "masks" / name, 1 * LEFT)
    (tmp_path / "masks/b.npy").touch()
    colmap.read(tmp_path)
    assert "3 of 4 files belong to no photo and are not used: a_mask.png, b.npy, frame_7.png" in caplog.text


def test_masks_follow_the_size_and_the_folder_of_their_photos(tmp_path: Path) -> None:
    tiny.colmap_bin(tmp_path)
    tiny.write_photos(tmp_path / "images_2", (tiny.WIDTH // 2, tiny.HEIGHT // 2))
    for name in ("a", "b"):
        save(tmp_path / f"masks/{name}.png", 1 * LEFT)
    save(tmp_path / "masks_2/b.png", 1 - 1 * LEFT[::2, ::2])
    a, b, _ = colmap.read(tmp_path, images="images_2").frames
    assert torch.equal(a.load().shown, torch.from_numpy(LEFT[::2, ::2]))
    assert torch.equal(b.load().shown, torch.from_numpy(~LEFT[::2, ::2]))
    whole = colmap.read(tmp_path).frames
    assert all(torch.equal(frame.load().shown, torch.from_numpy(LEFT)) for frame in whole[:2])
    tiny.write_photos(tmp_path / "elsewhere")
    save(tmp_path / "elsewhere/masks/a.png", 1 * LEFT)
    assert list(masks_of(tmp_path / "scene", [tmp_path / "elsewhere/a.png"])) == [tmp_path / "elsewhere/a.png"]


@pytest.mark.parametrize("sized", [True, False])
def test_nerfstudios_reduced_photos_keep_their_masks_splits_and_lenses(tmp_path: Path, sized: bool) -> None:
    content = json.loads((tiny.nerfstudio(tmp_path) / "transforms.json").read_text())
    if not sized:
        del content["w"], content["h"]
    content["frames"][0]["mask_path"] = "masks/a.png"
    tiny.write_json(
        tmp_path / "transforms.json", content | {"train_filenames": ["images/a.png"], "val_filenames": ["images/b.png"]}
    )
    tiny.write_photos(tmp_path / "images_2", (tiny.WIDTH // 2, tiny.HEIGHT // 2))
    save(tmp_path / "masks/a.png", 255 * LEFT)
    first, second, _ = nerfstudio.read(tmp_path, images="images_2").frames
    assert (first.camera.width, first.camera.fx, first.split, second.split) == (8, tiny.FOCAL / 2, "train", "test")
    assert torch.equal(first.load().shown, torch.from_numpy(LEFT[::2, ::2]))
    with pytest.raises(DataError, match="images_4: images: is no folder: choose one of images, images_2"):
        nerfstudio.read(tmp_path, images="images_4")


def test_a_mask_that_cannot_be_read_is_refused_with_what_helps_a_mask(tmp_path: Path) -> None:
    mask = tiny.colmap_bin(tmp_path) / "masks/a.png"
    save(mask, 255 * LEFT)
    whole = mask.read_bytes()
    for content, message in ((b"no image", "is no readable image"), (whole[:-30], "cannot be decoded")):
        mask.write_bytes(content)
        with pytest.raises(DataError, match=rf"a\.png: mask: .*{message}.*: put a mask of the photo's shape there"):
            [frame.load() for frame in colmap.read(tmp_path, skip_faulty=True).frames]
    mask.unlink()
    assert not any(frame.load().shown is not None for frame in colmap.read(tmp_path).frames)


def prepared(root: Path, read: Callable[[Path], Capture]) -> None:
    prepare(read(root), tiny.papers(train=None, test_every=0, sr_scale=1), Bicubic(), tiny.POINTS_AT_RANDOM)


def test_masks_that_hide_all_photos_are_refused_and_of_one_are_told(tmp_path: Path, caplog) -> None:
    tiny.colmap_bin(tmp_path)
    for i, name in enumerate(tiny.NAMES):
        save(tmp_path / "masks" / name, 0 * LEFT)
        if i == 0:
            prepared(tmp_path, colmap.read)
            assert "1 of 3 photos are not used in training" in caplog.text
            assert "a.png" in caplog.text
    with pytest.raises(
        DataError, match=r"a\.png: masks or alpha: show nothing of 3 of 3 photos: a.*: a mask is 0 where"
    ):
        prepared(tmp_path, colmap.read)
    for name in tiny.NAMES:
        save(tmp_path / "masks" / name, np.arange(LEFT.size).reshape(LEFT.shape) < 10)
    prepared(tmp_path, colmap.read)
    assert "masks hide 95% of their 3 photos" in caplog.text


@pytest.mark.parametrize("alpha", [0, 1])
def test_photos_that_are_transparent_everywhere_are_refused(tmp_path: Path, alpha: int) -> None:
    for path in (tiny.blender(tmp_path) / "train").iterdir():
        image = Image.open(path)
        image.putalpha(alpha)
        image.save(path)
    with pytest.raises(DataError, match=r"show nothing of 2 of 2 photos: a, b"):
        prepared(tmp_path, blender.read)
