"""The scene of a job: what is checked of the photos, and what the log says of the prior."""

from __future__ import annotations

import logging
from dataclasses import replace

from clear_strategies.data.prepare import ViewSettings
from clear_strategies.data.readers import demo
from clear_strategies.jobs.scene import AutoPrior, DataSettings, load


def test_a_photo_that_no_view_uses_may_be_too_small(caplog):
    capture = demo.read(width=64, height=48, views=5, train=2)
    unused = max(i for i, frame in enumerate(capture.frames) if frame.split == "test")
    tiny = replace(capture.frames[unused], camera=capture.frames[unused].camera.scaled(1 / 16))
    frames = tuple(tiny if i == unused else frame for i, frame in enumerate(capture.frames))
    views = ViewSettings(train=2, test_limit=1)
    with caplog.at_level(logging.INFO):
        scene = load(DataSettings(reader=lambda: replace(capture, frames=frames), views=views), AutoPrior(), 0)
    assert tiny.name not in {view.name for view in (*scene.train, *scene.test)}
    assert "prior: auto chose demo" in caplog.text
