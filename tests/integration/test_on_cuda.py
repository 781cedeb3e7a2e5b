"""gsplat's kernels on CUDA in the example's loop: photos, cameras, points and splats on the device, strategies beside them."""

from __future__ import annotations

import pytest
import torch

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@pytest.mark.slow  # gsplat compiles its kernels
@pytest.mark.parametrize("strategies", [None, "gco", "p2g", "svs", "clear", "best"])
def test_gsplats_loop_trains_on_cuda(strategies):
    pytest.importorskip("gsplat")
    from integration.examples.gsplat_loop import main

    torch.manual_seed(0)
    assert main(100, strategies) > 18
