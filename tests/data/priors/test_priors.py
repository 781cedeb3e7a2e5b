"""What holds for several priors: paths, missing models, and the quality of real networks on a real photo."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.priors import Bicubic, Onnx
from clear_strategies.data.priors.interface import super_resolved
from clear_strategies.errors import DataError
from tests.helpers.networks import psnr


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
