"""What a painter shows is what the metrics see; the viewer draws what its panel asks for, and changes nothing of a run."""

import itertools
import math
import os
import signal
import threading
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from urllib.request import urlopen

import msgspec
import numpy as np
import pytest
import torch

import rasterizers
from clear_strategies.core.images import to_bytes
from clear_strategies.errors import SettingError
from clear_strategies.jobs import exit_codes
from clear_strategies.jobs.saved import open_splat
from clear_strategies.signals import deferred_signals
from clear_strategies.training.field import GaussianField
from clear_strategies.viewing.look import Painter, colored, depth_range
from tests.helpers import toy, wall
from tests.helpers.command_line import TINY, run

SERVER = "clear_strategies.viewing.server"
PATIENCE = 120  # seconds, on a machine that is busy
CAMERA = toy.camera(0.2)
POSE = np.linalg.inv(CAMERA.world_to_camera.double().numpy())
FOV = 2 * math.atan(CAMERA.height / 2 / CAMERA.fy)


def make(**settings):
    return rasterizers.load("torch", **{"background": (0.2, 0.4, 0.6), **settings})


@pytest.fixture
def field(saved_run) -> GaussianField:
    return saved_run[1]


@pytest.fixture
def server() -> ModuleType:
    return pytest.importorskip(SERVER, exc_type=ImportError)


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
    ones = painter.numbers(CAMERA, torch.ones(len(field), 3))
    assert float(ones.min()) >= 0
    assert float(ones.max()) <= 1 + 1e-6
    torch.testing.assert_close(painter.numbers(CAMERA, torch.full((len(field), 3), 0.5)), ones / 2)


def numbered(splat):
    return {f"view{i}": camera for i, camera in enumerate(splat.poses())}


def close(found, exact):
    assert found.shape == exact.shape
    assert np.abs(found.astype(int) - exact).max() <= 1


def test_the_viewer_shows_what_is_measured_or_its_depth(server, saved_run, tmp_path):
    splat = open_splat(saved_run[0])
    viewer = server.SplatViewer(splat.painter, numbered(splat), title="toy", port=8321, out=tmp_path)
    try:
        assert viewer.address.startswith("http://127.0.0.1:")
        close(viewer.draw(POSE, FOV, (96, 64)), to_bytes(splat.painter.color(CAMERA)))
        viewer._depth.value, depth = True, splat.painter.depth(CAMERA)
        close(viewer.draw(POSE, FOV, (96, 64)), colored(depth, *depth_range(depth)))
    finally:
        viewer.close()


@pytest.mark.parametrize(("host", "named"), [("::1", "http://[::1]:8080"), ("0.0.0.0", "http://0.0.0.0:8080")])  # noqa: S104
def test_the_address_is_one_that_a_browser_opens(server, host, named):
    serving = SimpleNamespace(get_host=lambda: host, get_port=lambda: 8080)
    assert server.SplatViewer.address.fget(SimpleNamespace(server=serving)) == named


def test_missing_libraries_are_named(monkeypatch):
    monkeypatch.setattr(exit_codes, "find_spec", lambda name: None if name == "viser" else object())
    with pytest.raises(SettingError, match=r"the viewer needs viser: pip install 'clear-strategies\[view\]'"):
        exit_codes.require("view")


@pytest.fixture
def watched(server, saved_run, monkeypatch):
    """The viewer of a run that trains, and what the run calls after each iteration. The viewer closes, whatever happens to it."""
    viewers, splat = [], open_splat(saved_run[0])

    def refuse(code: int) -> None:  # in nerfview's thread, which then ends alone
        viewers[0].ended = True
        raise SystemExit(code)

    def remembered(*arguments, **options):  # at a port that no other test's viewer takes once it is free
        viewers.append(opened(*arguments, **options, port=0))
        return viewers[0]

    monkeypatch.setattr("nerfview._renderer.os._exit", refuse)
    opened = server.SplatViewer
    monkeypatch.setattr(server, "SplatViewer", remembered)
    with server.watched(splat.painter, numbered(splat), "toy") as after_step:
        yield viewers[0], after_step
    assert not hasattr(viewers[0], "ended"), "nerfview has ended the process"
    assert not [t for t in threading.enumerate() if isinstance(t, server.Renderer)], "it still draws"
    with pytest.raises(OSError, match="refused"):
        urlopen(viewers[0].address, timeout=PATIENCE)  # noqa: S310 - our own address


def test_a_viewer_is_there_while_a_run_trains_and_draws_between_two_iterations_alone(server, watched, monkeypatch):
    (viewer, after_step), drawn = watched, threading.Event()

    def draw() -> None:  # as nerfview's threads do
        with viewer.lock:
            drawn.set()

    after_step(1)
    assert b"<html" in urlopen(viewer.address, timeout=PATIENCE).read()  # noqa: S310
    threading.Thread(target=draw).start()
    assert not drawn.wait(0.2)  # an iteration is under way
    monkeypatch.setattr(viewer.server, "get_clients", lambda: {0: None})
    with monkeypatch.context() as patched:  # its turn lasts until it has drawn
        patched.setattr(server, "time", SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: drawn.wait(60)))
        after_step(2)
    assert drawn.is_set()
    viewer.state, began = "paused", time.monotonic()
    threading.Timer(0.3, lambda: setattr(viewer, "state", "training")).start()
    after_step(3)
    assert time.monotonic() - began > 0.25
    viewer.state = "paused"
    with deferred_signals() as pending:
        os.kill(os.getpid(), signal.SIGTERM)
        after_step(4)  # a paused run is saved, too
    assert pending == [signal.SIGTERM]


class Browser:
    """Speaks viser's protocol with the viewer of a run that trains, as its page does, and keeps the pictures that it is sent."""

    def __init__(self, viewer, after_step) -> None:
        self.viewer, self.after_step, self.pictures, self.steps = viewer, after_step, [], itertools.count(10)
        viser, connect = import_module("viser"), import_module("websockets.sync.client").connect
        self.socket = connect(
            f"ws{viewer.address[4:]}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None, close_timeout=0.1
        )
        viewer.render_tab_state.viewer_res = 64
        self.camera()
        self.after_step(next(self.steps))  # a run that has trained, even if viser lists the browser by now
        self.train_until(viewer.server.get_clients)
        (client,) = viewer.server.get_clients().values()
        client.scene.set_background_image = lambda image, **_: self.pictures.append(image)

    def send(self, kind: str, **fields) -> None:
        self.socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def camera(self, **fields) -> None:
        of_page = {"wxyz": (1, 0, 0, 0), "position": (0, 0, -3), "fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 40,
                   "image_width": 60, "look_at": (0, 0, 0), "up_direction": (0, -1, 0)}  # fmt: skip
        self.send("ViewerCameraMessage", **{**of_page, **fields})

    def slide(self, handle, value) -> None:
        self.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})

    def train_until(self, condition) -> None:
        began = time.monotonic()
        while not condition():
            assert time.monotonic() < began + PATIENCE, "the viewer has stopped"
            self.after_step(next(self.steps))
            time.sleep(0.005)

    def sees(self, **camera) -> np.ndarray:
        """The picture from a camera."""
        for _ in range(2):  # the first may have been under way
            self.pictures.clear()
            self.camera(**camera)
            self.train_until(lambda: self.pictures)
        return self.pictures[-1]


@pytest.fixture
def browser(watched):
    browser = Browser(*watched)
    yield browser
    browser.socket.close()


NO_CAMERA = {
    "fov": [0, -1.0, math.nan, math.inf, 1e-12, math.pi, 7],
    "image_width": [0, -60, 10**12],
    "image_height": [0, -40, 10**12],
    "wxyz": [(0, 0, 0, 0), (math.nan,) * 4, (1e300, 0, 0, 1)],
    "position": [(math.nan, 0, 0), (0, 0, math.inf), (0, 0, 1e300)],
    "look_at": [(math.nan,) * 3], "up_direction": [(0, 0, 0)], "near": [math.nan], "far": [-1.0],
}  # fmt: skip


def test_a_training_and_its_viewer_go_on_whatever_camera_a_browser_sends(browser, caplog):
    for field, values in NO_CAMERA.items():
        caplog.clear()
        for value in values:
            browser.sees(**{field: value})
        assert caplog.text.count("the viewer could not draw") <= len(values)
        assert browser.sees().std() > 0, field


def test_a_message_that_is_none_loses_its_browser_the_connection_and_the_training_nothing(browser):
    browser.camera(fov="wide")
    browser.train_until(lambda: not browser.viewer.server.get_clients())
    other = Browser(browser.viewer, browser.after_step)
    assert other.sees().any()
    other.socket.close()


SLIDERS = {
    "viewer_res_slider": [0, -5, 10**9, "many"],
    "render_res_vec2": [(0, 0), (-5, 10), (10**9, 10**9), (math.nan, 1)],
    "fov_degrees_slider": [0, 360, math.nan],
    "train_util_slider": [1.0, 2.0, -1.0, math.nan],
}


@pytest.mark.parametrize("preview", [False, True])
def test_a_training_and_its_viewer_go_on_whatever_a_slider_is_set_to(preview, browser, monkeypatch):
    viewer = browser.viewer
    for size in ("viewer_res", "render_width", "render_height"):
        monkeypatch.setitem(import_module(SERVER)._SIZES, size, (64, 128))
        setattr(viewer.render_tab_state, size, 128)
    viewer._painter.color = lambda camera: torch.rand(camera.height, camera.width, 3)
    viewer.render_tab_state.preview_render = preview
    for handle, values in SLIDERS.items():
        for value in values:
            browser.slide((viewer._rendering_tab_handles | viewer._training_tab_handles)[handle], value)
            assert max(browser.sees().shape[:2]) <= 128


def test_an_error_of_the_rasterizer_is_one_line_and_a_black_picture(browser, monkeypatch, caplog):
    def fail(camera):
        raise MemoryError("is\nbroken")

    monkeypatch.setattr(browser.viewer._painter, "color", fail)
    for _ in range(2):
        assert not browser.sees().any()
    (line,) = [record.getMessage() for record in caplog.records if "the viewer could not draw" in record.message]
    assert line.startswith("the viewer could not draw: MemoryError: ")
    assert "\n" not in line
    monkeypatch.undo()
    assert browser.sees().any()


def test_a_picture_that_nerfview_stops_is_drawn_again_and_is_no_error(browser, monkeypatch, caplog):
    stopped, color = [], browser.viewer._painter.color

    def stop_once(camera):
        if not stopped:
            stopped.append(True)
            raise import_module(SERVER).InterruptRenderException
        return color(camera)

    monkeypatch.setattr(browser.viewer._painter, "color", stop_once)
    assert browser.sees().any()
    assert stopped
    assert "could not draw" not in caplog.text


def test_a_training_goes_on_where_a_browser_leaves_while_it_is_updated(browser, monkeypatch, caplog):
    viewer = browser.viewer
    viewer.render_tab_state.num_train_rays_per_sec = 1  # a second an iteration: a picture is due at each step below
    with monkeypatch.context() as patched:
        patched.setattr(viewer, "_renderers", {"gone": None})  # viser still lists the browser
        for step in (10**6, 2 * 10**6):
            viewer.update(step, 1)
    assert caplog.text.count("the viewer could not draw: KeyError") == 1
    assert browser.sees().any()


def test_ctrl_c_while_a_training_waits_for_a_picture_is_not_hidden_by_an_error_of_the_viewer(
    server, saved_run, monkeypatch
):
    splat, lock = open_splat(saved_run[0]), threading.Lock()

    class Interrupted:
        release = lock.release

        def acquire(self) -> bool:
            if hasattr(self, "drawing"):
                raise KeyboardInterrupt
            self.drawing = True
            return lock.acquire()

    monkeypatch.setattr("nerfview.viewer.VIEWER_LOCK", Interrupted())
    with pytest.raises(KeyboardInterrupt), server.watched(splat.painter, numbered(splat), "toy") as after_step:
        after_step(1)


SMALL = [*TINY, "fit.probe_every=5000", "fit.threads=1", "prior=bicubic", "+strategy=gco"]


@pytest.mark.slow
@pytest.mark.usefixtures("server")
def test_a_run_with_a_viewer_has_the_bits_of_one_without(tmp_path: Path):
    said = {}
    for name, overrides in {"plain": [], "viewed": ["fit.viewer=true"]}.items():
        done = run(*SMALL, *overrides, f"hydra.run.dir={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        said[name] = done.stdout + done.stderr
    assert "look while it trains" not in said["plain"]
    assert "look while it trains: http://127.0.0.1:" in said["viewed"]
    viewed, plain = ((tmp_path / name / "point_cloud.ply").read_bytes() for name in ("viewed", "plain"))
    assert viewed == plain
