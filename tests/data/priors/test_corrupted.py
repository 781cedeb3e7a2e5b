"""Seeded errors: in exactly the given share of the patches, different in every view; on other priors and on the truth."""

import math
from functools import cache

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.priors import Cached, Corrupted, DemoPrior
from clear_strategies.data.readers import demo
from clear_strategies.errors import DataError, SettingError
from clear_strategies.settings import build
from tests.helpers.configs import composed
from tests.helpers.image_files import noise


class Sharp:
    """Bicubic, sharpened: an SR image with detail beyond U(I_LR)."""

    label = "sharp"

    def __call__(self, name, lr, factor):
        large = images.upsample(lr, factor)
        return images.quantize(large + 0.5 * (large - images.upsample(images.downsample(large, 8, "area"), 8)))


def test_errors_differ_between_views_and_seeds_and_without_share_or_strength_there_are_none():
    lr = noise(0, 24, 32)
    for none in ({"share": 0.0}, {"strength": 0.0}):
        assert torch.equal(Corrupted(Sharp(), **none)("a", lr, 4), Sharp()("a", lr, 4))
    one, again, other = (Corrupted(Sharp(), patch=16, seed=seed)("a", lr, 4) for seed in (0, 0, 1))
    assert torch.equal(one, again)
    assert not torch.equal(one, other)
    a, b = ((Corrupted(Sharp(), patch=16)(name, lr, 4) - Sharp()(name, lr, 4)).abs() for name in "ab")
    assert not torch.equal(images.patch_means(a, 16) > 0, images.patch_means(b, 16) > 0)


def test_a_network_inside_is_cached_and_the_config_builds_it(tmp_path):
    config = composed("prior=corrupted", "prior.prior.path=net.onnx", "prior.share=0.5")
    prior = build(OmegaConf.to_container(config.prior))
    assert isinstance(prior.prior, Cached)
    assert (prior.prior.prior.path, prior.share) == ("net.onnx", 0.5)


@pytest.mark.parametrize("wrong", [{"share": 1.5}, {"share": math.nan}, {"strength": -1.0}, {"patch": 0}, {"seed": -1}])
def test_settings_out_of_range_are_refused_by_name(wrong):
    for made in (lambda: Corrupted(Sharp(), **wrong), lambda: DemoPrior({}, **wrong)):
        with pytest.raises(SettingError, match=rf"prior\.{next(iter(wrong))}: must .*, got "):
            made()


# --- the demo's prior ------------------------------------------------------------------------------------------------

WIDTH, HEIGHT, FACTOR = 128, 96, 4


@cache
def frames():
    return demo.read(width=WIDTH, height=HEIGHT, views=6).frames


def prior(**settings: float) -> DemoPrior:
    return DemoPrior({f.name: lambda f=f: f.load().image for f in frames()}, patch=32, **settings)  # type: ignore[arg-type]


def lr_of(i: int) -> tuple[str, Tensor, Tensor]:
    frame = frames()[i]
    return frame.name, images.downsample(frame.load().image, FACTOR), frame.load().image


@cache
def enlarged() -> list[tuple[Tensor, Tensor, Tensor]]:
    """(LR, truth, SR) of every view."""
    return [(lr, truth, prior()(name, lr, FACTOR)) for name, lr, truth in map(lr_of, range(6))]


@pytest.mark.parametrize("share", [0.0, 0.04, 0.05, 0.5, 0.98, 1.0])
def test_exactly_the_given_share_of_the_patches_is_wrong(share: float) -> None:
    name, lr, truth = lr_of(2)
    before = truth.clone()
    difference = images.patch_means((prior(share=share)(name, lr, FACTOR) - truth).abs(), 32)
    assert int((difference > 0).sum()) == round(share * 12)  # 128x96: 4 x 3 patches
    assert torch.equal(truth, before)


def test_some_errors_agree_with_lr_and_some_do_not_and_the_demo_prior_is_better_than_bicubic() -> None:
    reliability = []
    for lr, _, sr in enlarged():
        residual = (images.downsample(sr, FACTOR) - lr).abs()
        reliability.append(torch.exp(-images.patch_means(residual, 8) / 0.05).flatten())
    found = torch.cat(reliability)
    assert found.median() > 0.95
    assert found.quantile(0.02) < 0.4
    assert ((found > 0.4) & (found < 0.9)).float().mean() > 0.1
    errors = []
    for lr, truth, sr in enlarged():
        smooth = images.upsample(lr, FACTOR)
        errors.append([float((sr - truth).square().mean()), float((smooth - truth).square().mean())])
    ours, bicubic = np.mean(errors, axis=0)
    assert 0 < 10 * math.log10(bicubic / ours) < 6


def test_a_truth_of_another_size_is_refused_in_one_line() -> None:
    with pytest.raises(DataError, match=r"a: truth: is 64x64 where HR is 32x32: use photos that are HR"):
        DemoPrior({"a": lambda: torch.rand(64, 64, 3)})("a", torch.rand(8, 8, 3), 4)


def test_hidden_errors_shrink_to_the_same_lr_pixels_and_are_still_wrong():
    lr = noise(0, 24, 32)
    right = Sharp()("a", lr, 4)
    seen, hidden = (Corrupted(Sharp(), patch=32, hidden=h)("a", lr, 4) for h in (False, True))
    mask = images.patch_means((seen - right).abs(), 32) > 0
    change = images.patch_means((hidden - right).abs(), 32)
    assert int(mask.sum()) == round(0.3 * mask.numel())
    assert torch.equal(change > 0, mask)
    assert float(change[mask].min()) > 2 / 255
    apart = [(images.downsample(sr, 4) - images.downsample(right, 4)).abs().mean() for sr in (seen, hidden)]
    assert float(apart[1]) < 0.25 * float(apart[0])
