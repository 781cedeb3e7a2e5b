"""Splits and sizes: the papers' view indices and pixel counts, photo by photo."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.core import images
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.points.cloud import CloudSettings
from clear_strategies.data.prepare import ViewSettings, prepare, rounded, split
from clear_strategies.data.priors.upscale import Bicubic
from rasterizers import Camera

# Training indices among the n photos of each LLFF scene, and the number of test views: the 3-view protocol of RegNeRF,
# FSGS, CoR-GS and DropGaussian.
LLFF = {
    "fern": (20, [1, 10, 19], 3), "flower": (34, [1, 17, 33], 5), "fortress": (42, [1, 21, 41], 6),
    "horns": (62, [1, 30, 61], 8), "leaves": (26, [1, 12, 25], 4), "orchids": (25, [1, 12, 23], 4),
    "room": (41, [1, 20, 39], 6), "trex": (55, [1, 28, 54], 7),
}  # fmt: skip
# Photos, those that are not for testing, test views.
MIP360 = {
    "bicycle": (194, 169, 25), "bonsai": (292, 255, 37), "counter": (240, 210, 30), "garden": (185, 161, 24),
    "kitchen": (279, 244, 35), "room": (311, 272, 39), "stump": (125, 109, 16),
}  # fmt: skip
# Full size, LR = round(full / 8), HR = 4 LR.
SIZES = {
    "LLFF": ((4032, 3024), (504, 378), (2016, 1512)),
    "bicycle": ((4946, 3286), (618, 411), (2472, 1644)),
    "garden": ((5187, 3361), (648, 420), (2592, 1680)),
    "stump": ((4978, 3300), (622, 412), (2488, 1648)),
    "room": ((3114, 2075), (389, 259), (1556, 1036)),
    "counter": ((3115, 2076), (389, 260), (1556, 1040)),
    "kitchen": ((3115, 2078), (389, 260), (1556, 1040)),
    "bonsai": ((3118, 2078), (390, 260), (1560, 1040)),
    "flowers": ((5025, 3312), (628, 414), (2512, 1656)),
    "treehill": ((5068, 3326), (634, 416), (2536, 1664)),
}


def capture(n: int = 3, width: int = 16, height: int = 16, image: torch.Tensor | None = None) -> Capture:
    """N photos side by side, which are gradients unless given."""
    if image is None:
        image = torch.linspace(0, 1, width)[None, :, None].expand(height, width, 3).contiguous()
    frames = []
    for i in range(n):
        pose = torch.eye(4)
        pose[0, 3] = -i
        camera = Camera(pose, 1.2 * width, 1.2 * width, 0.45 * width, 0.55 * height, width, height)
        frames.append(Frame(f"{i:04d}.png", camera, lambda: image))
    return Capture("made up", tuple(frames))


def indices(frames: list[Frame]) -> list[int]:
    return [int(frame.name[:4]) for frame in frames]


@pytest.mark.parametrize("scene", LLFF)
def test_llff_trains_and_tests_on_the_papers_views(scene):
    n, expected, n_test = LLFF[scene]
    train, test = split(capture(n), ViewSettings(train=3))
    assert indices(train) == expected
    assert indices(test) == list(range(0, n, 8))
    assert len(test) == n_test


@pytest.mark.parametrize("scene", MIP360)
def test_mip360_trains_on_24_views_spread_over_the_pool(scene):
    n, n_pool, n_test = MIP360[scene]
    train, test = split(capture(n), ViewSettings(train=24))
    pool = [i for i in range(n) if i % 8]
    assert (len(pool), len(test), len(train)) == (n_pool, n_test, 24)
    assert indices(train)[0] == pool[0]
    assert indices(train)[-1] == pool[-1]
    steps = [pool.index(b) - pool.index(a) for a, b in zip(indices(train), indices(train)[1:], strict=False)]
    assert max(steps) - min(steps) <= 1


@pytest.mark.parametrize("scene", SIZES)
def test_photos_get_the_published_sizes(scene):
    full, lr, hr = SIZES[scene]
    camera = rounded(Camera(torch.eye(4), 1.0, 1.0, 1.0, 1.0, *full), shrink=2, multiple=4)
    assert (camera.width, camera.height) == hr
    assert (camera.scaled(1 / 4).width, camera.scaled(1 / 4).height) == lr


def made(sizes: str, width: int = 57, height: int = 43, **settings):
    views = ViewSettings(train=1, sizes=sizes, **settings)
    return prepare(capture(2, width, height), views, Bicubic(), CloudSettings(init="random", random_points=20)).train[0]


def test_rounded_sizes_keep_the_border_and_the_rays_through_it():
    """57x43 at shrink 2, x4: 57/8 = 7.125 -> 7, 43/8 = 5.375 -> 5."""
    view, photo = made("round", shrink=2), capture(2, 57, 43).frames[1].camera
    assert (view.lr.camera.width, view.lr.camera.height, view.hr.camera.width, view.hr.camera.height) == (7, 5, 28, 20)
    for camera in (view.lr.camera, view.hr.camera):
        for k, size in (("x", "width"), ("y", "height")):  # the same field of view, each axis by its own ratio
            ratio = getattr(camera, size) / getattr(photo, size)
            assert getattr(camera, f"f{k}") == pytest.approx(getattr(photo, f"f{k}") * ratio)
            assert getattr(camera, f"c{k}") == pytest.approx(getattr(photo, f"c{k}") * ratio)
    last = float(view.truth[0, -1, 0])
    assert last > 0.97  # the photo ends at 1


def test_cropped_sizes_lose_the_border_and_keep_the_focal_length():
    view, photo = made("crop", shrink=2), capture(2, 57, 43).frames[1].camera
    assert (view.hr.camera.width, view.hr.camera.height) == (28, 20)
    assert (view.hr.camera.fx, view.hr.camera.cy) == pytest.approx((photo.fx / 2, photo.cy / 2))


def test_where_nothing_is_left_over_both_rules_agree():
    crop, rounded = (made(sizes, 64, 48, shrink=2) for sizes in ("crop", "round"))
    assert torch.equal(crop.truth, rounded.truth)
    assert torch.equal(crop.lr.image, rounded.lr.image)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert getattr(crop.hr.camera, name) == getattr(rounded.hr.camera, name)


def test_a_photo_too_small_for_its_factor_is_refused():
    with pytest.raises(ValueError, match="must be positive"):
        made("round", 3, 40, shrink=2)


def test_resizing_is_downsampling_where_the_factor_is_whole():
    image = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(0))
    for kernel in ("bicubic", "bilinear", "lanczos", "area"):
        small = images.resize(image, (5, 3), kernel)
        assert torch.allclose(small, images.downsample(image, 4, kernel), atol=1e-6)
    assert torch.equal(images.resize(image, (20, 12)), image)
    assert images.resize(image, (7, 5), "area").shape == (5, 7, 3)


def test_the_area_mean_and_its_transpose_are_adjoint():
    g = torch.Generator().manual_seed(1)
    x, y = torch.randn(8, 12, 3, generator=g), torch.randn(2, 3, 3, generator=g)
    left = (images.area_mean(x, 4) * y).sum()
    right = (x * images.area_mean_transposed(y[None], 4)[0]).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-5)
