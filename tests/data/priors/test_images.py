"""SR images from a folder: found by name, refused if missing, ambiguous or of another size."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Images
from tests.helpers.networks import photo


@pytest.mark.parametrize(
    ("suffix", "found"),
    [
        ("", {"a.JPG": "a.png", "train/b": "b.png"}),
        ("", {"cam1/0001.png": "cam1/0001.png", "cam2/0001.png": "cam2/0001.png"}),
        ("_x4", {"train/a": "a_x4.png", "rgb.0001": "rgb.0001_x4.png", "rgb.0002.jpg": "rgb.0002_x4.png"}),
    ],
    ids=["stem", "folder", "suffix, and a number behind a dot"],
)
def test_images_are_found_by_the_name_of_the_view(tmp_path: Path, suffix: str, found: dict[str, str]) -> None:
    for seed, name in enumerate(["a.png", "a_x4.png", *found.values()]):
        write_png(tmp_path / name, images.upsample(photo(6, 8, seed), 4))
    prior = Images(str(tmp_path), suffix=suffix)
    for name, file in found.items():
        assert torch.equal(prior(name, photo(6, 8), 4), read_image(tmp_path / file)), name


def test_images_of_another_view_give_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lr = photo(16, 16, seed=1)
    write_png(tmp_path / "right.png", images.upsample(lr, 4))
    write_png(tmp_path / "wrong.png", images.upsample(photo(16, 16, seed=2), 4))
    Images(str(tmp_path))("right", lr, 4)
    assert not caplog.text
    Images(str(tmp_path))("wrong", lr, 4)
    assert "wrong.png: the SR image, reduced again, differs" in caplog.text
