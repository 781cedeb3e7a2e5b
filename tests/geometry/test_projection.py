"""Points and pixels: sampling between pixel centres, and projection inverted."""

from __future__ import annotations

import torch

from clear_strategies.geometry.projection import sample_colors


def test_colours_are_sampled_between_pixel_centres() -> None:
    image = torch.tensor([[[0.0, 0, 0], [1.0, 1, 1]]])
    at = torch.tensor([[0.5, 0.5], [1.0, 0.5], [1.25, 0.5], [1.5, 0.5], [0.1, 0.2]])
    assert torch.allclose(sample_colors(image, at)[:, 0], torch.tensor([0, 0.5, 0.75, 1, 0]))
