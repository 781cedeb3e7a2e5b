"""ONNX networks: computed as torch computes them; files that cannot be used are refused."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.priors import Onnx
from tests.helpers.networks import onnx_bytes, photo, psnr, upscaling_weight


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "tiny_x4.onnx"
    path.write_bytes(onnx_bytes(upscaling_weight()))
    return path


def by_torch(lr: Tensor, weight: Tensor) -> Tensor:
    out = F.pixel_shuffle(F.conv2d(lr.permute(2, 0, 1)[None], weight, padding=weight.shape[-1] // 2), 4)
    return images.quantize(out[0].permute(1, 2, 0))


def test_onnx_computes_what_torch_computes(network: Path) -> None:
    lr = photo(20, 31)
    sr = Onnx(str(network))("view", lr, 4)
    assert sr.shape == (80, 124, 3)
    assert (sr - by_torch(lr, upscaling_weight())).abs().max() <= 1.001 / 255
    assert torch.equal(sr, images.quantize(sr))


def test_a_good_network_logs_model_size_and_time_and_no_warning(network, caplog):
    with caplog.at_level("DEBUG"):
        Onnx(str(network))("view", photo(8, 12), 4)
    assert "view: onnx tiny_x4.onnx made 48x32 in" in caplog.text
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
