"""SelfEnsembled: the mean over the orientations of a photo."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.data.priors import BackProjected, Bicubic, SelfEnsembled, network_of
from clear_strategies.errors import SettingError
from tests.helpers.networks import photo


@dataclass(frozen=True)
class Shaded:
    """A network that enlarges pixels, and makes the right half lighter by `invented`, however the photo is turned."""

    invented: float
    files: tuple[Path, ...] = ()
    label: str = "shaded"

    def __call__(self, name: str, lr: Tensor, factor: int) -> Tensor:
        sr = lr.repeat_interleave(factor, 0).repeat_interleave(factor, 1) * 0.5
        sr[:, sr.shape[1] // 2 :] += self.invented
        return sr


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path))


def test_what_turns_with_the_photo_stays_and_what_does_not_is_averaged() -> None:
    lr = photo(6, 10)
    same = SelfEnsembled(Shaded(0.0))("view", lr, 4)
    assert torch.equal(same, images.quantize(Shaded(0.0)("view", lr, 4)))
    lighter = SelfEnsembled(Shaded(0.25))("view", lr, 4)
    assert torch.equal(lighter, images.quantize(lighter))
    added = lighter - same
    # Half of the orientations have each pixel in their right half.
    assert added.shape == (24, 40, 3)
    assert float((added - 0.125).abs().max()) <= 1.01 / 255


def test_each_orientation_is_cached_and_what_decorates_it_finds_the_network(tmp_path: Path) -> None:
    prior = SelfEnsembled(Shaded(0.25))
    first = prior("view", photo(6, 10), 2)
    assert len(list((tmp_path / "sr").glob("*.png"))) == 8
    assert torch.equal(prior("another name", photo(6, 10), 2), first)
    assert network_of(BackProjected(prior)) == Shaded(0.25)
    assert BackProjected(prior).label == "shaded, mean of 8 orientations, back-projected"


def test_a_prior_that_is_no_network_is_refused() -> None:
    with pytest.raises(SettingError, match=r"prior\.prior: must be a network, got 'Bicubic': use that prior without"):
        SelfEnsembled(Bicubic())
