"""Image losses: values, gradients and the hard inputs."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies import kernels
from clear_strategies.objective import Objective
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay, milestones, scaled

LOSSES = {
    "l1": kernels.l1,
    "ssim": kernels.ssim,
    "haar": kernels.haar_l1,
    "haar of two levels": lambda x, y: kernels.haar_l1(x, y, 2),
}


def image(height, width, seed=0, dtype=torch.float64):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)).to(dtype)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("size", [(12, 16), (9, 7), (3, 30), (1, 1)])
def test_gradients_are_finite_differences(loss, size):
    x, y = image(*size, seed=1), image(*size, seed=2)
    g = torch.Generator().manual_seed(3)
    gradient = loss(x, y).gradient
    for _ in range(4):
        d = torch.randn(x.shape, generator=g, dtype=torch.float64)
        numeric = float(loss(x + 1e-7 * d, y).value - loss(x - 1e-7 * d, y).value) / 2e-7
        assert float((gradient * d).sum()) == pytest.approx(numeric, rel=1e-5, abs=1e-8)


def test_ssim_is_the_mean_that_scikit_image_computes_inside():
    from skimage.metrics import structural_similarity

    x, y = image(40, 50, 1), image(40, 50, 2)
    options = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "data_range": 1.0,
        "channel_axis": 2,
    }
    _, their_map = structural_similarity(x.numpy(), y.numpy(), full=True, **options)
    # Only the border differs (theirs reflects, ours is 3DGS's zero padding): put the pictures into a black frame.
    framed = [torch.nn.functional.pad(z, (0, 0, 20, 20, 20, 20)) for z in (x, y)]
    _, theirs = structural_similarity(*(z.numpy() for z in framed), full=True, **options)
    assert float(kernels.ssim(*framed).value) == pytest.approx(float(theirs.mean()), abs=1e-9)
    assert their_map.shape == (40, 50, 3)


@pytest.mark.parametrize("level", [0.0, 1 / 255, 0.5, 0.6, 1.0])
@pytest.mark.parametrize("difference", [0.0, 1e-7, 1e-3])
def test_ssim_of_constants_stays_within_its_range(level, difference):
    x = torch.full((20, 20, 3), level)
    y = x + difference
    value, gradient = kernels.ssim(x, y)
    assert -1 - 1e-6 <= float(value) <= 1 + 1e-6
    exact = kernels.ssim(x.double(), y.double())
    assert float(value) == pytest.approx(float(exact.value), abs=1e-6)
    assert torch.allclose(gradient.double(), exact.gradient, atol=1e-5 * float(exact.gradient.abs().max()) + 1e-12)


def test_identical_images_are_perfect():
    x = image(16, 16)
    assert float(kernels.ssim(x, x).value) == pytest.approx(1.0)
    assert float(kernels.photometric(x, x, 0.2).value) == pytest.approx(0.0, abs=1e-12)
    for loss in (kernels.l1, kernels.haar_l1):
        value, gradient = loss(x, x)
        assert float(value) == 0
        assert not gradient.any()


@given(seed=st.integers(0, 1000), shift=st.floats(-1, 1))
@settings(max_examples=20, deadline=None)
def test_haar_is_blind_to_a_constant(seed, shift):
    x, y = image(8, 12, seed), image(8, 12, seed + 1)
    assert float(kernels.haar_l1(x + shift, y).value) == pytest.approx(float(kernels.haar_l1(x, y).value), rel=1e-9)


def test_haar_worked_out_by_hand():
    # One 2x2 block (1 2; 3 5) per channel: details (1-2+3-5)/2, (1+2-3-5)/2, (1-2-3+5)/2.
    x = torch.tensor([[1.0, 2.0], [3.0, 5.0]])[..., None].expand(2, 2, 3)
    assert float(kernels.haar_l1(x, torch.zeros_like(x)).value) == pytest.approx((1.5 + 2.5 + 0.5) / 3)


def test_the_objective_gives_its_losses_in_order():
    x, y = image(8, 8, 1), image(8, 8, 2)
    values, cotangents = Objective().hr(x, y)
    assert list(values) == ["base", "hf"]
    assert cotangents.shape == (2, 8, 8, 3)
    assert list(Objective(lambda_hf=0.0).hr(x, y).values) == ["base"]
    clamped = Objective(clamp_render=True).lr(x * 2, y)
    assert not clamped.cotangents[0][(x * 2) > 1].any()


def test_lambda_hr_by_the_papers_milestones():
    schedule = WarmupDecay()
    expected = {1: 0, 500: 0, 501: 1 / 2500, 1750: 0.5, 3000: 1, 5000: 1, 7500: 0.55, 10_000: 0.1, 20_000: 0.1}
    for t, value in expected.items():
        assert schedule(t) == pytest.approx(value), t
    assert WarmupDecay(decay="cosine")(7500) == pytest.approx(0.55)
    assert WarmupDecay(decay="exponential")(7500) == pytest.approx(0.1**0.5)


def test_position_rate_falls_log_linearly():
    rate = LogLinear()
    assert [rate(0), rate(5000), rate(10_000)] == pytest.approx([1.6e-4, 1.6e-5, 1.6e-6])


def test_milestones_stretch_with_the_run_and_nothing_else_does():
    short = scaled(Objective(), 0.1)
    assert milestones(short) == {
        "lambda_hr.start": 50, "lambda_hr.full": 300, "lambda_hr.decay_from": 500, "lambda_hr.end": 1000,
    }  # fmt: skip
    assert (short.lambda_hf, short.lambda_hr.final) == (0.2, 0.1)
    assert [short.lambda_hr(t // 10) for t in (500, 1750, 7500)] == pytest.approx([0, 0.5, 0.55])
    assert scaled(Ramp(), 0.5).full == 5000


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WarmupDecay(start=600, full=500), "start <= full"),
        (lambda: WarmupDecay(decay="exponential", final=0.0), "exponential"),
        (lambda: Objective(lambda_ssim=1.5), "lambda_ssim"),
        (lambda: Objective(lambda_hf=-1), "lambda_hf"),
        (lambda: Objective(haar_levels=0), "haar_levels"),
        (lambda: LogLinear(initial=0), "learning rates"),
    ],
)
def test_settings_outside_their_range_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
