"""What views have beside their photos: SR detail, back-projection, depth, one exposure, transparency."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from clear_strategies import P2G, DepthMap, Photo
from clear_strategies.core import images
from clear_strategies.data import photo_files
from clear_strategies.data.capture import Capture
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.prepare import prepare, truth_of
from clear_strategies.data.priors import BackProjected, Bicubic, DemoPrior
from clear_strategies.data.readers import blender, demo
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.geometry.dense_stereo.settings import StereoSettings
from tests.helpers import captures as tiny
from tests.helpers.captures import POINTS_AT_RANDOM as POINTS
from tests.helpers.captures import alike as capture
from tests.helpers.captures import papers
from tests.helpers.networks import Counting

ROOM = demo.read(width=64, height=48, views=5, train=2)


def wrong(**settings) -> DemoPrior:
    """SR images of the room with errors."""
    return DemoPrior(truth_of(ROOM, papers()), **settings)


def test_the_hr_camera_is_that_of_the_photo_to_the_bit():
    """30.8 / 3 times 3 is not 30.8."""
    first, other = capture(2, 60, 60).frames
    photo = Photo(replace(first.camera, cy=30.8), first.load().image)
    frames = (replace(first, camera=photo.camera, load=lambda: photo), other)
    scene = prepare(Capture("c", frames), papers(sr_scale=3, train=2, test_every=0), Bicubic(), POINTS)
    assert scene.train[0].hr.camera.cy == 30.8


@pytest.mark.parametrize(("prior", "least", "most"), [(Bicubic(), 0.0, 0.4), (wrong(), 1.0, 255.0)])  # 0.4: rounding
def test_the_detail_of_sr_images_is_measured_and_its_absence_reported(prior, least, most, caplog):
    with caplog.at_level(logging.WARNING):
        scene = prepare(ROOM, papers(train=2), prior, POINTS)
    assert least <= float(scene.notes["the SR images add"].split()[0]) <= most
    assert ("They hold hardly any detail" in caplog.text) == (least == 0)


def test_back_projected_sr_images_shrink_to_the_photos_and_keep_how_far_they_were():
    prior = wrong(share=0.5, patch=16)
    made, moved = (prepare(ROOM, papers(train=2), sr, POINTS) for sr in (prior, BackProjected(prior)))
    assert "back-projection" not in made.notes
    assert moved.notes["back-projection"].startswith("SR images differed from the LR photos by ")
    for before, after in zip((*made.train, *made.test), (*moved.train, *moved.test), strict=True):
        was, now = ((images.downsample(v.hr.image, v.factor) - v.lr.image).abs() for v in (before, after))
        assert before.disagreement is None
        assert torch.equal(after.disagreement, was)
        assert now.mean() < 0.2 * was.mean()
    for before, after in zip(made.train, moved.train, strict=True):
        R = [P2G(patch=4).patch_maps(v).reliability for v in (before, after, replace(after, disagreement=None))]
        assert torch.equal(R[0], R[1])
        assert float(R[0].min()) < 0.1  # what was wrong is still known, and would not be without
        assert float(R[2].min()) > 0.9


def test_photos_that_are_the_hr_side_are_not_moved_and_equalize_has_no_effect_without_depth(caplog):
    scene = prepare(ROOM, ViewSettings(photos_are="both", train=2), BackProjected(wrong()), POINTS)
    assert all(view.hr_is_photo and view.true_hr is view.hr.image for view in scene.train)
    assert "back-projection" not in scene.notes
    made = prepare(capture(), ViewSettings(sr_scale=2, equalize=True), Bicubic(), POINTS)
    assert "data.views.equalize has no effect" in caplog.text
    assert "equalized" not in made.notes


@pytest.mark.parametrize(
    ("photos_are", "max_pixels", "windows", "compared"),
    [
        ("both", 250_000, [7], (64, 48)),
        ("both", 1_000, [7], (32, 24)),
        ("both", 400, [7], (21, 16)),
        ("both", 200, [5], (16, 12)),
        ("hr", 250_000, [5, 7], (16, 12)),  # the LR photos, then the SR images that complete their depth
    ],
)
def test_depth_is_of_the_hr_side_where_it_is_photos_and_else_of_lr(
    photos_are, max_pixels, windows, compared, monkeypatch
):
    asked = []

    def depth_maps(photos, _, stereo, *__):
        asked.append(stereo.window)
        return [DepthMap(torch.full(p.image.shape[:2], 4.0), torch.ones(p.image.shape[:2])) for p in photos]

    monkeypatch.setattr("clear_strategies.data.cloud.depth_maps", depth_maps)
    cloud = CloudSettings(init="stereo", stereo=StereoSettings(max_pixels=max_pixels))
    scene = prepare(ROOM, ViewSettings(photos_are=photos_are, train=2), Bicubic(), cloud)
    assert asked == windows
    for view in scene.train:
        assert tuple(view.depth.depth.shape) == compared[::-1]
        shown = view.depth_photo
        factor = round(64 / compared[0])
        assert (shown.camera.width, shown.camera.fx) == (compared[0], view.hr.camera.fx / factor)
        of = view.lr.image if compared[0] == 16 else images.area_mean(view.hr.image, factor)
        assert torch.equal(shown.image, of)


@pytest.mark.slow
def test_equalized_photos_lose_their_casts_at_both_scales_and_test_photos_keep_theirs():
    known = demo.read(width=96, height=72, views=5, train=3)
    names = [f.name for f in known.frames if f.split == "train"]
    casts = dict(zip(names, torch.tensor([[0.9, 1.0, 1.0], [1.0, 1.0, 0.92], [1.0, 1.05, 1.0]]), strict=True))
    shown = {f.name: (f.load().image * casts.get(f.name, 0.8)).clamp(0, 1) for f in known.frames}
    frames = tuple(replace(f, load=lambda f=f: Photo(f.camera, shown[f.name])) for f in known.frames)
    wanted = ViewSettings(photos_are="hr", sr_scale=2, equalize=True)
    made = prepare(Capture("cast", frames), wanted, Bicubic(), CloudSettings(init="stereo"))
    common = torch.stack(list(casts.values())).log().mean(0).exp()
    for view in made.train:
        before = images.downsample(shown[view.name], 2).mean((0, 1))
        assert torch.allclose(casts[view.name] * view.lr.image.mean((0, 1)) / before, common, atol=0.01)
        assert torch.allclose(view.hr.image.mean((0, 1)), view.lr.image.mean((0, 1)), atol=2e-3)
    assert made.notes["equalized"].startswith("photos times 0.9")
    assert all(torch.equal(view.truth, shown[view.name]) for view in made.test)


@pytest.mark.parametrize("photos_are", ["hr", "lr", "both"])
def test_transparent_photos_can_be_shown_before_any_background(tmp_path, photos_are):
    root = tiny.blender(tmp_path)
    pixels = np.full((tiny.HEIGHT, tiny.WIDTH, 4), (200, 100, 50, 0), np.uint8)
    pixels[..., 3] = np.linspace(0, 255, tiny.WIDTH)
    for photo in (root / "train").glob("*.png"):
        Image.fromarray(pixels).save(photo)
    views = ViewSettings(photos_are=photos_are, sr_scale=2)
    white, black = (
        prepare(blender.read(root, background=(c, c, c)), views, Bicubic(), POINTS).train for c in (1.0, 0.0)
    )
    for mine, expected in zip(white, black, strict=True):
        for scale in ("lr", "hr"):
            transparent, photo = getattr(mine, scale), getattr(expected, scale)
            assert transparent.transparency.shape == photo.image.shape[:2]
            moved = transparent.over((0.0, 0.0, 0.0), mine.background)
            assert moved.transparency is None
            torch.testing.assert_close(moved.image, photo.image, atol=2.5 / 255, rtol=0)
    assert prepare(capture(), replace(views, photos_are="hr"), Bicubic(), POINTS).train[0].lr.transparency is None


@pytest.mark.parametrize("downsample", ["bicubic", "area", "lanczos"])
def test_the_colour_of_transparent_pixels_makes_no_fringe_where_photos_are_reduced(tmp_path, downsample):
    rows, columns = np.mgrid[:48, :64]
    disc = (rows - 24) ** 2 + (columns - 30) ** 2 < 15**2
    root = tiny.blender(tmp_path)
    for photo in (root / "train").glob("*.png"):
        Image.fromarray(np.where(disc[..., None], (90, 90, 90, 255), (255, 0, 0, 0)).astype(np.uint8)).save(photo)
    views = ViewSettings(photos_are="both", shrink=4, sr_scale=1, downsample=downsample)
    for view in prepare(blender.read(root), views, Bicubic(), POINTS).train:
        for image in (view.lr.image, view.lr.over((0.0, 0.0, 0.0), view.background).image):
            assert float((image.amax(2) - image.amin(2)).max()) < 1.5 / 255


def test_a_network_enlarges_the_transparency_of_a_photo_once(tmp_path, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path))
    network = Counting()
    half = torch.full((16, 16), 0.5)
    (frame,) = capture(1).frames
    glass = Capture("glass", (replace(frame, load=lambda: replace(frame.load(), transparency=half)),))
    for _ in range(2):
        made = prepare(glass, papers(train=1, test_every=0), BackProjected(network), POINTS).train[0]
        assert float((made.hr.transparency - 0.5).abs().max()) <= 1.01 / 255
    assert network.calls == ["0000.png"] * 2  # the photo and its transparency


def test_a_photo_with_alpha_is_decoded_once(tmp_path, monkeypatch):
    decoded, to_float = [], photo_files._to_float
    monkeypatch.setattr(photo_files, "_to_float", lambda *given: decoded.append(given) or to_float(*given))
    prepare(blender.read(tiny.blender(tmp_path)), ViewSettings(photos_are="both", sr_scale=2), Bicubic(), POINTS)
    assert len(decoded) == len(tiny.NAMES)
