"""Initial clouds: every choice of `init`, the order of the steps, and refused settings."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clear_strategies import DataError, Photo
from clear_strategies.data.cloud import CloudSettings, from_tracks, initial_points, random_cloud
from clear_strategies.data.ply import write_points
from clear_strategies.data.readers import colmap
from clear_strategies.data.view_settings import ViewSettings, split
from clear_strategies.geometry import StereoSettings, depth_maps
from clear_strategies.geometry.projection import project
from tests.helpers.planes import photo, plane_photos, sfm


def colored(means: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return means, torch.full_like(means, 0.5)


def flat_photos() -> list[Photo]:
    return [replace(p, image=torch.full_like(p.image, 0.5)) for p in (photo(0.0), photo(0.5))]


def test_auto_triangulates_where_it_can_then_takes_stereo_then_random_points(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG")
    cloud = initial_points(CloudSettings(densify=False), plane_photos(3), sfm=sfm(), train_ids=[1, 2, 3]).cloud
    assert len(cloud) > 50
    assert cloud.uses_test_views == "no"
    assert "init: auto chose" in caplog.text
    assert "does not use the scene's own points" in caplog.text
    found = initial_points(CloudSettings(stereo=StereoSettings(max_planes=64)), plane_photos(3, 64, 48))
    assert len(found.depths) == 3
    assert "dense stereo between the 3 photos (depth known at" in found.cloud.source
    assert caplog.text.count("init: auto chose") == 2
    assert ((found.cloud.means[:, 2] / 4 - 1).abs() < 0.03).float().mean() > 0.95
    cloud = initial_points(CloudSettings(random_points=99), flat_photos(), sfm=sfm()).cloud
    assert len(cloud) == 99
    assert cloud.source.startswith("random")
    assert cloud.uses_test_views == "no"
    assert "auto chose random points: the training LR images give only 0 (data.cloud.enough: 50)" in caplog.text
    chosen = CloudSettings(enough=2, densify=False, outlier_neighbours=0)
    cloud = initial_points(chosen, flat_photos(), sfm=sfm(), train_ids=[1, 2, 3], sfm_is_train=True).cloud
    assert torch.equal(cloud.means, sfm().means[[0, 2]])  # those that two views observe
    assert cloud.uses_test_views == "no"


@pytest.mark.parametrize(
    ("compare", "hr_is_photo", "size"), [("auto", True, (72, 96)), ("hr", False, (36, 48)), ("lr", True, (36, 48))]
)
def test_stereo_at_hr_keeps_its_size_for_photos_and_that_of_lr_for_sr_images(compare, hr_is_photo, size) -> None:
    hr = plane_photos(3, 96, 72)
    lr = [photo.reduced(2) for photo in hr]
    settings = CloudSettings(init="stereo", compare=compare, stereo=StereoSettings(max_planes=64))
    found = initial_points(settings, lr, hr=hr, hr_is_photo=hr_is_photo)
    assert [tuple(depth.depth.shape) for depth in found.depths] == [size] * 3
    known = torch.cat([depth.depth[depth.known] for depth in found.depths])
    assert ((known / 4 - 1).abs() < 0.03).float().mean() > 0.95


def test_sr_images_are_compared_of_few_photos_and_not_of_an_object_before_a_plain_background(monkeypatch) -> None:
    hr = plane_photos(6, 64, 48)
    lr, compared = [photo.reduced(2) for photo in hr], []

    def recorded(photos, *arguments):
        compared.append(photos[0].camera.width)
        return depth_maps(photos, *arguments)

    monkeypatch.setattr("clear_strategies.data.cloud.depth_maps", recorded)
    settings = CloudSettings(init="stereo", densify=False)
    for n in (5, 6):
        initial_points(settings, lr[:n], hr=hr[:n])
    assert compared == [32, 64, 32]
    for one in lr[:3]:
        one.image[:12] = 1.0
    initial_points(settings, lr[:3], hr=hr[:3], background=(1.0, 1.0, 1.0))
    assert compared == [32, 64, 32, 32]


@pytest.mark.parametrize(
    ("init", "photos", "problem"),
    [
        ("stereo", [photo(0.0), photo(0.0)], "stereo confirms no depth in any of the 2 training LR images"),
        ("triangulated", flat_photos(), "none could be triangulated from the 2 training LR images"),
    ],
)
def test_what_is_asked_for_does_not_fall_back(init, photos, problem) -> None:
    with pytest.raises(DataError, match=problem):
        initial_points(CloudSettings(init=init), photos)


def test_a_given_file_is_read_and_refused_without_points(tmp_path: Path) -> None:
    file = tmp_path / "fused.ply"
    chosen = CloudSettings(init="ply", path=str(file), densify=False)
    write_points(file, *colored(torch.rand(5, 3)))
    found = initial_points(chosen, [photo()])
    assert found.depths == ()
    assert len(found.cloud) == 5
    assert found.cloud.source == "5 points of fused.ply"
    assert found.cloud.uses_test_views == "unknown"
    write_points(file, *colored(torch.zeros(0, 3)))
    with pytest.raises(DataError, match="has no points"):
        initial_points(chosen, [photo()])


def test_auto_densifies_only_what_is_sparser_than_the_pixel_grid_after_outliers_are_removed(tmp_path: Path) -> None:
    view, file = photo(), tmp_path / "p.ply"
    for count, grows in ((390, True), (410, False)):  # the grid has 20 · 20 = 400
        write_points(file, *colored(torch.rand(count, 3) + torch.tensor([-0.5, -0.5, 5])))
        chosen = CloudSettings(init="ply", path=str(file), outlier_neighbours=0)
        assert (len(initial_points(chosen, [view]).cloud) > count) == grows
        assert len(initial_points(replace(chosen, densify=True), [view]).cloud) > count
        assert len(initial_points(replace(chosen, densify=False), [view]).cloud) == count
    stray = torch.cat((torch.rand(50, 3) * 0.1 + torch.tensor([0, 0, 5.0]), torch.tensor([[0, 0, 500.0]])))
    write_points(tmp_path / "p.ply", *colored(stray))
    chosen = CloudSettings(init="ply", path=str(tmp_path / "p.ply"))
    assert initial_points(chosen, [photo()]).cloud.means[:, 2].max() < 6


def test_fern_is_triangulated_from_three_lr_images(shared_data: Path) -> None:
    """Half the triangulated points lie within 2 % of their depth of one that COLMAP found in all views."""
    capture = colmap.read(shared_data / "fern")
    train, _ = split(capture, ViewSettings(train=3, test_every=8))
    whole = [frame.load().cropped(8) for frame in train]
    photos = [photo.resized(photo.camera.scaled(1 / 8), "bicubic") for photo in whole]
    chosen = CloudSettings(init="triangulated", densify=False)
    cloud = initial_points(chosen, photos, sfm=capture.points).cloud
    assert len(cloud) > 200
    assert cloud.uses_test_views == "no"
    distance = torch.cdist(cloud.means, capture.points.means.float()).amin(dim=1)
    depth = project(photos[1].camera, cloud.means)[1]
    assert (distance / depth).median() < 0.02
    assert (distance / depth).quantile(0.9) < 0.06


@pytest.mark.parametrize(
    ("ids", "min_views", "kept"),
    [([1, 2, 3], 2, [0, 2]), ([1, 2, 3], 3, [0]), ([1, 9], 2, [1]), ([1], 1, [0, 1]), ([1, 2, 3], 1, [0, 1, 2])],
)
def test_points_observed_by_enough_training_views_are_kept(ids: list[int], min_views: int, kept: list[int]) -> None:
    cloud = from_tracks(sfm(), ids, min_views)
    assert torch.equal(cloud.means, sfm().means[kept])
    assert torch.equal(cloud.colors, sfm().colors[kept])


def test_missing_points_are_refused_and_sfm_points_are_marked_as_using_test_views() -> None:
    with pytest.raises(DataError, match="none is observed by 4 of the 3 training views"):
        from_tracks(sfm(), [1, 2, 3], 4)
    none = torch.zeros(0, dtype=torch.long)
    with pytest.raises(DataError, match="come without tracks"):
        from_tracks(replace(sfm(), track_point=none, track_image=none), [1], 1)
    for init in ("sfm", "sfm_train"):
        cloud = initial_points(CloudSettings(init=init, densify=False), [photo()], sfm=sfm(), train_ids=[1, 2, 3]).cloud
        assert cloud.uses_test_views == "yes"
        assert "all of sparse/0" in cloud.source


def test_points_fill_the_given_box_with_near_grey_and_the_same_seed_gives_the_same_cloud() -> None:
    cloud = random_cloud([photo()], 10_000, seed=0, box=1.3)
    assert cloud.means.shape == (10_000, 3)
    assert 1.25 < float(cloud.means.max()) <= 1.3
    assert -1.3 <= float(cloud.means.min()) < -1.25
    assert (cloud.colors - 0.5).abs().max() <= 0.05
    assert cloud.uses_test_views == "no"
    assert cloud.source == "random: 10,000 points in [-1.3, 1.3]³"
    one, other = (random_cloud([photo()], 10_000, seed, 1.3).means for seed in (0, 1))
    assert torch.equal(one, cloud.means)
    assert not torch.equal(other, cloud.means)
    settings = CloudSettings(init="random", random_points=1_000, max_points=300)
    one, two = (initial_points(settings, [photo()], seed=3).cloud for _ in range(2))
    assert len(one) == 300
    assert torch.equal(one.means, two.means)
    assert torch.equal(one.colors, two.colors)
