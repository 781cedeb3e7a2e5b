"""Priors: ONNX networks, SR images from a folder, the cache, tiles, and what holds for several."""

import logging
import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Bicubic, Cached, Images, Onnx, cache_folder
from clear_strategies.data.priors.interface import super_resolved
from clear_strategies.data.priors.tiling import tiled
from clear_strategies.errors import DataError
from tests.helpers.networks import Counting, onnx_bytes, photo, psnr, upscaling_weight


# ---- what holds for several priors: paths, missing models, and the quality of real networks on a real photo
def test_real_networks_do_on_fern_what_is_known_of_them_without_seams(shared_data, caplog):
    """504x376 from 126x94, a training view."""
    weights, photos = shared_data / "sr_weights", sorted((shared_data / "fern" / "images_4").iterdir())
    hr = images.downsample(read_image(photos[10])[:752], 2)[:376, :504]
    lr = images.downsample(hr, 4)
    expected = {
        Bicubic(): 23.51,
        Onnx(str(weights / "span_x4.onnx")): 25.24,
        Onnx(str(weights / "imdn_x4.onnx")): 25.38,
    }
    found = {prior: psnr(prior("fern", lr, 4), hr) for prior in expected}
    assert found == pytest.approx(expected, abs=0.03)
    assert not [record for record in caplog.records if record.levelno > logging.INFO]
    path = str(shared_data / "sr_weights" / "span_x4.onnx")
    lr = photo(70, 90)
    assert psnr(Onnx(path, tile=80)("view", lr, 4), Onnx(path, tile=1000)("view", lr, 4)) > 60


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
def test_what_is_no_sr_image_is_refused_by_the_name_of_its_view_and_not_cached(made, told, tmp_path, monkeypatch):
    monkeypatch.setattr(Counting, "__call__", lambda self, name, lr, factor: made)
    for prior in (Counting(), Cached(Counting(), tmp_path)):
        with pytest.raises(DataError, match=f"a: SR image: {told}"):
            super_resolved(prior, "a", torch.zeros(2, 3, 3), 4)
    assert not [*tmp_path.iterdir()]


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
    Image.new("RGBA", (64, 64)).save(tmp_path / "clear.png")
    Images(str(tmp_path))("clear", torch.ones(16, 16, 3), 4)
    assert "check that its transparent pixels are black in the photos, too; else save it without alpha" in caplog.text


# ---- ONNX networks: computed as torch computes them; files that cannot be used are refused
@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "tiny_x4.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight()))
    return path


def by_torch(lr: Tensor, weight: Tensor) -> Tensor:
    out = F.pixel_shuffle(F.conv2d(lr.permute(2, 0, 1)[None], weight, padding=weight.shape[-1] // 2), 4)
    return images.quantize(out[0].permute(1, 2, 0))


def test_onnx_computes_what_torch_computes_without_a_warning_and_shares_no_array(network: Path, caplog) -> None:
    lr = photo(20, 31)
    sr = Onnx(str(network))("view", lr, 4)
    assert not caplog.text
    assert sr.shape == (80, 124, 3)
    assert (sr - by_torch(lr, upscaling_weight())).abs().max() <= 1.001 / 255
    assert torch.equal(sr, images.quantize(sr))
    # OpenCV writes its output buffer again at the next run.
    prior, lr = Onnx(str(network)), photo(8, 12)
    first = prior("a", lr, 4)
    kept = first.clone()
    prior("b", 1 - lr, 4)
    assert torch.equal(first, kept)
    assert not np.shares_memory(first.numpy(), prior("a", lr, 4).numpy())


# ---- SR images are computed once per content, and computed again if the entry is damaged
@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.bin"
    path.write_bytes(b"weights")
    return path


def worked(counting: Counting, folder: Path, lr: Tensor, factor: int = 2) -> bool:
    """Did the prior have to work, or was the result in the cache?"""
    Cached(counting, folder)("view", lr, factor)
    return bool(counting.calls)


def test_a_result_is_computed_once_and_is_the_same_from_the_cache(model: Path, tmp_path: Path) -> None:
    counting, lr = Counting(str(model)), photo(5, 6)
    cached = Cached(counting, tmp_path / "cache")
    first, again = (cached(name, lr, 2) for name in ("a", "b"))
    assert torch.equal(first, again)
    assert first.stride() == again.stride()  # sums over another layout would have another order
    assert counting.calls == ["a"]
    assert torch.equal(first, images.quantize(first))
    assert cached.label == "counting"


def test_what_changes_the_result_changes_the_key_and_nothing_else_does(model: Path, tmp_path: Path) -> None:
    folder, lr = tmp_path / "cache", photo(5, 6)
    assert worked(Counting(str(model)), folder, lr)
    assert not worked(Counting(str(model)), folder, lr)
    assert not worked(Counting(str(shutil.copy(model, tmp_path / "moved.bin"))), folder, lr)
    assert worked(Counting(str(model), setting=1), folder, lr)
    assert worked(Counting(str(model)), folder, lr, factor=3)
    assert worked(Counting(str(model)), folder, lr + 1 / 255)
    assert worked(Counting(str(model)), folder, lr.reshape(6, 5, 3))
    model.write_bytes(b"other weights")
    assert worked(Counting(str(model)), folder, lr)


def test_another_version_of_opencv_computes_the_images_of_a_network_in_onnx_again(network, tmp_path, monkeypatch):
    def entries() -> int:
        Cached(Onnx(str(network)), tmp_path / "cache")("view", photo(4, 4), 4)
        return len(list((tmp_path / "cache").iterdir()))

    assert [entries(), entries()] == [1, 1]
    monkeypatch.setattr(cv2, "__version__", "another")
    assert entries() == 2


@pytest.mark.parametrize("damage", ["truncated", "garbage", "another size"])
def test_a_damaged_entry_is_logged_and_computed_again(model, tmp_path, damage, caplog):
    folder, lr = tmp_path / "cache", photo(16, 16)
    counting = Counting(str(model))
    first = Cached(counting, folder)("view", lr, 2)
    (entry,) = folder.iterdir()
    if damage == "another size":
        write_png(entry, photo(3, 3))
    else:
        entry.write_bytes(entry.read_bytes()[:-40] if damage == "truncated" else b"garbage")
    assert torch.equal(Cached(counting, folder)("view", lr, 2), first)
    assert len(counting.calls) == 2
    assert "a cached SR image is damaged and is computed again" in caplog.text
    assert torch.equal(read_image(entry), first)


def test_a_cache_that_cannot_be_written_costs_no_result_and_the_environment_moves_it(
    model, tmp_path, caplog, monkeypatch
):
    (tmp_path / "file").write_bytes(b"in the way of a folder")
    lr = photo(5, 6)
    for name in ("view", "another"):
        assert Cached(Counting(str(model)), tmp_path / "file" / "cache")(name, lr, 2).shape == (10, 12, 3)
    assert caplog.text.count("cannot be cached") == 1
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    assert Cached(Counting("")).folder == tmp_path / "sr"
    monkeypatch.delenv("CLEAR_CACHE")
    assert cache_folder() == Path.home() / ".cache" / "clear-strategies"
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # a user without $HOME and account
    assert cache_folder() == Path(tempfile.gettempdir(), "clear-strategies")


# ---- tiles join without seams, and equal the whole image where the overlap covers the receptive field
@given(
    height=st.integers(1, 40), width=st.integers(1, 40), overlap=st.integers(0, 4), more=st.integers(1, 20),
    factor=st.sampled_from([1, 2, 4]), seed=st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=20, deadline=None)
def test_tiles_join_to_the_whole_where_the_overlap_is_the_receptive_field(height, width, overlap, more, factor, seed):
    kernel = torch.randn(3, 1, 2 * overlap + 1, 2 * overlap + 1, generator=torch.Generator().manual_seed(seed))
    tile = 4 * overlap + more

    def upscale(lr: Tensor) -> Tensor:
        assert whole_image or max(lr.shape[:2]) <= tile
        blurred = F.conv2d(lr.permute(2, 0, 1)[None], kernel, padding=overlap, groups=3)
        return F.interpolate(blurred, scale_factor=factor)[0].permute(1, 2, 0)

    lr = photo(height, width, seed)
    whole_image = False
    joined = tiled(upscale, lr, factor, tile, overlap)
    whole_image = True
    assert torch.allclose(joined, upscale(lr), atol=1e-4)


def test_tiles_that_differ_are_faded_into_each_other() -> None:
    """Two tiles of different grey: along a row, the result changes by one ramp's slope per pixel."""
    greys = iter([0.0, 1.0])
    joined = tiled(lambda lr: torch.full((4 * lr.shape[0], 4 * lr.shape[1], 3), next(greys)), photo(8, 80), 4, 72, 8)
    row = joined[0, :, 0]
    # The shares meet at LR 40, HR 160; 8 LR pixels on both sides are 64 HR pixels of ramp.
    assert torch.all(row[:128] == 0)
    assert torch.all(row[192:] == 1)
    assert torch.allclose(row[128:192], (torch.arange(64) + 0.5) / 64)
