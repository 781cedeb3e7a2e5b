"""Cameras see what is inside their image and not hidden."""

from __future__ import annotations

import torch

from clear_strategies.geometry.visibility import seen_by
from rasterizers.interface import Camera


def camera(x: float = 0.0) -> Camera:
    """At (x, 0, 0), looking along z; a pixel is 0.1 wide at a depth of 1."""
    pose = torch.eye(4)
    pose[0, 3] = -x
    return Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10)


def test_a_pixel_is_seen_where_its_surface_is_inside_another_camera_and_not_hidden():
    wall = torch.full((10, 10), 1.0)
    beside = seen_by(camera(), wall, [(camera(0.5), wall), (camera(), wall)])  # 5 pixels aside
    assert beside[:, :5].unique().tolist() == [1]
    assert beside[:, 5:].unique().tolist() == [2]
    assert seen_by(camera(), wall, [(camera(), wall * 0.5)]).max() == 0  # something stands before it
    assert seen_by(camera(), wall, [(camera(), wall * 2)]).min() == 1
    assert seen_by(camera(), torch.full((10, 10), torch.nan), [(camera(), wall)]).max() == 0
    assert seen_by(camera(), wall, [(camera(), torch.full((10, 10), torch.nan))]).max() == 0
