"""What a painter shows is what the metrics see; the viewer draws what its panel asks for, and changes nothing of a run."""

import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import torch

import rasterizers
from clear_strategies.commands import view
from clear_strategies.core.images import to_bytes
from clear_strategies.errors import SettingError
from clear_strategies.jobs import exit_codes
from clear_strategies.jobs.saved import open_splat
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.look import Painter, colored, depth_range
from tests.helpers import toy, wall
from tests.helpers.command_line import TINY, run

SERVER = "clear_strategies.viewing.server"
CAMERA = toy.camera(0.2)
POSE = np.linalg.inv(CAMERA.world_to_camera.double().numpy())
FOV = 2 * math.atan(CAMERA.height / 2 / CAMERA.fy)


def make(**settings):
    return rasterizers.load("torch", **{"background": (0.2, 0.4, 0.6), **settings})


@pytest.fixture
def field(saved_run) -> GaussianField:
    return saved_run[1]


def test_the_picture_is_the_one_that_is_measured(field):
    exact = field.render(make(), CAMERA).clamp(0, 1)
    assert torch.equal(Painter(field, make).color(CAMERA), exact)


def test_depth_is_the_distance_of_what_is_seen():
    """A wall at z = 4, over a background that must not count."""
    depth = Painter(wall.painter().field, make).depth(wall.at(0.0))
    torch.testing.assert_close(depth, torch.full((40, 60), 4.0), atol=0.02, rtol=0)


def test_depth_is_unknown_where_nothing_is_and_numbers_are_blended_over_black(field):
    turned = replace(CAMERA, world_to_camera=torch.diag(torch.tensor([1.0, -1, -1, 1])) @ CAMERA.world_to_camera)
    depth = Painter(field, make).depth(turned)
    assert depth.isnan().all()
    picture = colored(depth, *depth_range(depth))
    assert (picture[0, 0] == 204).all()
    painter = Painter(field, make)
    ones = painter.numbers(CAMERA, torch.ones(len(field)))
    assert float(ones.min()) >= 0
    assert float(ones.max()) <= 1 + 1e-6
    torch.testing.assert_close(painter.numbers(CAMERA, torch.full((len(field),), 0.5)), ones / 2)


def numbered(splat):
    return {f"view{i}": camera for i, camera in enumerate(splat.poses())}


def close(found, exact):
    assert found.shape == exact.shape
    assert np.abs(found.astype(int) - exact).max() <= 1


def test_the_viewer_shows_what_is_measured_or_its_depth_and_closes(saved_run, tmp_path):
    server, splat = pytest.importorskip(SERVER, exc_type=ImportError), open_splat(saved_run[0])
    viewer = server.SplatViewer(splat.painter, numbered(splat), title="toy", port=8321, out=tmp_path)
    try:
        assert viewer.address.startswith("http://127.0.0.1:")
        close(viewer.draw(POSE, FOV, (96, 64)), to_bytes(splat.painter.color(CAMERA)))
        viewer._depth.value, depth = True, splat.painter.depth(CAMERA)
        close(viewer.draw(POSE, FOV, (96, 64)), colored(depth, *depth_range(depth)))
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


def test_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr(exit_codes, "find_spec", lambda name: None if name == "viser" else object())
    with pytest.raises(SettingError, match=r"the viewer needs viser: pip install 'clear-strategies\[view\]'"):
        exit_codes.require("view")


def test_a_viewer_is_there_while_a_run_trains_and_draws_between_two_iterations_alone(saved_run, monkeypatch):
    server = pytest.importorskip(SERVER, exc_type=ImportError)
    viewers, drawn = [], threading.Event()
    opened = server.SplatViewer

    def remembered(*arguments, **options):
        viewers.append(opened(*arguments, **options))
        return viewers[-1]

    monkeypatch.setattr(server, "SplatViewer", remembered)
    splat = open_splat(saved_run[0])

    def draw() -> None:  # as nerfview's threads do
        with viewers[0].lock:
            drawn.set()

    with server.watched(splat.painter, numbered(splat), "toy") as after_step:
        after_step(1)
        assert b"<html" in urlopen(viewers[0].address, timeout=20).read()  # noqa: S310 - our own address
        threading.Thread(target=draw).start()
        assert not drawn.wait(0.2)  # an iteration is under way
        monkeypatch.setattr(viewers[0].server, "get_clients", lambda: {0: None})
        monkeypatch.setattr(server, "_TURN", 0.5)
        after_step(2)
        assert drawn.is_set()
        viewers[0].state = "paused"
        threading.Timer(0.3, lambda: setattr(viewers[0], "state", "training")).start()
        began = time.monotonic()
        after_step(3)
        assert time.monotonic() - began > 0.25
    with pytest.raises(OSError, match="refused"):
        urlopen(viewers[0].address, timeout=20)  # noqa: S310


SMALL = [*TINY, "fit.probe_every=5000", "fit.threads=1", "prior=bicubic", "+strategy=gco"]


@pytest.mark.slow
def test_a_run_with_a_viewer_has_the_bits_of_one_without(tmp_path: Path):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    said = {}
    for name, overrides in {"plain": [], "viewed": ["fit.viewer=true"]}.items():
        done = run(*SMALL, *overrides, f"hydra.run.dir={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        said[name] = done.stdout + done.stderr
    assert "look while it trains" not in said["plain"]
    assert "look while it trains: http://127.0.0.1:" in said["viewed"]
    viewed, plain = ((tmp_path / name / "point_cloud.ply").read_bytes() for name in ("viewed", "plain"))
    assert viewed == plain
