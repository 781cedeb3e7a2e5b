"""Pseudo views of a plane are exact; what no photo shows stays unknown, and is continued smoothly."""

from dataclasses import replace

import pytest
import torch

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.cameras import moved_aside
from clear_strategies.geometry.projection import back_project, project, sample_colors
from clear_strategies.geometry.pseudo_views import border_view, continued, pseudo_views
from tests.helpers import planes
from tests.helpers.image_files import noise
from tests.helpers.planes import depth_of

DEPTH = 4.0


def plane(count: int = 3) -> dict[str, Photo]:
    return {f"{i}.png": photo for i, photo in enumerate(planes.plane_photos(count))}


def views_of(photos: dict[str, Photo], depths: dict[str, DepthMap] | None = None, **settings) -> list[Photo]:
    if depths is None:
        depths = {name: depth_of(photo, DEPTH) for name, photo in photos.items()}
    chosen = {"count": 6, "reach": 0.2, "tolerance": 0.02, "max_pixels": 10**6, "background": (0.0,) * 3, "seed": 0}
    return [make() for make in pseudo_views(photos, depths, **{**chosen, **settings})]


@pytest.mark.parametrize("reach", [0.1, 1.2])
def test_a_camera_moved_aside_keeps_its_middle_in_the_middle_and_stays_within_reach(reach):
    generator, camera = torch.Generator().manual_seed(1), planes.camera(0.7)
    aim = back_project(camera, torch.tensor([[50.0, 50.0]]).double(), torch.tensor([DEPTH]).double())
    away = []
    for _ in range(50):
        moved = moved_aside(camera, DEPTH, reach, generator)
        pixel, depth = project(moved, aim)
        assert pixel[0].tolist() == pytest.approx([50, 50], abs=1e-3)
        assert depth[0] > 0
        rotation = moved.world_to_camera[:3, :3]
        assert torch.allclose(rotation @ rotation.T, torch.eye(3), atol=1e-6)
        assert torch.det(rotation) == pytest.approx(1, abs=1e-5)
        away.append(float(torch.linalg.vector_norm(moved.center - camera.center)))
    assert 0.5 * reach * DEPTH < max(away) <= reach * DEPTH


def test_a_plane_is_seen_as_its_photos_show_it():
    photos = plane()
    views = views_of(photos)
    assert len(views) == 6
    for view in views:
        assert view.shown.float().mean() > 0.5
        camera = view.camera
        rays = torch.nonzero(view.shown)
        pixels = rays.flip(1).double() + 0.5
        near, far = (back_project(camera, pixels, torch.full((len(pixels),), z).double()).double() for z in (1.0, 2.0))
        on_plane = near + (far - near) * ((DEPTH - near[:, 2]) / (far - near)[:, 2])[:, None]
        expected = torch.stack([sample_colors(p, project(p.camera, on_plane)[0]) for p in photos.values()])
        inside = torch.stack(
            [((xy := project(p.camera, on_plane)[0]) > 1).all(1) & (xy < torch.tensor([119, 89])).all(1) for p in photos.values()]
        )  # fmt: skip
        error = torch.where(inside, (expected - view.image[view.shown]).abs().amax(-1), torch.inf).amin(0)
        assert error[inside.any(0)].median() < 0.02


def test_a_surface_seen_at_a_grazing_angle_is_known_and_in_its_place():
    slope, photos, depths = 3.7, {}, {}  # the plane z + 3.7 x = 4, tilted by 75 degrees

    def on_plane(camera):
        """Where the rays of the camera's pixels meet the plane."""
        pixels = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width)).flip(1) + 0.5
        near, far = (back_project(camera, pixels, torch.full((len(pixels),), z).double()).double() for z in (1.0, 2.0))
        side = torch.tensor([slope, 0.0, 1.0]).double()
        return near + ((4 - near @ side) / ((far - near) @ side))[:, None] * (far - near)

    def colors(points):
        return (0.5 + 0.4 * torch.sin(points @ torch.tensor([[3.0, -1, 2], [1, 2, -2], [-1, 1, 1]]).double())).float()

    for i, x in enumerate((0.0, 0.4, -0.4)):
        camera = planes.camera(x, 120, 90)
        points, shape = on_plane(camera), (camera.height, camera.width)
        depth = points[:, 2].float().view(shape)
        photo = photos[f"{i}.png"] = Photo(camera, colors(points).view(*shape, 3))
        depths[f"{i}.png"] = depth_of(photo, torch.where((depth > 0) & (depth < 20), depth, torch.nan))
    known = shown = 0
    for view in views_of(photos, depths):
        points = on_plane(view.camera)
        expected = torch.zeros(len(points), dtype=torch.bool)
        for photo in photos.values():
            xy, depth = project(photo.camera, points)
            expected |= (depth > 0) & (depth < 15) & (xy > 1).all(1) & (xy < torch.tensor([119, 89])).all(1)
        expected &= project(view.camera, points)[1] > 0
        at = view.shown.flatten() & expected
        known, shown = known + int(at.sum()), shown + int(expected.sum())
        assert (view.image.view(-1, 3)[at] - colors(points[at])).abs().mean() < 0.01
    assert known > 0.97 * shown, (known, shown)


def test_reduced_depth_is_that_in_the_middle_of_a_block_and_of_the_nearer_surface_at_an_edge():
    x = torch.arange(24).expand(24, 24)
    for factor in (2, 3, 4):
        depth = depth_of(Photo(planes.camera(0, 24, 24), torch.zeros(24, 24, 3)), 4 + 0.02 * x).reduced(factor).depth
        assert torch.allclose(depth[0], 4 + 0.02 * (factor * torch.arange(24 // factor) + (factor - 1) / 2))
    edge = depth_of(Photo(planes.camera(0, 24, 24), torch.zeros(24, 24, 3)), torch.where(x < 13, 4.0, 8.0)).reduced(2)
    assert set(edge.depth.unique().tolist()) == {4.0, 8.0}


def test_without_two_photos_with_depth_there_are_none_and_large_ones_are_reduced():
    photos = plane(2)
    one = {"0.png": depth_of(photos["0.png"], DEPTH), "1.png": depth_of(photos["1.png"], torch.nan)}
    assert views_of(photos, one) == views_of(photos, {}) == []
    view = views_of(plane(), max_pixels=3_000)[0]
    camera = view.camera
    assert (camera.width, camera.height, camera.fx) == (60, 45, 50.0)
    assert view.shown.float().mean() > 0.5


def test_a_depth_that_no_photo_vouches_for_and_pixels_beside_the_background_or_a_mask_give_no_colour():
    photos = plane(2)
    apart = {"0.png": depth_of(photos["0.png"], 4.0), "1.png": depth_of(photos["1.png"], 2.0)}
    view = views_of(photos, apart, reach=1e-6)[0]
    # Seen from camera 0, the nearer surface of photo 1 hides that of photo 0, which does not confirm it.
    row, column = torch.nonzero(view.shown).unbind(1)
    centers, depth = torch.stack((column, row), 1).double() + 0.5, torch.full((len(row),), 2.0).double()
    pixels, _ = project(photos["1.png"].camera, back_project(view.camera, centers, depth))
    error = (sample_colors(photos["1.png"], pixels) - view.image[row, column]).abs().amax(1)
    hidden = (pixels[:, 0] > 2) & (pixels[:, 0] < 118)
    assert hidden.any()
    assert error[hidden].median() < 0.02
    right = torch.arange(120)[None, :, None] >= 60
    white = {name: Photo(p.camera, torch.where(right, 1.0, p.image)) for name, p in plane(2).items()}
    known, on_black = (views_of(white, reach=1e-6, background=color)[0].shown for color in ((1.0,) * 3, (0.0,) * 3))
    assert not known[:, 71:].any()  # photo 1 stands 10 px aside and shows the surface up to there
    assert known[:, 5:45].float().mean() > 0.9
    assert on_black[5:-5, 65:110].all()
    masked = {name: replace(p, shown=~right[..., 0].expand(90, 120)) for name, p in white.items()}
    assert torch.equal(views_of(masked, reach=1e-6)[0].shown, known)


@pytest.mark.parametrize("max_pixels", [10**6, 3_000])
def test_a_border_view_shows_its_photo_in_the_middle_of_a_wider_field(max_pixels):
    photo = planes.plane_photos(1)[0]
    photo = replace(photo, transparency=torch.rand(photo.image.shape[:2], generator=torch.Generator().manual_seed(0)))
    wide = border_view(photo, field=1.3, max_pixels=max_pixels)
    c, (column, row) = wide.camera, (int(wide.shown.any(0).sum()), int(wide.shown.any(1).sum()))
    assert (c.width, c.height) == (pytest.approx(1.3 * column, abs=2), pytest.approx(1.3 * row, abs=2))
    assert bool(wide.shown.sum() == column * row)
    if max_pixels == 10**6:
        assert torch.equal(wide.image[wide.shown], photo.image.reshape(-1, 3))
        assert torch.equal(wide.transparency[wide.shown], photo.transparency.flatten())
    assert not wide.image[~wide.shown].any()
    assert not wide.transparency[~wide.shown].any()
    point = torch.tensor([[0.3, -0.2, DEPTH]], dtype=torch.float64)
    (in_wide,), (in_photo,) = (project(camera, point)[0] for camera in (c, photo.camera))
    y, x = (int(axis.nonzero()[0]) for axis in (wide.shown.any(1), wide.shown.any(0)))
    scale = column / photo.camera.width
    assert in_wide.tolist() == pytest.approx((in_photo * scale + torch.tensor([x, y])).tolist(), abs=1e-4)


def test_known_pixels_stay_and_unknown_ones_are_not_read():
    image = noise(0, 37, 50)
    for known in (torch.ones(37, 50, dtype=torch.bool), torch.zeros(37, 50, dtype=torch.bool)):
        assert torch.equal(continued(image, known), image)
    known = torch.rand(image.shape[:2], generator=torch.Generator().manual_seed(1)) > 0.6
    filled = continued(image, known)
    assert torch.equal(filled[known], image[known])
    assert torch.equal(continued(torch.where(known[..., None], image, torch.nan), known), filled)


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (9, 1), (2, 3), (37, 50), (64, 64)])
def test_one_known_pixel_fills_a_picture_of_any_size_with_its_colour(shape):
    known = torch.zeros(shape, dtype=torch.bool)
    known[shape[0] // 2, shape[1] // 2] = True
    image = noise(0, *shape)
    assert torch.allclose(continued(image, known), image[known].expand(*shape, 3), atol=1e-6)


def test_a_hole_has_colours_between_those_around_it_without_an_edge_and_nothing_sharp_far_inside():
    ramp = torch.linspace(0, 1, 64)[None, :, None].expand(64, 64, 3)
    known = torch.ones(64, 64, dtype=torch.bool)
    known[20:44, 20:44] = False
    filled = continued(ramp, known)
    inside = filled[20:44, 20:44]
    assert inside.min() >= ramp[0, 18, 0]
    assert inside.max() <= ramp[0, 45, 0]
    assert (inside - ramp[20:44, 20:44]).abs().max() < 0.15
    assert (filled[:, 1:] - filled[:, :-1]).abs().max() < 0.1
    image = noise(0, 64, 128)
    known = torch.arange(128).expand(64, 128) < 64
    filled = continued(image, known)
    near, far = (filled[:, a:b].std(dim=0).mean() for a, b in ((64, 66), (110, 128)))
    assert far < 0.3 * near
