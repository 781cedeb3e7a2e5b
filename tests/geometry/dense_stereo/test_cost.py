"""The cost volume and its smoothing."""

from __future__ import annotations

import torch

from clear_strategies.geometry.dense_stereo.cost import box_mean, cost_volume, mean_of_lowest
from clear_strategies.geometry.dense_stereo.image import Grey
from clear_strategies.geometry.dense_stereo.smoothing import smooth
from tests.helpers.planes import plane_photos


def test_the_mean_of_the_lowest_is_that_of_a_sort() -> None:
    values = torch.rand(5, 4, 7)
    for count in (1, 2, 3):
        expected = values.sort(0).values[:count].mean(0)
        assert torch.allclose(mean_of_lowest(iter(values), count), expected)


def test_a_box_mean_repeats_the_border() -> None:
    image = torch.rand(1, 5, 6)
    padded = torch.nn.functional.pad(image, (1, 1, 1, 1), mode="replicate")
    expected = torch.nn.functional.avg_pool2d(padded, 3, 1)
    assert torch.allclose(box_mean(image, 3), expected, atol=1e-6)


def test_the_true_plane_costs_next_to_nothing_whatever_the_brightness() -> None:
    first, second = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(2))
    planes = torch.tensor([1 / 8, 1 / 4, 1 / 3])
    for image in (second.image, 0.5 * second.image + 0.2):
        cost = cost_volume(first, [Grey(second.camera, image)], planes, 5)
        seen = cost[5:-5, 20:-5]
        assert seen[..., 1].mean() < 0.03
        assert (seen[..., 0] > seen[..., 1]).float().mean() > 0.95
        assert torch.equal(cost[:, :10, 1], torch.full_like(cost[:, :10, 1], 0.5))  # not in the other photo


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
