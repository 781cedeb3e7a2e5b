"""The cost volume and its smoothing."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.geometry.dense_stereo import cost
from clear_strategies.geometry.dense_stereo.cost import cost_volume
from clear_strategies.geometry.dense_stereo.image import Grey
from clear_strategies.geometry.dense_stereo.smoothing import smooth
from tests.helpers.planes import plane_photos


def test_the_better_half_of_the_other_photos_decides() -> None:
    first, second, third = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(3))
    planes = torch.tensor([1 / 8, 1 / 4, 1 / 3])
    each = torch.stack([cost_volume(first, [other], planes, 5) for other in (second, third, first, third)])
    found = cost_volume(first, [second, third, first, third], planes, 5)
    assert torch.allclose(found, each.sort(0).values[:2].mean(0))


def test_the_true_plane_costs_next_to_nothing_whatever_the_brightness() -> None:
    first, second = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(2))
    planes = torch.tensor([1 / 8, 1 / 4, 1 / 3])
    for image in (second.image, 0.5 * second.image + 0.2):
        cost = cost_volume(first, [Grey(second.camera, image)], planes, 5)
        seen = cost[5:-5, 20:-5]
        assert seen[..., 1].mean() < 0.03
        assert (seen[..., 0] > seen[..., 1]).float().mean() > 0.95
        assert torch.equal(cost[:, :10, 1], torch.full_like(cost[:, :10, 1], 0.5))  # not in the other photo


@pytest.mark.parametrize("window", [3, 7])
def test_the_compiled_sweep_is_the_readable_one(window: int, monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(2, 77, 71))
    planes = torch.tensor([1 / 8, 1 / 4.1, 1 / 3, 3.0])
    compiled = cost_volume(first, [second], planes, window)
    monkeypatch.setattr(cost.cpp, "available", lambda: False)
    difference = (cost_volume(first, [second], planes, window) - compiled).abs()
    assert difference.median() < 1e-6
    assert difference.max() < 0.01  # where there is next to no contrast


@pytest.mark.parametrize("shape", [(5, 7, 16), (9, 4, 21), (1, 6, 3)])
def test_the_compiled_smoothing_is_the_readable_one(
    shape: tuple[int, int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    volume, image = torch.rand(shape), torch.rand(shape[:2])
    compiled = smooth(volume, image, 0.08, 0.6)
    monkeypatch.setattr(cost.cpp, "available", lambda: False)
    assert torch.equal(compiled, smooth(volume, image, 0.08, 0.6))


def test_smoothing_agrees_with_the_recursion_written_out() -> None:
    g = torch.Generator().manual_seed(0)
    cost, image = torch.rand(4, 5, 6, generator=g), torch.rand(4, 5, generator=g)
    expected = torch.zeros_like(cost)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy or dx:
                expected += along(cost, image, dy, dx)
    assert torch.allclose(smooth(cost, image, 0.08, 0.6), expected / 8, atol=1e-5)


def along(cost: torch.Tensor, image: torch.Tensor, dy: int, dx: int) -> torch.Tensor:
    height, width, planes = cost.shape
    result = torch.zeros_like(cost)
    for y in range(height)[:: 1 if dy >= 0 else -1]:
        for x in range(width)[:: 1 if dx >= 0 else -1]:
            result[y, x] = cost[y, x]
            if not (0 <= y - dy < height and 0 <= x - dx < width):
                continue
            before = result[y - dy, x - dx]
            jump = max(0.08, float(0.6 / (1 + 20 * (image[y, x] - image[y - dy, x - dx]).abs())))
            for d in range(planes):
                near = [float(before[k]) + 0.08 for k in (d - 1, d + 1) if 0 <= k < planes]
                result[y, x, d] += min(float(before[d]), *near, float(before.min()) + jump) - float(before.min())
    return result
