"""SR images from a folder: found by name, refused if missing, ambiguous or of another size."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Images
from tests.helpers.networks import photo


def test_images_are_found_by_the_views_stem_and_the_suffix(tmp_path: Path) -> None:
    lr = photo(6, 8)
    for name, seed in (("a.png", 1), ("a_x4.png", 2), ("b.png", 3)):
        write_png(tmp_path / name, images.upsample(photo(6, 8, seed), 4))
    assert torch.equal(Images(str(tmp_path))("a.JPG", lr, 4), read_image(tmp_path / "a.png"))
    assert torch.equal(Images(str(tmp_path), suffix="_x4")("train/a", lr, 4), read_image(tmp_path / "a_x4.png"))


def test_views_of_two_folders_have_their_images_in_two_folders(tmp_path: Path) -> None:
    lr, seeds = photo(6, 8), {"cam1/0001.png": 1, "cam2/0001.png": 2}
    for name, seed in seeds.items():
        write_png(tmp_path / name, images.upsample(photo(6, 8, seed), 4))
    found = Images(str(tmp_path))
    for name in seeds:
        assert torch.equal(found(name, lr, 4), read_image(tmp_path / name)), name


def test_a_number_behind_a_dot_belongs_to_the_name(tmp_path: Path) -> None:
    lr = photo(6, 8)
    for number in (1, 2):
        write_png(tmp_path / f"rgb.{number:04d}_x4.png", images.upsample(photo(6, 8, number), 4))
    found = Images(str(tmp_path), suffix="_x4")
    for name in ("rgb.0001", "rgb.0002.jpg"):
        assert torch.equal(found(name, lr, 4), read_image(tmp_path / f"{name[:8]}_x4.png"))


def test_images_of_another_view_give_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lr = photo(16, 16, seed=1)
    write_png(tmp_path / "right.png", images.upsample(lr, 4))
    write_png(tmp_path / "wrong.png", images.upsample(photo(16, 16, seed=2), 4))
    Images(str(tmp_path))("right", lr, 4)
    assert not caplog.text
    Images(str(tmp_path))("wrong", lr, 4)
    assert "wrong.png: the SR image, reduced again, differs" in caplog.text
