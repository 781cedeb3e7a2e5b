"""The viewer in the browser: viser's page and nerfview's controls, and pictures drawn by the rasterizer of the run.

nerfview ends the process on an error in a thread that draws, and part of it runs in the thread that trains; viser checks nothing
of what a browser sends. So its camera (`get_camera_state`), its sizes (`_Sizes`), and errors of drawing and updates are dealt
with here: the browser gets the picture from its last camera, or a black one, and the log gets one line.

Heavy: it imports viser and nerfview, and is itself imported only once a viewer opens.
"""

from __future__ import annotations

import contextlib
import io
import logging
import math
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Literal
from weakref import WeakKeyDictionary

import nerfview
import numpy as np
import torch
import viser
from jaxtyping import Float
from nerfview._renderer import InterruptRenderException, Renderer

from clear_strategies.core.images import to_bytes
from clear_strategies.errors import one_line
from clear_strategies.geometry.cameras import looked_at
from clear_strategies.training import signals
from clear_strategies.viewing.look import Painter, Pixels, colored, depth_range
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_SIZE: Final = 1024  # px, longest edge of a picture at first
_SIZES: Final = {"viewer_res": (64, 2048), "render_width": (1, 4096), "render_height": (1, 4096)}  # px, least and most
_BLACK: Final = np.zeros((2, 2, 3), np.uint8)  # a page stretches any picture over itself
_FOV: Final = (1e-3, 3.1)  # radians
_ASPECT: Final = (1 / 25, 25.0)  # width by height: beyond, nerfview asks for pictures without pixels
_FARTHEST: Final = 1e9  # world units, of a camera from the origin
_PATIENCE: Final = 0.02  # seconds between looks at the button while the run is paused
_PICTURE: Final = 30.0  # seconds that the last picture may take once the viewer closes
_TURN: Final = 0.002  # seconds that the lock is free after an iteration, so that a thread that waits for it gets it


class _Sizes(nerfview.RenderTabState):  # type: ignore[misc]
    """nerfview's state of the panel, with sizes that can be drawn: a slider's range binds the page alone."""

    def __setattr__(self, name: str, value: Any) -> None:
        least, most = _SIZES.get(name, (None, None))
        super().__setattr__(name, value if least is None or most is None else min(max(value, least), most))


class SplatViewer(nerfview.Viewer):  # type: ignore[misc]  # nerfview has no types
    """nerfview's viewer of what a painter draws, and of its depth.

    Args:
        cameras: of the run; the first is where it begins.
        mode: "training": with its progress, and buttons that pause and resume it. nerfview draws while it holds `lock`.
    """

    def __init__(
        self, painter: Painter, cameras: Sequence[Camera], *, title: str, port: int = 8080, host: str = "127.0.0.1",
        out: Path | None = None, mode: Literal["rendering", "training"] = "rendering",
    ) -> None:  # fmt: skip
        self._painter, self._told = painter, set[tuple[str, int]]()
        self._drawable = WeakKeyDictionary[Any, Any]()  # the last camera of each browser
        # A browser that goes away while its picture is drawn.
        warnings.filterwarnings("ignore", message=".*it will never be delivered")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its address; whoever opens it does
            server = viser.ViserServer(host=host, port=port, verbose=False, label=title)
        if cameras:
            _aim(server, cameras)
        super().__init__(server, self._render, output_dir=out, mode=mode)
        server.gui.set_panel_label(title)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def get_camera_state(self, client: Any) -> Any:
        """The camera of a browser; where it sends what cannot be drawn, the last one that could, or else any."""
        try:
            state = super().get_camera_state(client)
            _require_drawable(state)
        except Exception as error:  # whatever viser and numpy make of it
            self._tell(error)
            return self._drawable.get(client, nerfview.CameraState(fov=1.0, aspect=1.0, c2w=np.eye(4)))
        self._drawable[client] = state
        return state

    def update(self, step: int, num_train_rays_per_step: int) -> None:
        """nerfview's, in the thread that trains: an error of a browser, such as one that leaves meanwhile, is logged."""
        try:
            super().update(step, num_train_rays_per_step)
        except Exception as error:
            self._tell(error)

    def close(self) -> None:
        """Stop serving and drawing: a thread that still drew when the process ends would abort it."""
        drawing = [thread for thread in threading.enumerate() if isinstance(thread, Renderer) and thread.viewer is self]
        for thread in drawing:
            thread.running = False
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        for thread in drawing:
            thread.join(_PICTURE)

    def draw(self, pose: Float[np.ndarray, "4 4"], fov: float, size: tuple[int, int]) -> Pixels:
        """The picture of `size` (width, height) pixels.

        Args:
            pose: camera to world, OpenCV axes. fov: vertical, radians.
        """
        width, height = size
        focal, world_to_camera = height / 2 / math.tan(fov / 2), np.linalg.inv(pose.astype(np.float64))
        camera = Camera(torch.from_numpy(world_to_camera), focal, focal, width / 2, height / 2, width, height)
        if not self._depth.value:
            return to_bytes(self._painter.color(camera))
        depth = self._painter.depth(camera)
        return colored(depth, *depth_range(depth))

    def _init_rendering_tab(self) -> None:
        super()._init_rendering_tab()
        self.render_tab_state = _Sizes()

    def _populate_rendering_tab(self) -> None:
        self._depth = self.server.gui.add_checkbox("Depth", False, order=0)
        self._depth.on_update(self.rerender)
        super()._populate_rendering_tab()
        self._rendering_tab_handles["viewer_res_slider"].value = self.render_tab_state.viewer_res = _SIZE
        self._rendering_folder.expand_by_default = False

    def _render(self, state: Any, tab: Any) -> Pixels:
        """Called by nerfview in a thread of each browser, which ends the process on an error: so none may pass."""
        size = (tab.render_width, tab.render_height) if tab.preview_render else (tab.viewer_width, tab.viewer_height)
        try:
            return self.draw(state.c2w, state.fov, size)
        except InterruptRenderException:  # by which nerfview itself stops a picture that nobody waits for any more
            raise
        except Exception as error:  # of memory, of anyone's rasterizer
            self._tell(error)
            return _BLACK

    def _tell(self, error: Exception) -> None:
        """Log an error, once for each line of code that raises it: it would come again in every frame."""
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        if (place := (frame.f_code.co_filename, line)) not in self._told:
            self._told.add(place)
            _log.warning("the viewer could not draw: %s: %s", type(error).__name__, one_line(error))


@contextlib.contextmanager
def watched(painter: Painter, cameras: Sequence[Camera], title: str) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields a function to call after each iteration, with its number.

    The caller holds nerfview's lock, except in that function: the field is never drawn while an iteration changes it, and the
    run's bits are those of a run without a viewer.
    """
    viewer = SplatViewer(painter, cameras, title=title, mode="training")
    _log.info("look while it trains: %s", viewer.address)
    held, began = viewer.lock.acquire(), time.monotonic()

    def after_step(iteration: int) -> None:
        nonlocal held, began
        # nerfview shares the time between both by the pixels of each a second: an iteration counts as one.
        viewer.render_tab_state.num_train_rays_per_sec = 1 / max(time.monotonic() - began, 1e-9)
        held = False
        viewer.lock.release()
        try:
            viewer.update(iteration, 1)
            if viewer.server.get_clients():
                time.sleep(_TURN)
            while viewer.state == "paused" and not signals.asked():
                time.sleep(_PATIENCE)
        finally:
            held = viewer.lock.acquire()
        began = time.monotonic()

    try:
        yield after_step
    finally:
        if held:  # else Ctrl-C came while it waited for a picture
            viewer.lock.release()
        viewer.close()


def _require_drawable(state: Any) -> None:
    """Raise a ValueError for a camera that no rasterizer should be asked to draw; NaN fails every comparison."""
    turned = abs(float(np.linalg.det(state.c2w[:3, :3])) - 1) < 1e-3 and float(np.abs(state.c2w).max()) < _FARTHEST
    if not (turned and _FOV[0] <= state.fov <= _FOV[1] and _ASPECT[0] <= state.aspect <= _ASPECT[1]):
        rule = f"a fov in {_FOV} rad, a width by height in {_ASPECT}, a rotation, and a position within {_FARTHEST:g}"
        got = f"{state.fov}, {state.aspect} and {state.c2w[:3].tolist()}"
        raise ValueError(f"a browser's camera must have {rule}, got {got}. Its last camera stays.")


def _aim(server: viser.ViserServer, cameras: Sequence[Camera]) -> None:
    """Look from the first camera at the distance of the point that all of them look at."""
    poses, first, start = [camera.world_to_camera.double() for camera in cameras], cameras[0], server.initial_camera
    up = -torch.stack(poses)[:, 1, :3].mean(0)
    server.scene.set_up_direction(tuple((up / up.norm().clamp_min(1e-9)).tolist()))
    distance = float((looked_at(cameras) - first.center.double()).norm())
    start.position = tuple(first.center.tolist())
    start.look_at = tuple((first.center.double() + distance * poses[0][2, :3]).tolist())
    start.up = tuple((-poses[0][1, :3]).tolist())
    start.fov = 2 * math.atan(first.height / 2 / first.fy)
