"""Captures of photos that show nothing, and settings that prepare them fast."""

from __future__ import annotations

import torch

from clear_strategies.data.capture import Capture
from clear_strategies.data.cloud import CloudSettings
from clear_strategies.data.view_settings import ViewSettings
from tests.helpers.captures import in_a_row

POINTS = CloudSettings(init="random", random_points=50)


def papers(**settings) -> ViewSettings:
    """The papers' protocols: conf/protocol/_papers.yaml."""
    return ViewSettings(**{"train": 3, "test_every": 8, "photos_are": "hr", **settings})


def capture(n: int = 3, width: int = 16, height: int = 16, image: torch.Tensor | None = None) -> Capture:
    return in_a_row(*[(width, height)] * n, image=image)
