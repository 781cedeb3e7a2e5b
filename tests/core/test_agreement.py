"""Agreement of detail between views, on a textured plane whose depth is known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.core.agreement import compare_views, filled_inverse_depth
from clear_strategies.core.view import DepthMap, Photo
from tests.helpers.textured_plane import HEIGHT, PATCH, WIDTH, plane_views, with_invention


def test_detail_that_all_views_show_is_reliable() -> None:
    found = compare_views(plane_views(), PATCH)
    assert set(found) == {"v0", "v1", "v2"}
    for agreement in found.values():
        assert agreement.reliability.shape == (4, 6)
        assert float(agreement.known.double().mean()) > 0.9
        assert float(agreement.reliability[agreement.known].min()) > 0.8


def test_an_invention_in_one_view_is_unreliable_there_and_nowhere_else() -> None:
    views = with_invention(plane_views(), 1, row=2, column=3)
    R = {name: agreement.reliability for name, agreement in compare_views(views, PATCH).items()}
    assert float(R["v1"][2, 3]) < 0.3
    R["v1"][2, 3] = 1
    assert min(float(r.min()) for r in R.values()) > 0.7  # the others also have a view that agrees


@pytest.mark.parametrize("offset", [-0.04, 0.04])
def test_errors_of_depth_below_an_lr_pixel_are_aligned(offset: float) -> None:
    found = compare_views(plane_views(offset=offset), PATCH)  # 2 and 4 LR px of parallax: up to 0.33 of an HR px each
    assert min(float(a.reliability.min()) for a in found.values()) > 0.6


def test_where_the_depth_is_wrong_nothing_is_known() -> None:
    near = [replace(v, depth=DepthMap(v.depth.depth / 3, v.depth.confidence)) for v in plane_views() if v.depth]
    shares = [float(a.known.double().mean()) for a in compare_views(near, PATCH).values()]
    assert max(shares, default=0.0) < 0.2


def test_hidden_surfaces_are_not_compared_and_take_the_mean_of_the_others() -> None:
    views = plane_views(2)
    assert views[1].depth is not None
    near = views[1].depth.depth.clone()
    near[:, : WIDTH // 2] = 1.0  # something in front of the left half of the second view
    views[1] = replace(views[1], depth=DepthMap(near, views[1].depth.confidence))
    found = compare_views(views, PATCH)["v0"]
    assert bool(found.known[:, 4:].any())
    assert not bool(found.known[:, :3].any())
    mean = found.reliability[found.known].mean()
    assert torch.allclose(found.reliability[~found.known], mean)


def test_flat_images_one_view_and_views_without_depth_tell_nothing() -> None:
    views = plane_views()
    flat = [
        replace(
            v,
            lr=Photo(v.lr.camera, torch.full_like(v.lr.image, 0.5)),
            hr=Photo(v.hr.camera, torch.full_like(v.hr.image, 0.5)),
        )
        for v in views
    ]
    assert compare_views(flat, PATCH) == {}
    assert compare_views(views[:1], PATCH) == {}
    assert compare_views([], PATCH) == {}
    assert compare_views([replace(v, depth=None) for v in views], PATCH) == {}


def test_views_that_look_elsewhere_are_not_compared() -> None:
    views = plane_views(2)
    pose = views[1].lr.camera.world_to_camera.clone()
    pose[0, 0] = pose[2, 2] = -1  # turned around
    away = replace(views[1].lr.camera, world_to_camera=pose)
    turned = replace(views[1], lr=Photo(away, views[1].lr.image), hr=Photo(away.scaled(4), views[1].hr.image))
    assert compare_views([views[0], turned], PATCH) == {}


def test_unrelated_detail_agrees_no_better_than_chance() -> None:
    views = plane_views()
    mirrored = [
        replace(
            v,
            hr=Photo(v.hr.camera, (images.upsample(v.lr.image, 4) + 0.1 * torch.randn(
                v.hr.image.shape, generator=torch.Generator().manual_seed(i))).clamp(0, 1)),
        )
        for i, v in enumerate(views)
    ]  # fmt: skip
    assert compare_views(mirrored, PATCH) == {}


def test_the_same_views_give_the_same_bits() -> None:
    views = with_invention(plane_views(), 0, 1, 1)
    one, two = (compare_views(views, PATCH) for _ in range(2))
    assert all(torch.equal(one[name].reliability, two[name].reliability) for name in one)


def test_unknown_depth_is_interpolated_between_known_depths() -> None:
    view = plane_views(1)[0]
    assert view.depth is not None
    depth = torch.linspace(2, 4, WIDTH).expand(HEIGHT, WIDTH).reciprocal().mul(8).clone()  # inverse depth is linear
    known = torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0)) < 0.3
    holes = DepthMap(torch.where(known, depth, math.nan), known.float())
    filled = filled_inverse_depth(replace(view, depth=holes))
    assert filled is not None
    assert torch.equal(filled[known], 1 / depth[known])
    assert float((filled * depth - 1).abs().max()) < 0.1
    assert filled_inverse_depth(replace(view, depth=DepthMap(depth * math.nan, torch.zeros_like(depth)))) is None
