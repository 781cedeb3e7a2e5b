"""From a capture to a scene: what the plan says of the reference."""

from __future__ import annotations

import logging

import pytest

from clear_strategies.data.points.cloud import CloudSettings
from clear_strategies.data.prepare import ViewSettings, prepare
from clear_strategies.data.priors.upscale import Bicubic
from clear_strategies.data.readers import demo

POINTS = CloudSettings(init="random", random_points=50)


def added(prior, caplog) -> tuple[float, str]:
    capture = demo.read(width=64, height=48, views=5, train=2)
    with caplog.at_level(logging.WARNING):
        scene = prepare(capture, ViewSettings(train=2), prior(capture), POINTS)
    return float(scene.notes["the reference adds"].split()[0]), caplog.text


def test_a_reference_without_detail_is_said_to_have_none(caplog):
    levels, said = added(lambda capture: Bicubic(), caplog)
    assert levels == pytest.approx(0.2, abs=0.2)  # rounding to 8 bits
    assert "there is no detail to route" in said


def test_a_reference_with_detail_is_measured(caplog):
    levels, said = added(lambda capture: demo.DemoPrior({f.name: f.load for f in capture.frames}), caplog)
    assert levels > 1
    assert "no detail" not in said
