"""Pseudo views of a plane are exact; what is hidden, seen by no photo or beside the background stays unknown."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from clear_strategies.core.view import DepthMap, Photo
from clear_strategies.geometry.projection import back_project, project, sample_colors
from clear_strategies.geometry.pseudo_views import PseudoView, border_views, moved_aside, pseudo_views
from tests.helpers import planes

DEPTH = 4.0


def depth_of(photo: Photo, depth: float | Tensor = DEPTH) -> DepthMap:
    values = torch.as_tensor(depth).expand(photo.camera.height, photo.camera.width).clone()
    return DepthMap(values, values.isfinite().float())


def of_planes(
    count: int = 3, depths: dict[str, DepthMap] | None = None, **settings
) -> tuple[dict[str, Photo], list[PseudoView]]:
    photos = {f"{i}.png": photo for i, photo in enumerate(planes.plane_photos(count))}
    if depths is None:
        depths = {name: depth_of(photo) for name, photo in photos.items()}
    chosen = {"count": 6, "reach": 0.2, "tolerance": 0.02, "max_pixels": 10**6, "background": (0.0,) * 3, "seed": 0}
    return photos, pseudo_views(photos, depths, **{**chosen, **settings})


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
    photos, made = of_planes()
    assert len(made) == 6
    for view in made:
        assert view.known.float().mean() > 0.5
        camera = view.photo.camera
        rays = torch.nonzero(view.known)
        pixels = rays.flip(1).double() + 0.5
        near, far = (back_project(camera, pixels, torch.full((len(pixels),), z).double()).double() for z in (1.0, 2.0))
        on_plane = near + (far - near) * ((DEPTH - near[:, 2]) / (far - near)[:, 2])[:, None]
        expected = torch.stack([sample_colors(p.image, project(p.camera, on_plane)[0]) for p in photos.values()])
        inside = torch.stack(
            [((xy := project(p.camera, on_plane)[0]) > 1).all(1) & (xy < torch.tensor([119, 89])).all(1) for p in photos.values()]
        )  # fmt: skip
        error = torch.where(inside, (expected - view.photo.image[view.known]).abs().amax(-1), torch.inf).amin(0)
        assert error[inside.any(0)].median() < 0.02


def test_the_same_seed_makes_the_same_views_and_another_seed_others():
    first, same, other = (of_planes(seed=seed)[1] for seed in (0, 0, 1))
    assert all(torch.equal(a.photo.image, b.photo.image) for a, b in zip(first, same, strict=True))
    assert not torch.equal(first[0].photo.image, other[0].photo.image)


def test_without_two_photos_with_depth_there_are_none():
    photos = {f"{i}.png": photo for i, photo in enumerate(planes.plane_photos(2))}
    one = {"0.png": depth_of(photos["0.png"]), "1.png": depth_of(photos["1.png"], torch.nan)}
    assert of_planes(2, one)[1] == []
    assert of_planes(2, {})[1] == []


def test_a_depth_that_no_photo_vouches_for_gives_no_colour():
    photos = {f"{i}.png": photo for i, photo in enumerate(planes.plane_photos(2))}
    apart = {"0.png": depth_of(photos["0.png"], 4.0), "1.png": depth_of(photos["1.png"], 2.0)}
    made = of_planes(2, apart, reach=1e-6)[1]
    # Seen from camera 0, the nearer surface of photo 1 hides that of photo 0, which does not confirm it.
    view = made[0]
    row, column = torch.nonzero(view.known).unbind(1)
    centers, depth = torch.stack((column, row), 1).double() + 0.5, torch.full((len(row),), 2.0).double()
    pixels, _ = project(photos["1.png"].camera, back_project(view.photo.camera, centers, depth))
    error = (sample_colors(photos["1.png"].image, pixels) - view.photo.image[row, column]).abs().amax(1)
    hidden = (pixels[:, 0] > 2) & (pixels[:, 0] < 118)
    assert hidden.any()
    assert error[hidden].median() < 0.02


def test_pixels_beside_the_background_give_no_colour():
    photos = {f"{i}.png": photo for i, photo in enumerate(planes.plane_photos(2))}
    white = {
        name: Photo(p.camera, torch.where(torch.arange(120)[None, :, None] < 60, p.image, 1.0))
        for name, p in photos.items()
    }
    chosen = {"count": 2, "reach": 1e-6, "tolerance": 0.02, "max_pixels": 10**6, "seed": 0}
    depths = {name: depth_of(p) for name, p in white.items()}
    kept = pseudo_views(white, depths, background=(1.0, 1.0, 1.0), **chosen)
    assert not kept[0].known[:, 71:].any()  # photo 1 stands 10 px aside and shows the surface up to there
    assert kept[0].known[:, 5:45].float().mean() > 0.9
    assert pseudo_views(white, depths, background=(0.0, 0.0, 0.0), **chosen)[0].known[5:-5, 65:110].all()


def test_large_photos_are_reduced_and_still_show_the_plane():
    _, made = of_planes(max_pixels=3_000)
    camera = made[0].photo.camera
    assert (camera.width, camera.height, camera.fx) == (60, 45, 50.0)
    assert made[0].known.float().mean() > 0.5


@pytest.mark.parametrize("max_pixels", [10**6, 3_000])
def test_a_border_view_shows_its_photo_in_the_middle_of_a_wider_field(max_pixels):
    photo = planes.plane_photos(1)[0]
    (wide,) = border_views([photo], field=1.3, max_pixels=max_pixels)
    c, (column, row) = wide.photo.camera, (int(wide.known.any(0).sum()), int(wide.known.any(1).sum()))
    assert (c.width, c.height) == (pytest.approx(1.3 * column, abs=2), pytest.approx(1.3 * row, abs=2))
    assert bool(wide.known.sum() == column * row)
    if max_pixels == 10**6:
        assert torch.equal(wide.photo.image[wide.known], photo.image.reshape(-1, 3))
    assert not wide.photo.image[~wide.known].any()
    point = torch.tensor([[0.3, -0.2, DEPTH]], dtype=torch.float64)
    (there,), (here,) = (project(camera, point)[0] for camera in (c, photo.camera))
    y, x = (int(axis.nonzero()[0]) for axis in (wide.known.any(1), wide.known.any(0)))
    scale = column / photo.camera.width
    assert there.tolist() == pytest.approx((here * scale + torch.tensor([x, y])).tolist(), abs=1e-4)


def test_a_border_view_is_as_transparent_as_its_photo():
    photo = planes.plane_photos(1)[0]
    photo = replace(photo, transparency=torch.rand(photo.image.shape[:2], generator=torch.Generator().manual_seed(0)))
    (wide,) = border_views([photo], field=1.3, max_pixels=10**6)
    assert torch.equal(wide.photo.transparency[wide.known], photo.transparency.flatten())
    assert not wide.photo.transparency[~wide.known].any()
