"""Each bound of tests/helpers/agreement.py can fail."""

from __future__ import annotations

import pytest
import torch

from tests.helpers.agreement import require_gradient, require_image


def test_equal_tensors_agree_and_each_defect_is_found():
    image = torch.rand(100, 100, 3)
    require_image(image, image)
    flipped = image.clone()
    flipped[3, 4] += 2e-3
    require_image(flipped, image)
    flipped[3, 4] += 1e-2
    with pytest.raises(AssertionError, match="off by"):
        require_image(flipped, image)
    with pytest.raises(AssertionError, match="agree to"):
        require_image(image + 1e-5, image)

    g = torch.randn(2000, 3)
    require_gradient("g", g, g)
    for defect, rule in (
        (g * (1 + 3e-5), "biased"),
        (g + 1e-3 * torch.randn(2000, 3), "relative"),
        (torch.where(torch.arange(2000)[:, None] == 7, torch.nan, g), "finite"),
    ):
        with pytest.raises(AssertionError, match=rule):
            require_gradient("g", defect, g)
    lost = g.clone()
    lost[g.norm(dim=1).argmin()] = 0
    with pytest.raises(AssertionError):
        require_gradient("g", lost, g, relative=1)
