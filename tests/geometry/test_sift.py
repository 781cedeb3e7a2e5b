"""Triangulation: a textured plane at a known depth, single points by hand, and each filter on its own."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies.core.view import Photo
from clear_strategies.geometry import sift
from clear_strategies.geometry.projection import project, sample_colors
from clear_strategies.geometry.sift import Features, Pairs, TriangulationSettings, match, one_per_track, triangulate
from rasterizers.interface import Camera
from tests.helpers.planes import camera, plane_photos


@pytest.mark.parametrize("count", [2, 3])
def test_a_plane_is_found_where_it_is(count: int) -> None:
    photos = plane_photos(count)
    cloud = triangulate(photos)
    assert len(cloud) > 100
    assert (cloud.means[:, 2] - 4).abs().median() < 0.02
    assert (cloud.means[:, 2] - 4).abs().quantile(0.95) < 0.15
    assert cloud.uses_test_views == "no"
    assert f"the {count} photos" in cloud.source
    # The colour is the texture's at that place.
    pixels, _ = project(photos[0].camera, cloud.means)
    inside = (pixels[:, 0] < 120) & (pixels[:, 0] > 0)
    assert torch.allclose(cloud.colors[inside], sample_colors(photos[0], pixels[inside]), atol=0.1)


def test_a_point_seen_by_three_views_is_one_point_and_of_too_many_features_the_strongest_are_taken() -> None:
    pairwise = sum(len(triangulate([a, b])) for a, b in zip(plane_photos(3), plane_photos(3)[1:], strict=False))
    assert len(triangulate(plane_photos(3))) < pairwise
    photo = plane_photos(1)[0]
    every = sift.find_features(photo, TriangulationSettings(max_features=None))
    some = sift.find_features(photo, TriangulationSettings(max_features=50))
    assert 50 <= len(some.pixels) < len(every.pixels)  # OpenCV keeps all that are as strong as the last
    assert len(some.pixels) < 60
    result = {tuple(pixel) for pixel in every.pixels.tolist()}
    assert all(tuple(pixel) in result for pixel in some.pixels.tolist())


def test_flat_images_one_photo_and_rays_from_one_centre_give_no_point() -> None:
    flat = [Photo(camera(0.1 * i), torch.full((100, 100, 3), 0.5)) for i in range(3)]
    for photos in (flat[:1], flat, plane_photos(1)):
        cloud = triangulate(photos)
        assert cloud.means.shape == cloud.colors.shape == (0, 3)
    pixel = torch.tensor([[60.0, 50.0]], dtype=torch.float64)
    assert not sift.triangulate_pair(camera(0), camera(0), pixel, pixel, TriangulationSettings())[2].any()


def triangulated(x: tuple[float, float], y: tuple[float, float], **limits: float) -> tuple[list[float], float, bool]:
    """Cameras at x = 0 and x = 1; (point, angle, accepted)."""
    settings = TriangulationSettings(**limits)  # type: ignore[arg-type]
    pixels = (torch.tensor([p], dtype=torch.float64) for p in (x, y))
    points, angle, good = sift.triangulate_pair(camera(0), camera(1), *pixels, settings)
    return points[0].tolist(), float(angle[0]), bool(good[0])


def test_two_rays_meet_where_they_should() -> None:
    # (0.5, 0, 5) lies at 50 + 100 · 0.5 / 5 = 60 and at 50 - 10 = 40; half the angle is atan(0.5 / 5).
    point, angle, good = triangulated((60, 50), (40, 50))
    assert point == pytest.approx([0.5, 0, 5], abs=1e-6)  # kornia before 0.9 adds 1e-8 to what it divides by
    assert angle == pytest.approx(2 * math.degrees(math.atan(0.1)))
    assert good


@pytest.mark.parametrize(
    ("x", "y", "limits"),
    [
        ((40, 50), (60, 50), {}),  # behind both cameras
        ((60, 50), (40, 53), {"reprojection": 9.0}),  # 3 px off the epipolar line
        ((60, 50), (40, 53), {"epipolar": 9.0}),  # 1.5 px from the nearest point's images
        ((50.5, 50), (49.5, 50), {"angle": 1.0}),  # 100 away: 0.57 degrees
    ],
)
def test_each_filter_alone_rejects(x: tuple[float, float], y: tuple[float, float], limits: dict[str, float]) -> None:
    assert not triangulated(x, y, **limits)[2]
    loose = {"epipolar": 9.0, "reprojection": 9.0, "angle": 0.1}
    assert triangulated(x, y, **loose)[2] == (x[0] > y[0])


@settings(max_examples=50, deadline=None)
@given(st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(2, 9)), st.floats(-1, 1))
def test_triangulation_inverts_projection(point: tuple[float, float, float], turn: float) -> None:
    turned = torch.eye(4)
    turned[:3, :3] = torch.tensor(
        [[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]]
    )
    turned[:3, 3] = torch.tensor([-1.0, 0.3, 12.0])
    a, b = camera(0), Camera(turned, 90.0, 110.0, 40.0, 60.0, 100, 100)
    world = torch.tensor([point], dtype=torch.float64)
    (x, _), (y, _) = project(a, world), project(b, world)
    result, _, _ = sift.triangulate_pair(a, b, x, y, TriangulationSettings())
    assert torch.allclose(result, world, atol=1e-5)


@pytest.mark.parametrize("center", [(30.5, 20.5), (31.0, 22.0), (40.3, 30.7)])
@pytest.mark.parametrize("enlarge", [1, 2])
def test_a_blob_is_found_at_its_centre(center: tuple[float, float], enlarge: int) -> None:
    """In our pixels, whose centres lie at halves."""
    y, x = torch.meshgrid(torch.arange(60) + 0.5, torch.arange(80) + 0.5, indexing="ij")
    blob = torch.exp(-((x - center[0]) ** 2 + (y - center[1]) ** 2) / 8)
    view = Photo(camera(0, 80, 60), blob[..., None].expand(60, 80, 3))
    result = sift.find_features(view, TriangulationSettings(enlarge=enlarge)).pixels
    assert torch.linalg.vector_norm(result - torch.tensor(center), dim=1).min() < 0.05


def features(*descriptors: tuple[float, ...]) -> Features:
    rows = torch.zeros(len(descriptors), 128)
    rows[:, :2] = torch.tensor(descriptors)
    return Features(torch.zeros(len(rows), 2, dtype=torch.float64), torch.nn.functional.normalize(rows, dim=1))


def test_a_match_is_mutual_and_unambiguous() -> None:
    a = features((1, 0), (0, 1))
    assert match(a, features((0, 1), (1, 0)), 0.85).tolist() == [[0, 1], [1, 0]]
    # Both of a prefer b's first; it prefers a's second.
    assert match(features((1, 0.2), (1, 0)), features((1, 0), (-1, 0)), 0.85).tolist() == [[1, 0]]
    # Two of b are as near as each other.
    assert match(a, features((1, 0.1), (1, -0.1)), 0.85).tolist() == []
    assert match(a, features((1, 0)), 0.85).tolist() == []


def test_tracks_keep_their_widest_pair_and_contradictions_go() -> None:
    # Features 0, 1 in view 0; 2, 3 in view 1; 4 in view 2.
    view = torch.tensor([0, 0, 1, 1, 2])
    pairs = torch.tensor([[0, 2], [2, 4], [0, 4]])
    consistent = Pairs(torch.zeros(3, 3), pairs, torch.tensor([1.0, 3.0, 2.0]))
    assert one_per_track(consistent, view).tolist() == [1]
    # 0 and 1, both in view 0, would be the same point.
    contradictory = Pairs(torch.zeros(2, 3), torch.tensor([[0, 2], [1, 2]]), torch.tensor([1.0, 2.0]))
    assert one_per_track(contradictory, view).tolist() == []
    separate = Pairs(torch.zeros(2, 3), torch.tensor([[0, 2], [1, 3]]), torch.tensor([1.0, 2.0]))
    assert sorted(one_per_track(separate, view).tolist()) == [0, 1]
