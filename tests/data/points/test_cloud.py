"""Initial clouds: which points, made by whom, said honestly; densification exact on planes; the choice that auto makes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.view import Photo
from clear_strategies.data.capture import SfmPoints
from clear_strategies.data.ply import write_points
from clear_strategies.data.points.cloud import (
    CloudSettings,
    common_box,
    densify,
    from_tracks,
    initial_cloud,
    random_cloud,
)
from clear_strategies.data.points.sift import project
from clear_strategies.data.prepare import ViewSettings, split
from clear_strategies.data.readers import llff
from clear_strategies.data.scene import PointCloud
from clear_strategies.errors import DataError
from rasterizers.interface import Camera
from tests.data.points.test_sift import camera, plane_photos


def photo(x: float = 0.0, size: int = 40) -> Photo:
    """A camera at (x, 0, 0) looking along z with f = 100 px; each pixel has a colour of its own."""
    ramp = torch.linspace(0, 1, size)
    image = torch.stack((ramp.expand(size, size), ramp[:, None].expand(size, size), torch.zeros(size, size)), dim=-1)
    return Photo(camera(x, size, size), image)


def flat_photos() -> list[Photo]:
    return [replace(p, image=torch.full_like(p.image, 0.5)) for p in (photo(0.0), photo(0.5))]


def cloud_of(means: Tensor) -> PointCloud:
    return PointCloud(means, torch.rand(len(means), 3, generator=torch.Generator().manual_seed(0)), "test points")


def sfm() -> SfmPoints:
    """Point 0 seen by frames 1, 2, 3; point 1 by 1 (twice) and 9; point 2 by 2 and 3."""
    sightings = [(0, 1), (0, 2), (0, 3), (1, 1), (1, 1), (1, 9), (2, 2), (2, 3)]
    point, seen_by = torch.tensor(sightings).T
    return SfmPoints(torch.arange(9.0).view(3, 3), torch.eye(3), point, seen_by, "all of sparse/0")


class TestTracks:
    @pytest.mark.parametrize(
        ("ids", "min_views", "kept"),
        [([1, 2, 3], 2, [0, 2]), ([1, 2, 3], 3, [0]), ([1, 9], 2, [1]), ([1], 1, [0, 1]), ([1, 2, 3], 1, [0, 1, 2])],
    )
    def test_points_seen_by_enough_training_views_stay(self, ids: list[int], min_views: int, kept: list[int]) -> None:
        cloud = from_tracks(sfm(), ids, min_views)
        assert torch.equal(cloud.means, sfm().means[kept])
        assert torch.equal(cloud.colors, sfm().colors[kept])

    def test_filtered_or_not_they_are_said_to_have_seen_test_views(self) -> None:
        for init in ("sfm", "sfm_train"):
            cloud = initial_cloud(CloudSettings(init=init, densify=False), [photo()], sfm=sfm(), train_ids=[1, 2, 3])
            assert cloud.saw_test_views == "yes"
            assert "all of sparse/0" in cloud.source

    def test_points_that_cannot_be_had_get_one_line(self) -> None:
        with pytest.raises(DataError, match="none is seen by 4 of the 3 training views"):
            from_tracks(sfm(), [1, 2, 3], 4)
        none = torch.zeros(0, dtype=torch.long)
        with pytest.raises(DataError, match="come without tracks"):
            from_tracks(replace(sfm(), point=none, seen_by=none), [1], 1)
        with pytest.raises(DataError, match="there are none, but init=sfm_train"):
            initial_cloud(CloudSettings(init="sfm_train"), [photo()])


class TestRandom:
    def test_points_fill_the_given_box_with_near_grey(self) -> None:
        cloud = random_cloud([photo()], 10_000, seed=0, box=1.3)
        assert cloud.means.shape == (10_000, 3)
        assert 1.25 < float(cloud.means.max()) <= 1.3
        assert -1.3 <= float(cloud.means.min()) < -1.25
        assert (cloud.colors - 0.5).abs().max() <= 0.05
        assert cloud.saw_test_views == "no"
        assert cloud.source == "random: 10,000 points in [-1.3, 1.3]³"

    def test_the_seed_decides(self) -> None:
        one, two, other = (random_cloud([photo()], 10, seed, 1.0).means for seed in (0, 0, 1))
        assert torch.equal(one, two)
        assert not torch.equal(one, other)

    def test_nothing_is_removed_from_or_added_to_random_points(self) -> None:
        assert len(initial_cloud(CloudSettings(init="random", random_points=777, outlier_ratio=0.1), [photo()])) == 777

    def test_cameras_around_an_object_have_the_ball_that_they_all_see_in_common(self) -> None:
        photos = []
        for k in range(8):
            c, s = math.cos(k * math.pi / 4), math.sin(k * math.pi / 4)
            pose = torch.tensor([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 4], [0, 0, 0, 1.0]])
            photos.append(Photo(Camera(pose, 100.0, 100.0, 50.0, 40.0, 100, 80), torch.zeros(80, 100, 3)))
        low, high = common_box(photos)
        half = 4 * math.sin(math.atan(0.4))  # the narrow side: 40 px of 100
        assert torch.allclose(low, torch.full((3,), -half), atol=0.01)
        assert torch.allclose(high, torch.full((3,), half), atol=0.01)

    def test_parallel_cameras_have_a_box_ahead_in_common(self) -> None:
        low, high = common_box([photo(-1.0), photo(1.0)])
        middle = (low + high) / 2
        assert torch.allclose(middle, torch.tensor([0.0, 0, 10]), atol=0.1)
        pixels, depth = project(photo(0.0).camera, middle[None])
        assert depth > 0
        assert torch.allclose(pixels, torch.full((1, 2), 20.0).double(), atol=0.1)

    @given(st.integers(1, 4), st.integers(0, 1000))
    @settings(max_examples=30, deadline=None)
    def test_a_common_box_is_finite_and_has_a_volume(self, count: int, seed: int) -> None:
        g = torch.Generator().manual_seed(seed)
        photos = []
        for _ in range(count):
            rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=g))
            pose = torch.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation * torch.linalg.det(rotation), torch.randn(3, generator=g)
            photos.append(Photo(Camera(pose, 100.0, 100.0, 20.0, 20.0, 40, 40), torch.zeros(40, 40, 3)))
        low, high = common_box(photos)
        assert bool(low.isfinite().all() and high.isfinite().all() and (high > low).all())


class TestDensify:
    @given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.sampled_from((1, 2, 4)))
    @settings(max_examples=20, deadline=None)
    def test_new_points_lie_on_the_plane_of_the_old_ones(self, a: float, b: float, stride: int) -> None:
        """Inverse depth is linear in pixels on the plane z = 5 + a x + b y."""
        view = photo()
        u, v = torch.meshgrid(torch.linspace(0.1, 39.9, 9), torch.linspace(0.1, 39.9, 9), indexing="ij")
        rays = torch.stack(((u - 20) / 100, (v - 20) / 100, torch.ones_like(u)), -1).reshape(-1, 3)
        plane = rays * (5 / (1 - rays[:, :1] * a - rays[:, 1:2] * b))
        cloud = densify(cloud_of(plane), [view], stride)
        new = cloud.means[len(plane) :]
        assert len(new) == (40 // stride) ** 2
        assert torch.equal(cloud.means[: len(plane)], plane)
        pixels, _ = project(view.camera, new)
        hull = ((pixels - 20).abs() < 14.8).all(dim=1)  # at stride 4 not all samples at the border count
        assert torch.allclose(new[hull, 2], 5 + a * new[hull, 0] + b * new[hull, 1], atol=1e-4)
        assert f"densified by {len(new):,}" in cloud.source

    def test_a_new_point_has_the_colour_of_its_pixel(self) -> None:
        view = photo()
        cloud = densify(cloud_of(torch.randn(50, 3) * 0.2 + torch.tensor([0, 0, 5.0])), [view], 1)
        pixels, _ = project(view.camera, cloud.means[50:])
        column, row = pixels.long().T
        assert torch.allclose(pixels - pixels.floor(), torch.full_like(pixels, 0.5), atol=1e-3)
        assert torch.allclose(cloud.colors[50:], view.image[row, column], atol=1e-4)

    def test_points_hidden_behind_a_surface_do_not_bend_it(self) -> None:
        u, v = torch.meshgrid(torch.arange(-1, 1, 0.05), torch.arange(-1, 1, 0.05), indexing="ij")
        front = torch.stack((u, v, torch.full_like(u, 5.0)), -1).reshape(-1, 3)
        behind = front * torch.tensor([1, 1, 2.0]) + torch.tensor([0.01, 0.01, 0])
        new = densify(cloud_of(torch.cat((front, behind))), [photo()], 2).means[2 * len(front) :]
        assert torch.allclose(new[:, 2], torch.tensor(5.0), atol=1e-4)

    def test_the_background_gets_no_points(self) -> None:
        view = photo()
        image = view.image.clone()
        image[:, :30] = 1.0
        points = cloud_of(torch.randn(200, 3) * 0.4 + torch.tensor([0, 0, 5.0]))
        new = densify(points, [replace(view, image=image)], 1, background=(1.0, 1.0, 1.0)).means[200:]
        assert len(new) == 10 * 40
        assert bool((project(view.camera, new)[0][:, 0] > 30).all())

    def test_points_on_a_line_are_enough(self) -> None:
        line = torch.stack((torch.linspace(-0.5, 0.5, 30), torch.zeros(30), torch.full((30,), 5.0)), dim=1)
        new = densify(cloud_of(line), [photo()], 2).means[30:]
        assert torch.allclose(new[:, 2], torch.tensor(5.0))

    def test_without_points_in_view_nothing_is_added_and_said(self, caplog: pytest.LogCaptureFixture) -> None:
        cloud = cloud_of(torch.tensor([[0.0, 0, -5]]).repeat(10, 1))
        assert densify(cloud, [photo()], 2) is cloud
        assert "only 0 points project into it" in caplog.text
        assert "added no point" in caplog.text


class TestInitialCloud:
    def test_auto_triangulates_where_it_can(self, caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level("INFO")
        cloud = initial_cloud(CloudSettings(densify=False), plane_photos(3), sfm=sfm(), train_ids=[1, 2, 3])
        assert len(cloud) > 50
        assert cloud.saw_test_views == "no"
        assert "init: auto chose" in caplog.text
        assert "own points unused, test views had a part" in caplog.text

    def test_auto_falls_back_to_random_and_says_so(self, caplog: pytest.LogCaptureFixture) -> None:
        cloud = initial_cloud(CloudSettings(random_points=99), flat_photos(), sfm=sfm())
        assert len(cloud) == 99
        assert cloud.source.startswith("random")
        assert cloud.saw_test_views == "no"
        assert "auto chose random points: only 0 (of 50 that are enough)" in caplog.text

    def test_triangulated_does_not_fall_back(self) -> None:
        with pytest.raises(DataError, match="none could be triangulated from the 2 training LR images"):
            initial_cloud(CloudSettings(init="triangulated"), flat_photos())

    def test_the_same_seed_gives_the_same_cloud(self) -> None:
        one, two = (initial_cloud(CloudSettings(max_points=300), plane_photos(2), seed=3) for _ in range(2))
        assert len(one) == 300
        assert torch.equal(one.means, two.means)
        assert torch.equal(one.colors, two.colors)

    def test_a_given_file_is_read(self, tmp_path: Path) -> None:
        write_points(tmp_path / "fused.ply", cloud_of(torch.rand(5, 3)))
        cloud = initial_cloud(CloudSettings(init="ply", path=str(tmp_path / "fused.ply"), densify=False), [photo()])
        assert len(cloud) == 5
        assert cloud.source == "5 points of fused.ply"
        assert cloud.saw_test_views == "unknown"

    def test_an_empty_file_is_refused(self, tmp_path: Path) -> None:
        write_points(tmp_path / "empty.ply", cloud_of(torch.zeros(0, 3)))
        with pytest.raises(DataError, match="has no points"):
            initial_cloud(CloudSettings(init="ply", path=str(tmp_path / "empty.ply")), [photo()])

    def test_auto_densifies_only_what_is_sparser_than_the_pixel_grid(self, tmp_path: Path) -> None:
        view, file = photo(), tmp_path / "p.ply"
        for count, grows in ((390, True), (410, False)):  # the grid has 20 · 20 = 400
            write_points(file, cloud_of(torch.rand(count, 3) + torch.tensor([-0.5, -0.5, 5])))
            chosen = CloudSettings(init="ply", path=str(file), outlier_neighbours=0)
            assert (len(initial_cloud(chosen, [view])) > count) == grows
            assert len(initial_cloud(replace(chosen, densify=True), [view])) > count
            assert len(initial_cloud(replace(chosen, densify=False), [view])) == count

    def test_outliers_go_before_densification_and_voxels_come_after(self, tmp_path: Path) -> None:
        stray = torch.cat((torch.rand(50, 3) * 0.1 + torch.tensor([0, 0, 5.0]), torch.tensor([[0, 0, 500.0]])))
        write_points(tmp_path / "p.ply", cloud_of(stray))
        chosen = CloudSettings(init="ply", path=str(tmp_path / "p.ply"))
        assert initial_cloud(chosen, [photo()]).means[:, 2].max() < 6
        assert len(initial_cloud(replace(chosen, voxel=1000.0), [photo()])) == 1

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ({"init": "dense"}, "init must be one of auto, .* got 'dense'"),
            ({"init": "ply"}, "init=ply needs a file"),
            ({"densify": "maybe"}, "densify must be true, false or auto, got 'maybe'"),
            ({"stride": 0}, "stride must be at least 1, got 0"),
            ({"max_points": -1}, "max_points must be at least 1, got -1"),
            ({"outlier_neighbours": 1}, "outlier_neighbours must be 0 or at least 2, got 1"),
            ({"outlier_ratio": math.nan}, "outlier_ratio must be finite and > 0, got nan"),
            ({"voxel": 0.0}, "voxel must be finite and > 0, got 0.0"),
            ({"box": math.inf}, "box must be finite and > 0, got inf"),
        ],
    )
    def test_settings_out_of_range_are_named(self, wrong: dict[str, object], message: str) -> None:
        chosen = CloudSettings()
        for name, value in wrong.items():  # past the type checks that only tests have
            object.__setattr__(chosen, name, value)
        with pytest.raises(ValueError, match=message):
            chosen.__post_init__()


def test_fern_is_triangulated_from_three_lr_images(shared_data: Path) -> None:
    """Half the triangulated points lie within 2 % of their depth of one that COLMAP found in all views."""
    capture = llff.read(shared_data / "fern")
    train, _ = split(capture, ViewSettings())
    photos = []
    for frame in train:
        image = images.downsample(images.crop_to_multiple(frame.load(), 8), 8)
        full = replace(frame.camera, width=image.shape[1] * 8, height=image.shape[0] * 8)
        photos.append(Photo(full.scaled(1 / 8), image))
    cloud = initial_cloud(CloudSettings(densify=False), photos, sfm=capture.points)
    assert len(cloud) > 200
    assert cloud.saw_test_views == "no"
    assert capture.points is not None
    distance = torch.cdist(cloud.means, capture.points.means.float()).amin(dim=1)
    depth = project(photos[1].camera, cloud.means)[1]
    assert (distance / depth).median() < 0.02
    assert (distance / depth).quantile(0.9) < 0.06
