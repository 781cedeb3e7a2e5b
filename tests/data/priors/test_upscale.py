"""SR priors: networks computed right, tiles without seams, files that cannot be used refused, results cached by content."""

from __future__ import annotations

import logging
import math
import shutil
import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors.upscale import Bicubic, Cached, DnnSuperres, Images, Onnx, cache_folder, tiled
from clear_strategies.errors import DataError


def photo(height: int, width: int, seed: int = 0) -> Tensor:
    """Smooth and coloured, on 8-bit steps."""
    coarse = torch.rand(max(height // 4, 2), max(width // 4, 2), 3, generator=torch.Generator().manual_seed(seed))
    smooth = F.interpolate(coarse.permute(2, 0, 1)[None], size=(height, width), mode="bicubic").clamp(0.02, 0.98)
    return images.quantize(smooth[0].permute(1, 2, 0))


# --- a hand-made ONNX file: convolution, then DepthToSpace -----------------------------------------------------------


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def number(tag: int, value: int) -> bytes:
    return varint(tag << 3) + varint(value)


def block(tag: int, value: bytes | str) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return varint(tag << 3 | 2) + varint(len(data)) + data


def tensor(name: str, values: Tensor, external: str | None = None) -> bytes:
    head = b"".join(number(1, n) for n in values.shape) + number(2, 1) + block(8, name)
    if external is None:
        return head + block(9, values.numpy().astype("<f4").tobytes())
    return head + block(13, block(1, "location") + block(2, external)) + number(14, 1)


def value_info(name: str, *sizes: int | str) -> bytes:
    dims = b"".join(block(1, number(1, s) if isinstance(s, int) else block(2, s)) for s in sizes)
    return block(1, name) + block(2, block(1, number(1, 1) + block(2, dims)))


def attribute(name: str, value: int | str | list[int]) -> bytes:
    if isinstance(value, int):
        return block(1, name) + number(3, value) + number(20, 2)
    if isinstance(value, str):
        return block(1, name) + block(4, value) + number(20, 3)
    return block(1, name) + b"".join(number(8, v) for v in value) + number(20, 7)


def node(kind: str, inputs: list[str], output: str, **attributes: int | str | list[int]) -> bytes:
    body = b"".join(block(1, name) for name in inputs) + block(2, output) + block(3, kind) + block(4, kind)
    return body + b"".join(block(5, attribute(name, value)) for name, value in attributes.items())


def onnx_bytes(weight: Tensor, *, scale: int = 4, external: str | None = None) -> bytes:
    edge = weight.shape[-1]
    conv = node("Conv", ["lr", "weight"], "bands", kernel_shape=[edge, edge], pads=[edge // 2] * 4, strides=[1, 1])
    shuffle = node("DepthToSpace", ["bands"], "sr", blocksize=scale, mode="CRD")
    graph = block(1, conv) + block(1, shuffle) + block(2, "x4") + block(5, tensor("weight", weight, external))
    graph += block(11, value_info("lr", 1, 3, "h", "w")) + block(12, value_info("sr", 1, 3, "H", "W"))
    return number(1, 8) + block(7, graph) + block(8, block(1, "") + number(2, 13))


def upscaling_weight(edge: int = 5, scale: int = 4) -> Tensor:
    """Near-identity: each HR pixel is its LR pixel plus a little of the neighbours."""
    weight = torch.randn(3 * scale**2, 3, edge, edge, generator=torch.Generator().manual_seed(edge)) * 0.003
    for band in range(3 * scale**2):
        weight[band, band // scale**2, edge // 2, edge // 2] += 1
    return weight


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "tiny_x4.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight()))
    return path


def by_torch(lr: Tensor, weight: Tensor) -> Tensor:
    out = F.pixel_shuffle(F.conv2d(lr.permute(2, 0, 1)[None], weight, padding=weight.shape[-1] // 2), 4)
    return images.quantize(out[0].permute(1, 2, 0))


# --- ONNX ------------------------------------------------------------------------------------------------------------


def test_onnx_computes_what_torch_computes(network: Path) -> None:
    lr = photo(20, 31)
    sr = Onnx(str(network))("view", lr, 4)
    assert sr.shape == (80, 124, 3)
    assert (sr - by_torch(lr, upscaling_weight())).abs().max() <= 1.001 / 255
    assert torch.equal(sr, images.quantize(sr))


def test_onnx_in_tiles_equals_onnx_at_once(network: Path) -> None:
    lr = photo(50, 61)
    whole = Onnx(str(network), tile=100)("view", lr, 4)
    parts = Onnx(str(network), tile=24, overlap=4)("view", lr, 4)
    assert (whole - parts).abs().max() <= 1.001 / 255
    assert ((whole - parts) != 0).float().mean() < 1e-3


def test_onnx_of_another_scale_is_refused_naming_both_shapes(tmp_path: Path) -> None:
    path = tmp_path / "x2.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight(scale=2), scale=2))
    with pytest.raises(DataError, match=r"\(1, 3, 16, 24\) where \(1, 3, 32, 48\) is expected: use a x4 network"):
        Onnx(str(path))("view", photo(8, 12), 4)


def test_onnx_that_makes_nan_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "nan.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight() * math.nan))
    with pytest.raises(DataError, match=r"nan\.onnx: output: is not finite"):
        Onnx(str(path))("view", photo(8, 12), 4)


def test_onnx_weights_outside_the_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    weight = upscaling_weight()
    (tmp_path / "secret.bin").write_bytes(weight.numpy().astype("<f4").tobytes())
    (tmp_path / "models").mkdir()
    shutil.copy(tmp_path / "secret.bin", tmp_path / "models" / "beside.bin")
    monkeypatch.chdir(tmp_path / "models")  # from where OpenCV would follow relative paths
    path = tmp_path / "models" / "external.onnx"
    for location in ("../secret.bin", str(tmp_path / "secret.bin"), "beside.bin"):
        path.write_bytes(onnx_bytes(weight, external=location))
        with pytest.raises(DataError, match=r"external\.onnx: weights: lie in other files"):
            Onnx(str(path))("view", photo(8, 12), 4)


@pytest.mark.parametrize(
    "content",
    [b"", b"\0", b"not a network at all", struct.pack("<64Q", *range(64)), onnx_bytes(upscaling_weight())[:500]],
)
def test_onnx_that_is_garbage_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "garbage.onnx"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"garbage\.onnx: ") as error:
        Onnx(str(path))("view", photo(8, 12), 4)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("prior", [Onnx, DnnSuperres])
def test_a_model_that_is_not_there_is_refused(prior: type[Onnx | DnnSuperres], tmp_path: Path) -> None:
    for path in (tmp_path / "absent", tmp_path):
        with pytest.raises(DataError, match=r"file: is not there: set prior\.path"):
            prior(str(path))("view", photo(8, 12), 4)


def test_a_network_with_its_channels_in_another_order_is_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "bgr.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight().flip(1)))
    Onnx(str(path))("view", photo(8, 12), 4)
    assert "check that it is of this view, RGB and in [0, 1]" in caplog.text


def test_a_good_network_logs_model_size_and_time_and_no_warning(
    network: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO):
        Onnx(str(network))("view", photo(8, 12), 4)
    assert "view: onnx tiny_x4.onnx made 48x32 in" in caplog.text
    assert not [record for record in caplog.records if record.levelno > logging.INFO]


# --- tiles -----------------------------------------------------------------------------------------------------------


@given(
    height=st.integers(1, 70), width=st.integers(1, 70), overlap=st.integers(0, 6), more=st.integers(1, 30),
    factor=st.sampled_from([1, 2, 4]), seed=st.integers(0, 9),
)  # fmt: skip
@settings(max_examples=80, deadline=None)
def test_tiles_join_to_the_whole_where_the_overlap_reaches_as_far_as_the_network_sees(
    height: int, width: int, overlap: int, more: int, factor: int, seed: int
) -> None:
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
    """Each tile gets a grey of its own; along a row the result then changes by at most one ramp's slope per pixel."""
    greys = iter([0.0, 1.0])
    joined = tiled(lambda lr: torch.full((4 * lr.shape[0], 4 * lr.shape[1], 3), next(greys)), photo(8, 80), 4, 72, 8)
    row = joined[0, :, 0]
    # The shares meet at LR 40, HR 160; 8 LR pixels on both sides are 64 HR pixels of ramp.
    assert torch.all(row[:128] == 0)
    assert torch.all(row[192:] == 1)
    assert torch.allclose(row[128:192], (torch.arange(64) + 0.5) / 64)


@pytest.mark.parametrize(("tile", "overlap"), [(64, 16), (0, 0), (10, -1)])
def test_tiles_that_are_all_overlap_are_refused(tile: int, overlap: int) -> None:
    with pytest.raises(ValueError, match=r"0 <= 4 overlap < tile must hold"):
        Onnx("x.onnx", tile=tile, overlap=overlap)
    with pytest.raises(ValueError, match=r"0 <= 4 overlap < tile must hold"):
        tiled(lambda lr: lr, photo(4, 4), 1, tile, overlap)


# --- bicubic and ready-made images -----------------------------------------------------------------------------------


def test_bicubic_is_u_on_eight_bits() -> None:
    lr = photo(9, 7)
    assert torch.equal(Bicubic()("view", lr, 3), images.quantize(images.upsample(lr, 3)))


def test_images_are_found_by_the_views_stem_and_the_suffix(tmp_path: Path) -> None:
    lr = photo(6, 8)
    for name, seed in (("a.png", 1), ("a_x4.png", 2), ("b.png", 3)):
        write_png(tmp_path / name, images.upsample(photo(6, 8, seed), 4))
    assert torch.equal(Images(str(tmp_path))("a.JPG", lr, 4), read_image(tmp_path / "a.png"))
    assert torch.equal(Images(str(tmp_path), suffix="_x4")("train/a", lr, 4), read_image(tmp_path / "a_x4.png"))


def test_images_of_another_size_are_refused_naming_both(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", photo(12, 16))
    with pytest.raises(DataError, match=r"a\.png: size: is 16x12, but 4 times the LR image is 32x24"):
        Images(str(tmp_path))("a.jpg", photo(6, 8), 4)


def test_images_that_are_missing_or_ambiguous_are_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", photo(24, 32))
    with pytest.raises(DataError, match=r"b: has no SR image b_x4"):
        Images(str(tmp_path), suffix="_x4")("b.png", photo(6, 8), 4)
    (tmp_path / "a.jpg").write_bytes(b"a twin")
    with pytest.raises(DataError, match=r"a: has a\.jpg and a\.png for one view: keep one of them"):
        Images(str(tmp_path))("a.png", photo(6, 8), 4)
    with pytest.raises(DataError, match=r"folder: is not there"):
        Images(str(tmp_path / "absent"))("a.png", photo(6, 8), 4)


def test_images_of_another_view_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    lr = photo(16, 16, seed=1)
    write_png(tmp_path / "right.png", images.upsample(lr, 4))
    write_png(tmp_path / "wrong.png", images.upsample(photo(16, 16, seed=2), 4))
    Images(str(tmp_path))("right", lr, 4)
    assert not caplog.text
    Images(str(tmp_path))("wrong", lr, 4)
    assert "wrong.png: reduced again, the SR image is" in caplog.text


# --- the cache -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Counting:
    """Nearest-neighbour upsampling that remembers for whom it worked."""

    path: str
    setting: int = 0
    calls: list[str] = field(default_factory=list, compare=False)

    label = "counting"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Tensor, factor: int) -> Tensor:
        self.calls.append(name)
        return images.upsample(lr, factor, "nearest") + 0.001


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.bin"
    path.write_bytes(b"weights")
    return path


def worked(prior: object, folder: Path, lr: Tensor, factor: int = 2) -> bool:
    """Did the prior have to work, or was the result in the cache?"""
    counting = prior if isinstance(prior, Counting) else Counting("")
    before = len(counting.calls)
    Cached(counting, folder)("view", lr, factor)
    return len(counting.calls) > before


def test_a_result_is_made_once_and_is_the_same_from_the_cache(model: Path, tmp_path: Path) -> None:
    counting, lr = Counting(str(model)), photo(5, 6)
    cached = Cached(counting, tmp_path / "cache")
    first = cached("a", lr, 2)
    assert torch.equal(first, cached("b", lr, 2))
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


@pytest.mark.parametrize("damage", ["truncated", "garbage", "another size"])
def test_a_damaged_entry_is_noticed_and_made_again(
    model: Path, tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
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
    assert "a cached SR image is damaged and is made again" in caplog.text
    assert torch.equal(read_image(entry), first)


def test_a_cache_that_cannot_be_written_costs_time_but_no_result(
    model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_bytes(b"in the way of a folder")
    lr = photo(5, 6)
    assert Cached(Counting(str(model)), tmp_path / "file" / "cache")("view", lr, 2).shape == (10, 12, 3)
    assert "cannot be cached" in caplog.text


def test_a_cached_model_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"absent\.onnx: file: is not there"):
        Cached(Onnx(str(tmp_path / "absent.onnx")), tmp_path)("view", photo(4, 4), 4)


def test_the_cache_is_where_the_environment_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    assert Cached(Counting("")).folder == tmp_path / "sr"
    monkeypatch.delenv("CLEAR_CACHE")
    assert cache_folder() == Path.home() / ".cache" / "clear-strategies"


# --- dnn_superres ----------------------------------------------------------------------------------------------------


def test_dnn_superres_of_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match=r"model must be edsr, espcn, fsrcnn or lapsrn, got 'srgan'"):
        DnnSuperres("x.pb", model="srgan")


def test_dnn_superres_with_a_garbage_model_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "garbage.pb"
    path.write_bytes(b"not a graph")
    with pytest.raises(DataError, match=r"garbage\.pb: network: cannot be run as espcn x4") as error:
        DnnSuperres(str(path))("view", photo(8, 12), 4)
    assert "\n" not in str(error.value)


def test_dnn_superres_of_another_scale_is_refused(shared_data: Path) -> None:
    with pytest.raises(DataError, match=r"ESPCN_x4\.pb: network: "):
        DnnSuperres(str(shared_data / "sr_weights" / "ESPCN_x4.pb"))("view", photo(8, 12), 3)


# --- real networks on a real photo -----------------------------------------------------------------------------------


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-12))


def test_real_networks_do_on_fern_what_is_known_of_them(shared_data: Path, caplog: pytest.LogCaptureFixture) -> None:
    """504x376 from 126x94, a training view. ONNX comes after dnn_superres: in one process they must not disturb each other."""
    weights, photos = shared_data / "sr_weights", sorted((shared_data / "fern" / "images_4").iterdir())
    hr = images.downsample(images.crop_to_multiple(read_image(photos[10]), 8), 2)[:376, :504]
    lr = images.downsample(hr, 4)
    expected = {
        Bicubic(): 23.51,
        DnnSuperres(str(weights / "ESPCN_x4.pb"), "espcn"): 23.42,
        DnnSuperres(str(weights / "FSRCNN_x4.pb"), "fsrcnn"): 23.44,
        Onnx(str(weights / "span_x4.onnx")): 25.24,
        Onnx(str(weights / "imdn_x4.onnx")): 25.38,
    }
    found = {prior: psnr(prior("fern", lr, 4), hr) for prior in expected}
    assert found == pytest.approx(expected, abs=0.03)
    assert not [record for record in caplog.records if record.levelno > logging.INFO]


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
