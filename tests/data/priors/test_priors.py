"""Priors: ONNX networks, SR images from a folder, and what holds for several."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Bicubic, Images, Onnx
from clear_strategies.data.priors.interface import super_resolved
from clear_strategies.errors import DataError
from tests.helpers.networks import onnx_bytes, photo, psnr, upscaling_weight

# ---- what holds for several priors: paths, missing models, and the quality of real networks on a real photo


def test_real_networks_do_on_fern_what_is_known_of_them(shared_data: Path, caplog: pytest.LogCaptureFixture) -> None:
    """504x376 from 126x94, a training view."""
    weights, photos = shared_data / "sr_weights", sorted((shared_data / "fern" / "images_4").iterdir())
    hr = images.downsample(images.crop_to_multiple(read_image(photos[10]), 8), 2)[:376, :504]
    lr = images.downsample(hr, 4)
    expected = {
        Bicubic(): 23.51,
        Onnx(str(weights / "span_x4.onnx")): 25.24,
        Onnx(str(weights / "imdn_x4.onnx")): 25.38,
    }
    found = {prior: psnr(prior("fern", lr, 4), hr) for prior in expected}
    assert found == pytest.approx(expected, abs=0.03)
    assert not [record for record in caplog.records if record.levelno > logging.INFO]


@pytest.mark.parametrize(
    ("made", "told"),
    [
        (np.zeros((8, 12, 3), np.float32), "must be a float tensor .*, got a ndarray"),
        (torch.zeros(8, 12, 3, dtype=torch.uint8), "must be a float tensor .*, got torch.uint8: correct the prior"),
        (torch.zeros(8, 12, 4), "is 12x8x4, but 4 times 3x2 is 12x8"),
        (torch.zeros(4, 6, 3), "is 6x4, but 4 times 3x2 is 12x8"),
    ],
    ids=["array", "bytes", "alpha", "size"],
)
def test_what_is_no_sr_image_is_refused_by_the_name_of_its_view(made, told):
    with pytest.raises(DataError, match=f"a: SR image: {told}"):
        super_resolved(lambda name, lr, factor: made, "a", torch.zeros(2, 3, 3), 4)


# ---- SR images from a folder: found by name, refused if missing, ambiguous or of another size


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


# ---- ONNX networks: computed as torch computes them; files that cannot be used are refused


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "tiny_x4.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight()))
    return path


def by_torch(lr: Tensor, weight: Tensor) -> Tensor:
    out = F.pixel_shuffle(F.conv2d(lr.permute(2, 0, 1)[None], weight, padding=weight.shape[-1] // 2), 4)
    return images.quantize(out[0].permute(1, 2, 0))


def test_onnx_computes_what_torch_computes_without_a_warning(network: Path, caplog) -> None:
    lr = photo(20, 31)
    sr = Onnx(str(network))("view", lr, 4)
    assert not caplog.text
    assert sr.shape == (80, 124, 3)
    assert (sr - by_torch(lr, upscaling_weight())).abs().max() <= 1.001 / 255
    assert torch.equal(sr, images.quantize(sr))


def test_a_real_network_has_no_seams(shared_data: Path) -> None:
    path = str(shared_data / "sr_weights" / "span_x4.onnx")
    lr = photo(70, 90)
    assert psnr(Onnx(path, tile=80)("view", lr, 4), Onnx(path, tile=1000)("view", lr, 4)) > 60


def test_no_array_is_shared_with_the_network(network: Path) -> None:
    """OpenCV writes its output buffer again at the next run."""
    prior, lr = Onnx(str(network)), photo(8, 12)
    first = prior("a", lr, 4)
    kept = first.clone()
    prior("b", 1 - lr, 4)
    assert torch.equal(first, kept)
    assert not np.shares_memory(first.numpy(), prior("a", lr, 4).numpy())
