"""Depth maps: right on known surfaces, unknown where nothing tells depth, the same bits every time; their completion."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from clear_strategies.core.view import Photo
from clear_strategies.geometry.dense_stereo import consistency, cost, sources
from clear_strategies.geometry.dense_stereo.consistency import speckles
from clear_strategies.geometry.dense_stereo.cost import Grey, cost_volume
from clear_strategies.geometry.dense_stereo.maps import depth_maps
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from clear_strategies.geometry.dense_stereo.smoothing import smooth
from clear_strategies.geometry.filling import completed
from rasterizers.interface import Camera
from tests.helpers import planes
from tests.helpers.planes import plane_photos, same_maps

# ---- photos of a textured surface z = f(x, y), cast by fixed-point iteration, with their exact depth
Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]


def slanted(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A plane that recedes to the right."""
    return 4 + 0.3 * x


def bump(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The front of a sphere of radius 3 around (0, 0, 6), with its rim continued as a plane."""
    return 6 - np.sqrt(np.clip(9 - x**2 - y**2, 4, None))


def camera(x: float, degrees: float = 0.0, size: tuple[int, int] = (64, 48)) -> Camera:
    """At (x, 0, 0), turned about y by `degrees` towards -x, focal length as long as the image is wide."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turned = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    straight = planes.camera(x, *size, float(size[0]))
    return replace(straight, world_to_camera=turned @ straight.world_to_camera)


def cast(surface: Surface, seen: Camera) -> tuple[Photo, Tensor]:
    """(photo, z of each pixel)."""
    x, y = np.meshgrid(np.arange(seen.width) + 0.5, np.arange(seen.height) + 0.5)
    rays = np.stack(((x - seen.cx) / seen.fx, (y - seen.cy) / seen.fy, np.ones_like(x)), -1)
    pose = seen.world_to_camera.double().numpy()
    directions, center = rays @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
    depth = np.full(x.shape, 4.0)
    for _ in range(60):
        at = center + depth[..., None] * directions
        depth += 0.7 * (surface(at[..., 0], at[..., 1]) - at[..., 2])
    at = center + depth[..., None] * directions
    return Photo(seen, torch.from_numpy(_texture(at[..., 0], at[..., 1])).float()), torch.from_numpy(depth)


def _texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sums of waves in random directions, the shortest some 5 px long in the photos here."""
    random = np.random.default_rng(0)
    colors = np.zeros((*x.shape, 3))
    for _ in range(40):
        angle, frequency, phase = random.uniform(0, math.pi), random.uniform(4, 20), random.uniform(0, 7)
        wave = np.sin(frequency * (x * math.cos(angle) + y * math.sin(angle)) + phase)
        colors += 0.03 * wave[..., None] * random.uniform(0.3, 1, 3)
    return np.clip(0.5 + colors, 0, 1)


# ---- depth of known surfaces, and of photos that tell none
NONE = torch.zeros(0, 3)
QUICK = StereoSettings(enlarge=1, max_planes=64)


def photos_of(surface: Surface, count: int = 3, size: tuple[int, int] = (64, 48)) -> list[Photo]:
    return [cast(surface, camera(0.4 * i - 0.4, 4 * (i - 1), size))[0] for i in range(count)]


@pytest.mark.parametrize("surface", [slanted, bump])
def test_depth_of_a_known_surface_is_found_from_the_cameras_alone(surface: Surface) -> None:
    for i, result in enumerate(depth_maps(photos_of(surface), NONE, QUICK)):
        exact = cast(surface, camera(0.4 * i - 0.4, 4 * (i - 1)))[1]
        error = (result.depth / exact - 1).abs()[result.known]
        assert torch.equal(result.depth.isnan(), ~result.known)
        assert 0 <= float(result.confidence.min()) <= float(result.confidence.max()) <= 1
        assert result.coverage > 0.5
        assert error.median() < 0.012
        assert (error < 0.03).float().mean() > 0.97


def test_depth_in_a_range_that_the_cameras_give_is_as_exact_as_in_that_of_points() -> None:
    photos = plane_photos(4)
    without, given = (depth_maps(photos, points) for points in (NONE, torch.tensor([[0.6, 0.0, 4.0]]).expand(20, 3)))
    for guessed, known in zip(without, given, strict=True):
        assert guessed.coverage == pytest.approx(known.coverage, abs=0.02)
        assert (guessed.depth[guessed.known] - 4).abs().mean() < 0.02


def test_a_few_points_choose_the_photos_that_all_points_would_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    ring = [Photo(camera(0.05 * i, 0.7 * i), torch.zeros(48, 64, 3)) for i in range(-20, 20)]
    points = torch.rand(5_000, 3) * torch.tensor((4.0, 2.0, 1.0)) + torch.tensor((-2.0, -1.0, 4.0))
    chosen = sources.comparisons(ring, points, 8)
    monkeypatch.setattr(sources, "_CANDIDATES", len(ring))
    assert chosen == sources.comparisons(ring, points, 8)
    assert all(len(comparison.others) == 8 for comparison in chosen)


@pytest.mark.slow
def test_the_bits_do_not_depend_on_the_number_of_threads() -> None:
    photos, threads = photos_of(bump, 2, (100, 85)), torch.get_num_threads()
    settings = StereoSettings(max_planes=8, speckle=0)  # so few planes give speckles alone
    result = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            result.append(depth_maps(photos, NONE, settings))
    finally:
        torch.set_num_threads(threads)
    assert result[0][0].coverage > 0
    assert same_maps(*result)


def test_photos_may_have_odd_sizes_and_one_whose_stereo_fails_does_not_spoil_the_others() -> None:
    sizes = [(64, 48), (51, 37), (90, 75)]
    photos = [cast(slanted, camera(0.4 * i - 0.4, 4 * (i - 1), size))[0] for i, size in enumerate(sizes)]
    for photo, result in zip(photos, depth_maps(photos, NONE, QUICK), strict=True):
        assert result.depth.shape == photo.image.shape[:2]
        assert result.coverage > 0.3
    photos = photos_of(slanted)
    photos[2] = FLAT[2]
    first, second, third = depth_maps(photos, NONE, QUICK)
    assert first.coverage > 0.3
    assert second.coverage > 0.3
    assert third.coverage == 0
    tiny = [cast(slanted, camera(0.3 * i, 0, (3, 2)))[0] for i in range(2)]
    assert [m.depth.shape for m in depth_maps(tiny, NONE, QUICK)] == [(2, 3), (2, 3)]


@pytest.mark.parametrize("changed", [{"enlarge": 2, "max_planes": 48}, {"max_pixels": 800}])
def test_compared_images_may_be_larger_or_smaller_than_the_photos(changed: dict[str, int]) -> None:
    photos = photos_of(slanted, size=(65, 49))
    for i, result in enumerate(depth_maps(photos, NONE, StereoSettings(**changed))):
        exact = cast(slanted, camera(0.4 * i - 0.4, 4 * (i - 1), (65, 49)))[1]
        assert result.depth.shape == exact.shape
        assert result.coverage > 0.3
        assert (result.depth / exact - 1).abs()[result.known].median() < 0.02


FLAT = [replace(p, image=torch.full_like(p.image, 0.5)) for p in photos_of(slanted)]
ONE_PLACE = [cast(slanted, camera(0.0, degrees))[0] for degrees in (-5, 0, 5)]
FAR_APART = [cast(slanted, camera(side * 2.31, -side * 30.0))[0] for side in (-1, 1)]  # 60 degrees, at (0, 0, 4)
SEEN_BY_BOTH = torch.rand(50, 3) * 0.2 + torch.tensor([-0.1, -0.1, 3.9])


@pytest.mark.parametrize(
    ("photos", "points", "reason"),
    [
        (FLAT, NONE, "confirmed at only 0.0% of the pixels"),
        (ONE_PLACE, NONE, "no other photo sees the same surfaces"),
        (FAR_APART, SEEN_BY_BOTH, "no other photo sees the same surfaces"),
    ],
    ids=["textureless", "from one place", "too far apart"],
)
def test_photos_that_tell_no_depth_have_none_and_the_log_says_why(photos, points, reason, caplog):
    caplog.set_level("DEBUG")
    assert all(result.coverage == 0 for result in depth_maps(photos, points, QUICK))
    assert reason in caplog.text


def test_depth_behind_most_triangulated_points_is_not_trusted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    photos = photos_of(slanted)
    near = torch.cat((torch.rand(40, 2) - 0.5, torch.full((40, 1), 2.5)), dim=1)
    far = torch.cat((torch.rand(40, 2) - 0.5, torch.full((40, 1), 6.0)), dim=1)
    assert depth_maps(photos, torch.cat((near, far[:5])), QUICK)[1].coverage == 0
    assert "triangulated points lie in front of its depth" in caplog.text


def test_two_photos_must_confirm_a_depth_only_where_two_see_the_point() -> None:
    shown = plane_photos(6, 64, 48)
    photos = [shown[0], shown[1], shown[5]]  # the first shares columns 10… with the second, and 50… with the third
    one, two = (depth_maps(photos, NONE, replace(QUICK, agreeing=count))[0] for count in (1, 2))
    assert torch.equal(two.known[:, 10:46], one.known[:, 10:46])
    assert two.known[:, 10:46].float().mean() > 0.8
    assert (two.depth / 4 - 1).abs()[two.known].median() < 0.01


def map_with_islands() -> torch.Tensor:
    depth = torch.full((12, 16), torch.nan)
    depth[:, :8] = torch.linspace(2.0, 2.6, 8)  # a slanted surface: neighbours differ by 4 %
    depth[4:6, 3:5] = 5.0  # an island of four in it
    depth[8, 12] = 2.0  # one of its own
    return depth


@pytest.mark.parametrize(("fewest", "count"), [(0, 0), (1, 0), (2, 1), (4, 1), (5, 5), (1000, 97)])
def test_islands_of_fewer_pixels_are_found(fewest: int, count: int) -> None:
    result = speckles(map_with_islands(), fewest, 0.05)
    assert int(result.sum()) == count


def test_what_is_alike_depends_on_the_ratio_of_depths_and_without_scipy_all_is_kept(monkeypatch):
    depth = map_with_islands()
    assert torch.equal(speckles(depth, 5, 0.05), speckles(1e-6 * depth, 5, 0.05))
    assert int(speckles(depth, 13, 0.02).sum()) == 97  # each column is an island of twelve
    monkeypatch.setattr(consistency, "missing", lambda *_: "scipy")
    assert not speckles(map_with_islands(), 5, 0.05).any()


# ---- completed depth: planes go on, surfaces end where colours change, outliers do not count
H, W = 24, 32
V, U = torch.meshgrid(torch.arange(H).double(), torch.arange(W).double(), indexing="ij")
PLANE = 0.5 + 0.004 * U - 0.006 * V


def grey(values: Tensor) -> Tensor:
    return values[..., None].expand(-1, -1, 3).float()


def complete(known: Tensor, image: Tensor | None = None) -> Tensor:
    return completed(known, torch.ones(H, W), grey(torch.full((H, W), 0.5)) if image is None else image)


def test_a_plane_is_completed_inside_and_continued_outside_whatever_an_outlier_says() -> None:
    known = PLANE.clone()
    known[8:16, 10:20] = torch.nan
    known[:, 26:] = torch.nan
    error = (complete(known) / PLANE - 1).abs()
    assert error[:, :26].max() < 1e-3
    assert error.max() < 0.03
    known = PLANE.clone()
    known[U % 3 > 0] = torch.nan
    wrong = known.clone()
    wrong[12, 15] = 3.0
    assert (complete(wrong) - complete(known)).abs().max() < 0.01


def test_two_surfaces_meet_where_the_colour_changes_and_one_known_pixel_is_the_depth_of_all() -> None:
    right = U >= 18
    image = grey(right.double())
    known = torch.where(right, 1.0, 0.2).double()
    known[:, 6:26] = torch.nan  # the edge itself is not known
    result = complete(known, image)
    assert (result[:, :17] - 0.2).abs().max() < 0.01
    assert (result[:, 19:] - 1.0).abs().max() < 0.01
    for h, w in ((1, 1), (1, 2), (2, 2), (2, 5), (H, W)):
        known = torch.full((h, w), torch.nan, dtype=torch.float64)
        known[h // 2, w // 2] = 0.25
        result = completed(known, torch.ones(h, w), torch.rand(h, w, 3))
        assert torch.allclose(result, torch.tensor(0.25, dtype=torch.float64), rtol=1e-6)


# ---- the cost volume and its smoothing
def test_the_better_half_of_the_photos_decides_and_the_true_plane_costs_next_to_nothing() -> None:
    first, second, third = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(3))
    inverse_depths = torch.tensor([1 / 8, 1 / 4, 1 / 3])
    each = torch.stack([cost_volume(first, [other], inverse_depths, 5) for other in (second, third, first, third)])
    found = cost_volume(first, [second, third, first, third], inverse_depths, 5)
    assert torch.allclose(found, each.sort(0).values[:2].mean(0))
    for image in (second.image, 0.5 * second.image + 0.2):
        cost = cost_volume(first, [Grey(second.camera, image)], inverse_depths, 5)
        seen = cost[5:-5, 20:-5]
        assert seen[..., 1].mean() < 0.03
        assert (seen[..., 0] > seen[..., 1]).float().mean() > 0.95
        assert torch.equal(cost[:, :10, 1], torch.full_like(cost[:, :10, 1], 0.5))  # not in the other photo


@pytest.mark.parametrize("window", [3, 7])
def test_the_compiled_sweep_is_the_readable_one(window: int, monkeypatch: pytest.MonkeyPatch) -> None:
    first, *others = (Grey(p.camera, p.image.mean(2)) for p in plane_photos(4, 77, 71))
    inverse_depths = torch.tensor([1 / 8, 1 / 4.1, 1 / 3, 3.0, *torch.linspace(0.1, 0.5, 6)])
    compiled = cost_volume(first, others, inverse_depths, window)
    monkeypatch.setattr(cost.native, "available", lambda: False)
    difference = (cost_volume(first, others, inverse_depths, window) - compiled).abs()
    assert difference.median() < 1e-6
    assert difference.max() < 0.01  # where there is next to no contrast


@pytest.mark.parametrize("shape", [(5, 7, 16), (9, 4, 21), (1, 6, 3)])
def test_the_compiled_smoothing_is_the_readable_one(shape, monkeypatch):
    volume, image = torch.rand(shape), torch.rand(shape[:2])
    compiled = smooth(volume, image, 0.08, 0.6)
    assert torch.equal(smooth(volume.transpose(0, 1).contiguous().transpose(0, 1), image, 0.08, 0.6), compiled)
    monkeypatch.setattr(cost.native, "available", lambda: False)
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
