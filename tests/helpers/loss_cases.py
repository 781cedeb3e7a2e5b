"""Images, and the losses that training uses, for the tests of their kernels."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.kernels import losses
from clear_strategies.kernels.losses import cpp, warp

needs_cpp = pytest.mark.skipif(not cpp.available(), reason="the compiled kernels were not built")
needs_warp = pytest.mark.skipif(not warp.available("cpu"), reason="NVIDIA Warp is not installed")


def image(height, width, seed=0, dtype=torch.float64):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)).to(dtype)


def rough(x, amount, seed=9):
    """The image and a noisy copy."""
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed))
    return x, x + amount * noise


def photo(height, width, seed=5):
    """Blobs of all sizes, edges and fine grain, as in a photograph."""
    scales = (2, 5, 17, 60)
    layers = [image(height // s + 1, width // s + 1, seed + s).float() for s in scales]
    grown = [
        z.repeat_interleave(s, 0).repeat_interleave(s, 1)[:height, :width] for z, s in zip(layers, scales, strict=True)
    ]
    return (0.2 * grown[0] + 0.1 * grown[1] + 0.3 * grown[2] + 0.4 * grown[3]).contiguous()


LOSSES = {
    "photometric": lambda x, y, name="auto": losses.photometric(x, y, 0.2, kernels=name),
    "l1": lambda x, y, name="auto": losses.photometric(x, y, 0.0, kernels=name),
    "1 - ssim": lambda x, y, name="auto": losses.photometric(x, y, 1.0, kernels=name),
    "haar": lambda x, y, name="auto": losses.haar_l1(x, y, 1, kernels=name),
    "haar of three levels": lambda x, y, name="auto": losses.haar_l1(x, y, 3, kernels=name),
}
"""The losses that training uses, at their ends too. All are 0 for equal images, with gradient 0."""
