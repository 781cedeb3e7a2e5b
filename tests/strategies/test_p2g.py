"""P2G: Eq. 9, 10, 12 and 14."""

import copy
import math
import weakref
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies import P2G, Evidence, Photo, ScreenGradients, Step
from clear_strategies.core import images
from clear_strategies.kernels.per_gaussian import evidence
from clear_strategies.training.field import GaussianField
from tests.helpers import toy


@pytest.mark.parametrize("scale", [0.01, "relative:1"])
@pytest.mark.parametrize("kernel", ["bicubic", "bilinear", "lanczos", "area"])
def test_reliability_is_one_where_the_reference_agrees_with_lr_up_to_rounding(kernel, scale):
    hr = images.quantize(torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)))
    R, _ = P2G(scale, down=kernel).patch_evidence(images.downsample(hr, 4, kernel), hr, 4)
    assert torch.allclose(R, torch.ones_like(R), atol=1e-6)


def test_reliability_worked_out_by_hand():
    # The reference is brighter by 0.01 in the left half: R = exp(-1) there, 1 in the right half.
    lr, hr = torch.full((16, 32, 3), 0.4), torch.full((64, 128, 3), 0.4)
    hr[:, :64] += 0.01
    R, _ = P2G(down="area").patch_evidence(lr, hr, 4)
    assert R.shape == (1, 2)
    assert R[0].tolist() == pytest.approx([math.exp(-1), 1.0], rel=1e-5)


def test_a_relative_scale_counts_in_the_views_own_disagreement_and_eight_bit_units_are_refused():
    # 0.05 in the left half, 0 in the right: 0.025 on average; twice that is 0.05 again.
    lr, hr = torch.full((16, 32, 3), 0.4), torch.full((64, 128, 3), 0.4)
    hr[:, :64] += 0.05
    relative, absolute = (P2G(r, down="area").patch_evidence(lr, hr, 4)[0] for r in ("relative:2", 0.05))
    assert torch.allclose(relative, absolute, rtol=1e-5)
    assert P2G().patch_evidence(lr, hr, 4, disagreement=torch.zeros_like(lr))[0].tolist() == [
        [1, 1]
    ]  # as measured before
    for low, high in ((0.0, 255.0), (-0.002, 1.0), (0.0, 1.002)):
        with pytest.raises(ValueError, match=r"I_HR must lie in \[0, 1\]"):
            P2G().patch_evidence(lr, torch.linspace(low, high, 64 * 128 * 3).view(64, 128, 3), 4)
    P2G().patch_evidence(lr, torch.linspace(-5e-4, 1 + 5e-4, 64 * 128 * 3).view(64, 128, 3), 4)  # rounding


def test_one_textured_patch_of_a_flat_image_demands_everything():
    textured = torch.full((128, 128, 3), 0.6)
    textured[:64, :64] += 0.2 * (torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    _, A = P2G().patch_evidence(images.downsample(textured, 4), textured, 4)
    assert A[0, 0] == 1
    assert float(A[1, 1]) < 1e-3


def test_a_patch_with_the_mean_detail_demands_one_half():
    noise = torch.rand(128, 128, 3, generator=torch.Generator().manual_seed(0))
    _, A = P2G().patch_evidence(images.downsample(noise, 4), noise, 4)
    assert torch.allclose(A, torch.full_like(A, 0.5), atol=0.03)


def test_the_evidence_is_that_of_the_patch_of_the_centre_and_of_the_border_outside():
    patches = torch.tensor([[[0.1, 0.2], [0.3, 0.4]], [[1.0, 2.0], [3.0, 4.0]]])
    u = torch.tensor([[0.0, 0.0], [15.9, 15.9], [16.0, 0.0], [3.0, 20.0], [-50.0, 40.0], [99.0, 99.0], [20.0, 20.0]])
    visible = torch.tensor([True] * 6 + [False])
    e = evidence(patches, u, visible, 16)
    assert e.demand.tolist() == pytest.approx([10 * value for value in e.reliability.tolist()])
    assert e.reliability.tolist() == pytest.approx([0.1, 0.1, 0.2, 0.3, 0.3, 0.4, 0.0])


@pytest.mark.parametrize("garbage", [math.nan, math.inf, -1e30])
def test_rows_of_invisible_gaussians_may_hold_anything(garbage):
    """Gsplat leaves the centres of culled Gaussians uninitialised: on CUDA they were an index outside the map."""
    visible, u = torch.tensor([True, False]), torch.tensor([[5.0, 5.0], [garbage, garbage]])
    assert evidence(torch.ones(2, 3, 4), u, visible, 16).reliability.tolist() == [1.0, 0.0]


@given(q=st.floats(0, 1, width=32), a=st.floats(0, 1, width=32), floor=st.floats(0, 1))
@settings(max_examples=50, deadline=None)
def test_routing_as_printed_lies_between_the_floor_and_one(q, a, floor):
    m = P2G(floor=floor, normalize=False).route(toy.step(evidence=Evidence(torch.tensor([q]), torch.tensor([a]))))
    assert float(m) == pytest.approx(floor + (1 - floor) * q * a, rel=1e-5, abs=1e-6)


def test_normalized_routing_moves_detail_and_removes_none_and_is_finite_where_none_is_visible():
    # The third is unreliable and visible all the same, the last is invisible.
    q, a = torch.tensor([1.0, 1.0, 0.0, 0.0]), torch.tensor([1.0, 0.2, 0.4, 0.0])
    step = toy.step(evidence=Evidence(q, a), visible=torch.tensor([True, True, True, False]))
    printed, m = (P2G(normalize=normalize).route(step) for normalize in (False, True))
    assert float(m[:3].mean()) == pytest.approx(1)
    assert torch.allclose(m[:3] / m[0], printed[:3] / printed[0])
    none = torch.zeros(3, dtype=torch.bool)
    assert bool(P2G().route(toy.step(evidence=Evidence(torch.zeros(3), torch.zeros(3)), visible=none)).isfinite().all())
    assert bool(P2G(floor=0).route(toy.step(evidence=Evidence(torch.ones(3), torch.zeros(3)))).isfinite().all())
    with pytest.raises(ValueError, match="there is none for this view"):
        P2G().route(toy.step(visible=none))


def test_observation_is_made_once_a_view_and_invisible_gaussians_have_none(caplog):
    view = toy.scene().train[0]
    _, shot = GaussianField.from_cloud(toy.scene().cloud).render_scales(toy.RASTERIZER, view)
    p2g = P2G()
    with caplog.at_level("DEBUG"):
        first, second = (p2g.observe(Step(t, view, shot.visible), shot) for t in (1, 2))
    assert caplog.text.count(view.name) == 1
    assert torch.equal(first.reliability, second.reliability)
    assert not first.weight[~shot.visible].any()
    assert (first.reliability[shot.visible] > 0).all()
    aside = P2G()
    aside.cache.update(copy.deepcopy(p2g.cache))  # as for the maps of a run, which copy no photo
    with caplog.at_level("DEBUG"):
        aside.looked_up(view)
    assert caplog.text.count(view.name) == 1


def test_evidence_is_that_of_the_images_which_a_loop_may_read_anew_crop_or_change(caplog):
    view, p2g = toy.scene().train[0], P2G()

    def read(change=torch.clone, **others):
        lr, hr = (replace(photo, image=change(photo.image)) for photo in (view.lr, view.hr))
        return replace(view, lr=lr, hr=hr, **others)

    with caplog.at_level("DEBUG"):
        first, second, third = (p2g.looked_up(read()) for _ in range(3))
    assert caplog.text.count(view.name) == 2  # the first images of a view have no digest
    assert torch.equal(first, second)
    assert third is second
    crop = replace(view, lr=cut(view.lr, 1), hr=cut(view.hr, view.factor))
    turned, measured = read(lambda image: image.flip(0)), read(disagreement=torch.full_like(view.lr.image, 0.1))
    for shown in (crop, view, crop, turned, view, measured, view, turned, turned):
        assert torch.equal(p2g.looked_up(shown), P2G().looked_up(shown))
        turned.hr.image.mul_(0.9)
    with torch.inference_mode():
        assert torch.equal(p2g.looked_up(read()), first)
    freed = [weakref.ref(photo.image) for photo in (crop.lr, crop.hr)]
    del crop, shown  # a loop that reads a photo for each step keeps none
    assert [of() for of in freed] == [None, None]


def cut(photo, unit):
    """The lower right of a photo, without `unit` times 8 and 4 pixels."""
    camera, x, y = photo.camera, 8 * unit, 4 * unit
    moved = replace(camera, cx=camera.cx - x, cy=camera.cy - y, width=camera.width - x, height=camera.height - y)
    return Photo(moved, photo.image[y:, x:].contiguous())


def screens(ordinary, hf):
    n = len(ordinary)
    return ScreenGradients(torch.zeros(n, 2), torch.zeros(n, 2), torch.tensor(hf), torch.tensor(ordinary))


def test_scores():
    e = toy.step(evidence=Evidence(torch.tensor([1.0, 0.5]), torch.tensor([0.5, 0.5])))
    s = screens([1.0, 3.0], [[3.0, 4.0], [0.0, 2.0]])
    assert P2G(score_by="evidence").score(e, s).tolist() == pytest.approx([2.5, 0.5])
    assert P2G(score_by="gradient").score(e, s) is None
    # S has mean 1.5, the ordinary statistic 2: S counts 4/3.
    assert P2G(score_by="sum").score(e, s).tolist() == pytest.approx([1 + 2.5 * 4 / 3, 3 + 0.5 * 4 / 3])
    assert P2G().score(toy.step(), s) is None


@pytest.mark.parametrize("grey", [0.3, 0.5, 0.5 / 255, 0.123456, 0.6, 1.0])
@pytest.mark.parametrize("down", ["bicubic", "bilinear", "lanczos", "area"])
def test_a_flat_image_asks_for_no_detail_on_and_off_the_8_bit_grid(grey, down):
    hr = torch.full((64, 64, 3), grey)
    _, A = P2G(down=down).patch_evidence(torch.full((16, 16, 3), grey), hr, 4)
    assert float(A.max()) < 1e-3
