"""Splits and sizes: the papers' view indices and pixel counts; what is refused before a photo is decoded."""

import re
from dataclasses import replace

import pytest
import torch

from clear_strategies.core.view import Photo
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.prepare import check_headers, prepare, save_lr
from clear_strategies.data.priors import Bicubic, Images
from clear_strategies.data.view_settings import ViewSettings, lr_size, split, within_limit
from clear_strategies.errors import DataError, SettingError
from rasterizers import Camera
from tests.helpers.captures import POINTS_AT_RANDOM as POINTS
from tests.helpers.captures import alike as capture
from tests.helpers.captures import in_a_row, papers

# ---- splits and sizes: the papers' view indices and pixel counts; what is refused before a photo is decoded
# Training indices among the n photos of some LLFF scenes, and the number of test views: the 3-view protocol of RegNeRF, FSGS,
# CoR-GS and DropGaussian.
LLFF = {
    "fern": (20, [1, 10, 19], 3), "flower": (34, [1, 17, 33], 5), "horns": (62, [1, 30, 61], 8),
    "leaves": (26, [1, 12, 25], 4), "orchids": (25, [1, 12, 23], 4),
}  # fmt: skip
# Photos, those that are not for testing, test views.
MIP360 = {"bicycle": (194, 169, 25), "counter": (240, 210, 30), "stump": (125, 109, 16)}
# Full size, LR = round(full / 8), HR = 4 LR: of all sizes those that round each way.
SIZES = {
    "LLFF": ((4032, 3024), (504, 378), (2016, 1512)),
    "garden": ((5187, 3361), (648, 420), (2592, 1680)),
    "stump": ((4978, 3300), (622, 412), (2488, 1648)),
    "kitchen": ((3115, 2078), (389, 260), (1556, 1040)),
}


def indices(frames: list[Frame]) -> list[int]:
    return [int(frame.name[:4]) for frame in frames]


@pytest.mark.parametrize("scene", LLFF)
def test_llff_trains_and_tests_on_the_papers_views(scene):
    n, expected, n_test = LLFF[scene]
    train, test = split(capture(n), papers())
    assert indices(train) == expected
    assert indices(test) == list(range(0, n, 8))
    assert len(test) == n_test


@pytest.mark.parametrize("scene", MIP360)
def test_mip360_trains_on_24_views_evenly_spaced_in_the_pool(scene):
    n, n_pool, n_test = MIP360[scene]
    train, test = split(capture(n), papers(train=24))
    pool = [i for i in range(n) if i % 8]
    assert (len(pool), len(test), len(train)) == (n_pool, n_test, 24)
    assert indices(train)[0] == pool[0]
    assert indices(train)[-1] == pool[-1]
    steps = [pool.index(b) - pool.index(a) for a, b in zip(indices(train), indices(train)[1:], strict=False)]
    assert max(steps) - min(steps) <= 1


@pytest.mark.parametrize("scene", SIZES)
def test_photos_get_the_published_sizes(scene):
    full, lr, hr = SIZES[scene]
    photo = Camera(torch.eye(4), 1.0, 1.0, 1.0, 1.0, *full)
    assert lr_size(photo, papers(shrink=2, sizes="round")) == lr
    camera = photo.resized(*hr)
    assert (camera.scaled(1 / 4).width, camera.scaled(1 / 4).height) == lr


def made(sizes: str, width: int = 57, height: int = 43, **settings):
    return prepare(capture(2, width, height), papers(train=1, sizes=sizes, **settings), Bicubic(), POINTS).train[0]


def test_rounded_sizes_keep_the_border_and_its_rays_and_cropped_ones_the_focal_length():
    """57x43 at shrink 2, x4: 57/8 = 7.125 -> 7, 43/8 = 5.375 -> 5."""
    view, photo = made("round", shrink=2), capture(2, 57, 43).frames[1].camera
    assert view.truth.shape == (20, 28, 3)
    assert float(view.truth[0, -1, 0]) > 0.97  # the photo ends at 1
    for camera in (view.lr.camera, view.hr.camera):
        x, y = camera.width / photo.width, camera.height / photo.height  # the same field of view
        rays = (photo.fx * x, photo.fy * y, photo.cx * x, photo.cy * y)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(rays)
    view, photo = made("crop", shrink=2), capture(2, 57, 43).frames[1].camera
    assert (view.hr.camera.width, view.hr.camera.height) == (28, 20)
    assert (view.hr.camera.fx, view.hr.camera.cy) == pytest.approx((photo.fx / 2, photo.cy / 2))
    crop, rounded = (made(sizes, 64, 48, shrink=2) for sizes in ("crop", "round"))  # nothing is left over
    assert torch.equal(crop.truth, rounded.truth)
    assert torch.equal(crop.lr.image, rounded.lr.image)


def never() -> torch.Tensor:
    raise AssertionError("a photo was decoded")


def undecodable(n: int = 2, width: int = 57, height: int = 43) -> Capture:
    """Frames whose photos must not be decoded."""
    return Capture("headers", tuple(replace(f, load=never) for f in capture(n, width, height).frames))


@pytest.mark.parametrize("sizes", ["crop", "round"])
@pytest.mark.parametrize("photos_are", ["hr", "lr", "both"])
def test_a_photo_that_becomes_too_small_for_its_scores_is_refused_by_its_header(sizes, photos_are):
    views = papers(train=1, shrink=200, sizes=sizes, photos_are=photos_are)
    with pytest.raises(DataError, match=r"0001\.png: size: is 57x43, scored at 0x0, .*: lower data\.views\.shrink"):
        prepare(undecodable(), views, Bicubic(), POINTS)
    with pytest.raises(DataError, match=r"size: is 9x60, .*: give larger photos"):
        check_headers(undecodable(2, 9, 60).frames, replace(views, shrink=1))
    check_headers(undecodable().frames, replace(views, shrink=3))


@pytest.mark.parametrize("size", [None, (5, 5)])
def test_ready_made_lr_images_are_checked_by_their_headers(size, tmp_path):
    write_png(tmp_path / "0000.png", torch.zeros(10, 14, 3))  # of a test view
    if size is not None:
        write_png(tmp_path / "0001.png", torch.zeros(size[1], size[0], 3))
    with pytest.raises(DataError, match="has no LR image" if size is None else "is 5x5 where 14x10 is expected"):
        prepare(undecodable(), papers(train=1, lr_folder=str(tmp_path)), Bicubic(), POINTS)


def test_a_ready_made_lr_image_that_is_not_like_its_photo_gives_a_warning(tmp_path, caplog):
    views = papers(train=1, test_every=0, photos_are="both", lr_folder=str(tmp_path))
    photos = capture(1, image=torch.full((16, 16, 3), 0.5))
    for grey, warned in ((0.5, False), (0.4, True)):
        write_png(tmp_path / "0000.png", torch.full((4, 4, 3), grey))
        made = prepare(photos, views, Bicubic(), POINTS)
        message = r"0000.png: the photo, reduced again, differs .* check that .*0000.png shows this view, undistorted"
        assert bool(re.search(message, caplog.text)) is warned
    assert made.notes["LR"] == f"4x4, read from {tmp_path} (D is taken to be bicubic)"
    with pytest.raises(SettingError, match=r"data\.views\.lr_folder: must be null"):
        ViewSettings(photos_are="lr", lr_folder="here")


def test_bicubic_replaces_a_missing_sr_image_of_a_test_view_and_of_no_other(tmp_path):
    write_png(tmp_path / "0001.png", torch.full((16, 16, 3), 0.5))  # of the training view
    made = prepare(capture(2), papers(train=1), Images(str(tmp_path)), POINTS)
    assert [view.sr_source for view in (*made.train, *made.test)] == [f"images {tmp_path}", Bicubic().label]
    (tmp_path / "0001.png").rename(tmp_path / "0000.png")
    with pytest.raises(DataError, match="has no SR image 0001"):
        prepare(capture(2), papers(train=1), Images(str(tmp_path)), POINTS)


RIG = ("cam1/0001.png", "cam1/0002.png", "cam2/0001.png", "cam2/rgb.0003.png")


def rig() -> Capture:
    """Photos of two cameras, each of its own grey."""
    frames = capture(len(RIG)).frames
    return Capture("rig", tuple(
        replace(frame, name=name, load=lambda frame=frame, i=i: Photo(frame.camera, torch.full((16, 16, 3), i / 5)))
        for i, (frame, name) in enumerate(zip(frames, RIG, strict=True))
    ))  # fmt: skip


def test_a_view_is_chosen_by_its_file_name_where_that_is_its_own_and_not_that_of_a_test_view():
    views = ViewSettings(train_names=["cam2/0001", "0002", "rgb.0003", "cam1/0001.png"])
    assert [frame.name for frame in split(rig(), views)[0]] == [RIG[2], RIG[1], RIG[3], RIG[0]]
    with pytest.raises(DataError, match=r"'0001' may be 'cam1/0001.png' or 'cam2/0001.png'"):
        split(rig(), ViewSettings(train_names=["0001"]))
    with pytest.raises(DataError, match=r"no view 'rgb'.*choose among cam1/0001, .*cam2/rgb.0003"):
        split(rig(), ViewSettings(train_names=["rgb"]))
    with pytest.raises(DataError, match=r"'cam1/0002\.png' is named twice"):
        split(rig(), ViewSettings(train_names=["0002", "cam2/0001", "cam1/0002.png"]))
    both = [replace(frame, name=name) for frame, name in zip(capture(2).frames, ("a", "test/a"), strict=True)]
    for name in ("a", "a.png"):
        assert split(Capture("blender", tuple(both)), ViewSettings(train_names=[name], own_split=False))[0] == [both[0]]


def test_saved_lr_images_are_those_of_their_views_and_no_two_are_saved_as_one(tmp_path):
    views = papers(train=4, test_every=0)
    save_lr(rig(), views, tmp_path / "lr")
    assert sorted(str(p.relative_to(tmp_path / "lr")) for p in (tmp_path / "lr").rglob("*.png")) == sorted(RIG)
    read = prepare(rig(), papers(train=4, test_every=0, lr_folder=str(tmp_path / "lr")), Bicubic(), POINTS)
    for view, expected in zip(read.train, prepare(rig(), views, Bicubic(), POINTS).train, strict=True):
        torch.testing.assert_close(view.lr.image, expected.lr.image, atol=1 / 255, rtol=0)
    write_png(tmp_path / "lr/cam1/0001.png", torch.zeros(16, 16, 3))  # a photo, say
    with pytest.raises(
        DataError, match=r"cam1/0001\.png: file: is there, and holds another image: give another folder"
    ):
        save_lr(rig(), views, tmp_path / "lr")


def test_lr_images_of_photos_that_differ_in_their_endings_are_found_again(tmp_path):
    frames = in_a_row((16, 16), (16, 16)).frames
    shades = (torch.zeros(16, 16, 3), torch.ones(16, 16, 3))
    both = [
        replace(frame, name=name, load=lambda frame=frame, shade=shade: Photo(frame.camera, shade))
        for frame, name, shade in zip(frames, ("a.jpg", "a.png"), shades, strict=True)
    ]
    twins = Capture("twins", tuple(both))
    save_lr(twins, papers(train=2, test_every=0), tmp_path)
    read = prepare(twins, papers(train=2, test_every=0, lr_folder=str(tmp_path)), Bicubic(), POINTS)
    assert [float(view.lr.image.mean()) for view in read.train] == [0, 1]


@pytest.mark.parametrize("init", ["sfm", "sfm_train", "ply"])
def test_points_that_do_not_exist_are_refused_before_a_photo_is_decoded(init):
    with pytest.raises(DataError, match=r"there are none|is not there"):
        prepare(undecodable(), papers(train=1), Bicubic(), CloudSettings(init=init, path="nowhere.ply"))


@pytest.mark.parametrize(("away", "warns"), [(0.0, False), (4.5e6, True)])
def test_geographic_coordinates_give_a_warning(away, warns, caplog):
    """Cameras within 300 m, and in UTM coordinates, where float32 rounds positions to a quarter of a metre."""
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    poses[0, 0, 3], poses[:, 1, 3] = 600.0, away
    frames = zip(undecodable().frames, poses, strict=True)
    moved = tuple(replace(frame, camera=replace(frame.camera, world_to_camera=pose)) for frame, pose in frames)
    with pytest.raises(AssertionError, match="decoded"):
        prepare(Capture("far", moved), ViewSettings(), Bicubic(), CloudSettings())
    assert ("where float32 rounds positions to 0.27" in caplog.text) == warns


# ---- the HR side is held to a number of megapixels: the factor, the photos and the words for each size of photo
def held(size: tuple[int, int], *, super_resolve: bool = False, **settings) -> tuple[Capture, ViewSettings]:
    return within_limit(
        in_a_row(size, size), ViewSettings(**settings), reaches=lambda _: True, super_resolve=super_resolve
    )


LIMITED = [((360, 240), "lr", 4), ((776, 516), "lr", 2), ((1008, 756), "both", 4), ((4032, 3024), "both", 4)]


@pytest.mark.parametrize(("size", "photos_are", "factor"), LIMITED)
def test_every_size_of_photo_keeps_the_hr_side_within_the_limit(size, photos_are, factor):
    found, views = held(size)
    camera = found.frames[0].camera
    scale = views.sr_scale if views.photos_are == "lr" else 1
    assert (views.photos_are, views.sr_scale) == (photos_are, factor)
    assert scale**2 * camera.width * camera.height <= 2.1e6 * 1.01
    if size[0] * size[1] <= 2.1e6:
        assert (camera.width, camera.height) == size  # every pixel is used


def test_a_prior_that_is_chosen_super_resolves_reduced_photos_and_without_a_limit_nothing_changes():
    found, views = held((4032, 3024), super_resolve=True)
    camera = found.frames[0].camera
    assert (views.photos_are, views.sr_scale) == ("lr", 2) or views.sr_scale == 4
    assert 16 * camera.width * camera.height == pytest.approx(2.1e6, rel=0.01)
    for settings in ({"max_hr_megapixels": None}, {"photos_are": "hr"}, {"photos_are": "both"}):
        found, views = held((4032, 3024), **settings)
        assert found.frames[0].camera.width == 4032
        assert "HR side" not in found.notes
        assert views == ViewSettings(**settings)


def test_photos_of_two_sizes_are_each_reduced_to_the_limit_and_trained_on_at_both_scales():
    views = ViewSettings(max_hr_megapixels=0.004)
    found, views = within_limit(
        in_a_row((100, 80), (80, 100), (50, 40)), views, reaches=lambda _: True, super_resolve=False
    )
    sizes = [(frame.camera.width, frame.camera.height) for frame in found.frames]
    assert sizes == [(72, 56), (56, 72), (48, 40)]
    scene = prepare(found, views, Bicubic(), CloudSettings(init="random", random_points=20))
    assert len(scene.train) == 3
    for view in scene.train:
        assert view.hr_is_photo
        assert (view.lr.camera.width * 4, view.lr.camera.height * 4) == (view.hr.camera.width, view.hr.camera.height)
        assert "the photos themselves" in view.sr_source
    assert scene.notes["test views"].startswith("none")
