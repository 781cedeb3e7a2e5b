"""Wrong detail on purpose: seeded, different in every view, in exactly the share of the patches that was asked for."""

from __future__ import annotations

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from clear_strategies.core import images
from clear_strategies.data.priors.corrupted import Corrupted
from clear_strategies.data.priors.upscale import Bicubic, Cached
from clear_strategies.run import CONF
from clear_strategies.settings import build


def photo(seed: int = 0):
    """LR with structure at every scale; its bicubic enlargement has some detail left to corrupt."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.random((24, 32, 3), dtype=np.float32))


def wrong_patches(prior: Corrupted, name: str, lr) -> torch.Tensor:
    return images.patch_means((prior(name, lr, 4) - prior.prior(name, lr, 4)).abs(), prior.patch) > 0


def test_the_share_of_patches_is_wrong_and_the_others_are_the_priors():
    lr, prior = photo(), Corrupted(Sharp(), share=0.25, patch=32)  # 96x128: 3 x 4 patches
    assert int(wrong_patches(prior, "a", lr).sum()) == 3


def test_without_share_or_strength_it_is_the_prior():
    lr = photo()
    for settings in ({"share": 0.0}, {"strength": 0.0}):
        assert torch.equal(Corrupted(Sharp(), **settings)("a", lr, 4), Sharp()("a", lr, 4))


def test_views_and_seeds_have_errors_of_their_own():
    lr = photo()
    one = Corrupted(Sharp(), patch=16)
    assert torch.equal(one("a", lr, 4), Corrupted(Sharp(), patch=16)("a", lr, 4))
    assert not torch.equal(wrong_patches(one, "a", lr), wrong_patches(one, "b", lr))
    assert not torch.equal(one("a", lr, 4), Corrupted(Sharp(), patch=16, seed=1)("a", lr, 4))


def test_its_label_names_the_prior_and_says_synthetic():
    assert (
        Corrupted(Bicubic()).label == "bicubic (no detail beyond LR) (synthetic: seeded errors in 30% of the patches)"
    )


def test_a_network_inside_is_cached_and_the_config_builds_it(tmp_path):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", ["prior=corrupted", "prior.prior.path=net.onnx", "prior.share=0.5"])
    prior = build(OmegaConf.to_container(config.prior))
    assert isinstance(prior.prior, Cached)
    assert (prior.prior.prior.path, prior.share) == ("net.onnx", 0.5)


class Sharp:
    """Bicubic, sharpened: a reference with detail beyond U(I_LR)."""

    label = "sharp"

    def __call__(self, name, lr, factor):
        large = images.upsample(lr, factor)
        return images.quantize(large + 0.5 * (large - images.upsample(images.downsample(large, 8, "area"), 8)))
