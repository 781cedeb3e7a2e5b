"""What the viewer draws is what its panel asks for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from clear_strategies.commands import view
from clear_strategies.core.images import to_bytes
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from tests.helpers import saved_run, toy

server = pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)

CAMERA = toy.camera(0.2)
POSE = np.linalg.inv(CAMERA.world_to_camera.double().numpy())
FOV = 2 * math.atan(CAMERA.height / 2 / CAMERA.fy)


def close(found, exact):
    assert found.shape == exact.shape
    assert np.abs(found.astype(int) - exact).max() <= 1


def test_the_viewer_shows_what_is_measured_or_its_depth_and_closes(tmp_path):
    saved_run.write(tmp_path)
    splat = open_splat(tmp_path)
    viewer = server.SplatViewer(splat.painter, splat.poses(), title="toy", port=8321, out=tmp_path)
    try:
        assert viewer.address.startswith("http://127.0.0.1:")
        close(viewer.draw(POSE, FOV, (96, 64)), to_bytes(splat.painter.color(CAMERA)))
        viewer._depth.value = True
        close(viewer.draw(POSE, FOV, (96, 64)), viewer.depth_scale.picture(splat.painter.depth(CAMERA)))
    finally:
        viewer.close()


@pytest.mark.parametrize(
    ("option", "value", "rule"),
    [
        ("--port", "-1", "0 to 65535"), ("--port", "65536", "0 to 65535"),
        ("--host", "192.0.2.1", "an address of this machine"),
    ],
)  # fmt: skip
def test_a_port_that_no_machine_has_and_an_address_of_another_machine_are_refused(option, value, rule):
    with pytest.raises(SettingError, match=f"^{option}: must be {rule}, got {value}"):
        view.main(["nowhere", option, value])
