"""Cut-offs by name."""

from __future__ import annotations

import pytest

import rasterizers
from rasterizers import PRESETS


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_sets_the_cut_offs(name):
    rasterizer = rasterizers.load("torch", preset=name)
    assert {key: getattr(rasterizer, key) for key in PRESETS[name]} == PRESETS[name]


def test_settings_override_the_preset():
    rasterizer = rasterizers.load("torch", preset="exact", alpha_min=1 / 64)
    assert rasterizer.alpha_min == 1 / 64
    assert rasterizer.transmittance_min == PRESETS["exact"]["transmittance_min"]


def test_presets_are_listed_coarsest_first():
    cuts = [(p["alpha_min"], p["transmittance_min"]) for p in PRESETS.values()]
    assert cuts == sorted(cuts, reverse=True)


def test_fast_is_the_default():
    assert rasterizers.load("torch", preset="fast") == rasterizers.load("torch")


def test_an_unknown_preset_is_refused():
    with pytest.raises(ValueError, match="unknown preset 'best'; choose one of fast, accurate, exact"):
        rasterizers.load("torch", preset="best")
