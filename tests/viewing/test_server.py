"""What the viewer draws is what its panel asks for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from clear_strategies.commands import view
from clear_strategies.core.images import to_bytes
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.viewing.look import Look
from tests.helpers import saved_run, toy

server = pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)

CAMERA = toy.camera(0.2)
POSE = np.linalg.inv(CAMERA.world_to_camera.double().numpy())
FOV = 2 * math.atan(CAMERA.height / 2 / CAMERA.fy)


@pytest.fixture(scope="module")
def splat(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    saved_run.write(folder)
    return open_splat(folder)


@pytest.fixture
def screen(splat):
    return server.Screen(splat.painter, splat.cameras)


def close(found, exact):
    assert found.shape == exact.shape
    assert np.abs(found.astype(int) - exact).max() <= 1


@pytest.mark.parametrize("look", [Look(), Look(detail=False, sh=False)])
def test_the_window_shows_what_is_measured_and_switches_reach_the_picture(screen, splat, look):
    close(screen.draw(server.View(look=look), POSE, FOV, (96, 64)), to_bytes(splat.painter.color(CAMERA, look)))
    depth = screen.depth_scale.picture(splat.painter.depth(CAMERA, look))
    close(screen.draw(server.View("depth", look), POSE, FOV, (96, 64)), depth)


def test_the_viewer_opens_and_closes(splat, screen):
    viewer = server.SplatViewer(screen, title="toy", port=8321, out=splat.folder)
    try:
        assert viewer.address.startswith("http://127.0.0.1:")
        assert viewer.view() == server.View()
        viewer._switches["detail"].value = False
        assert not viewer.view().look.detail
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
