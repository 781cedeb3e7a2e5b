"""Masks: what a photo hides has no part in any loss, gradient or depth, whatever its pixels are."""

from dataclasses import replace

import pytest
import torch

from clear_strategies import Objective, Photo, View
from clear_strategies.core import deferred
from clear_strategies.data.capture import Capture, Frame
from clear_strategies.data.cloud import CloudSettings, initial_points
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import Bicubic
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.geometry.pseudo_views import border_view
from clear_strategies.training.evaluation import psnr_of
from clear_strategies.training.loop import iterate
from tests.helpers import planes
from tests.helpers.short_run import SCENE, start, tensors
from tests.helpers.toy import RASTERIZER


def hidden(view: View) -> torch.Tensor:
    shown = torch.ones(view.lr.image.shape[:2], dtype=torch.bool)
    shown[2:6, 1:5] = False
    return shown


def painted(view: View, color: float) -> View:
    """The view with a colour in place of what its mask hides."""

    def over(photo: Photo) -> Photo:
        return replace(photo, image=torch.where(photo.shown[..., None], photo.image, color))

    masked = view.hiding(hidden(view))
    return replace(masked, lr=over(masked.lr), hr=over(masked.hr))


@pytest.mark.parametrize("fused", ["auto", "off"])
def test_a_field_does_not_depend_on_hidden_pixels(fused):
    trained = []
    for color in (0.0, 1.0):
        state = start(("gco", "svs"), fused=fused)
        state.views = tuple(painted(view, color) for view in SCENE.train)
        for _ in range(6):
            iterate(state, RASTERIZER)
        trained.append(tensors(state))
    assert all(torch.equal(a, trained[1][name]) for name, a in trained[0].items())


def test_hidden_pixels_have_no_part_in_the_psnr_and_no_cotangent_and_shown_ones_keep_theirs():
    target, shown = torch.rand(8, 8, 3), torch.arange(8).expand(8, 8) < 5
    image = torch.where(shown[..., None], (target + 0.1).clamp(0, 1), 1 - target)
    alone = psnr_of(image[:, :5], target[:, :5], None)
    assert deferred.read([psnr_of(image, target, shown)]) == pytest.approx(deferred.read([alone]))
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(32, 32, 3, generator=g), torch.rand(32, 32, 3, generator=g)
    shown = torch.ones(32, 32, dtype=torch.bool)
    shown[:, :10] = False
    for objective in (Objective(), Objective(clamp_render=True)):
        for losses in (objective.lr, objective.hr):
            masked, whole = losses(image, target, shown), losses(image, target)
            assert not masked.cotangents[:, :, :10].any()
            assert torch.allclose(masked.cotangents[:, :, 22:], whole.cotangents[:, :, 22:], atol=1e-7)
            assert all(float(masked.values[name]) < float(value) for name, value in whole.values.items())
            assert torch.equal(losses(image, target, torch.ones_like(shown)).cotangents, whole.cotangents)


def test_an_lr_pixel_is_hidden_where_a_photo_pixel_below_it_is():
    image, shown = torch.rand(16, 24, 3), torch.ones(16, 24, dtype=torch.bool)
    shown[5, 9] = False
    photo = Photo(planes.camera(0, 24, 16), image, shown)
    frame = Frame("a.png", photo.camera, lambda: photo)
    random = CloudSettings(init="random", random_points=50)
    made = prepare(Capture("a", (frame,)), ViewSettings(photos_are="hr", sr_scale=4), Bicubic(), random)
    view, expected = made.train[0], torch.ones(4, 6, dtype=torch.bool)
    expected[1, 2] = False
    assert torch.equal(view.lr.shown, expected)
    assert torch.equal(view.hr.shown, expected.repeat_interleave(4, 0).repeat_interleave(4, 1))
    assert made.notes["masks"] == "1 of 1 training photos have one, which hides 4.2% of it"
    assert view.hr.reduced(2).shown is not None


def test_hidden_pixels_have_no_depth_give_no_points_and_the_border_continues_over_them():
    photos = planes.plane_photos(3)
    shown = torch.ones(90, 120, dtype=torch.bool)
    shown[20:60, 30:80] = False
    made = initial_points(CloudSettings(init="stereo"), [replace(p, shown=shown) for p in photos])
    for depth in made.depths:
        assert not depth.known[20:60, 30:80].any()
        assert depth.known[:, 85:].any()
    photo = replace(planes.photo(), shown=torch.arange(40).expand(40, 40) > 10)
    wide = border_view(photo, field=1.5, max_pixels=10_000)
    assert torch.equal(wide.shown[10:50, 10:50], photo.shown)
