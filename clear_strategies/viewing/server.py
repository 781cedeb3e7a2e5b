"""The viewer in the browser: viser's page and nerfview's controls, with images drawn by the rasterizer of the run.

nerfview ends the process on an error in a thread that draws, and part of it runs in the training thread; viser does not check
what a browser sends. Therefore the sizes of images (`_Sizes`, `_ASPECT`) are clamped here, and errors of drawing and updates
caught: the browser gets a black image, e.g. for a camera that `Camera` refuses, and one line is logged.

Heavy: it imports viser and nerfview, and is itself imported only when a viewer opens.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal

import nerfview
import numpy as np
import torch
import viser
from jaxtyping import Float
from nerfview._renderer import InterruptRenderException, Renderer
from torch import Tensor

from clear_strategies import signals
from clear_strategies.core.images import to_bytes
from clear_strategies.errors import one_line
from clear_strategies.geometry.cameras import looked_at
from clear_strategies.viewing.cameras import up
from clear_strategies.viewing.look import Painter, Pixels, colored, depth_range
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_SIZE: Final = 1024  # px, longest edge of a picture at first
_SIZES: Final = {"viewer_res": (64, 2048), "render_width": (1, 4096), "render_height": (1, 4096)}  # px, least and most
_BLACK: Final = np.zeros((2, 2, 3), np.uint8)  # the page stretches images of any size
_ASPECT: Final = (1 / 25, 25.0)  # width by height; beyond this range, nerfview requests images without pixels
_POLL: Final = 0.02  # seconds between checks of the button while the run is paused
_PICTURE: Final = 30.0  # seconds that closing waits for the last image
_PHOTO: Final = 300  # px, the width of the panel, to which LR photos are enlarged
_RELEASED: Final = 0.002  # seconds that the lock is free after an iteration, so that a waiting thread acquires it

Photos = Callable[[str], Pixels | None]


class _Sizes(nerfview.RenderTabState):  # type: ignore[misc]
    """nerfview's state of the panel, with sizes clamped to what can be drawn: a slider's range is enforced by the page only."""

    def __setattr__(self, name: str, value: Any) -> None:
        least, most = _SIZES.get(name, (None, None))
        super().__setattr__(name, value if least is None or most is None else min(max(value, least), most))


class SplatViewer(nerfview.Viewer):  # type: ignore[misc]  # nerfview has no types
    """nerfview's viewer of a painter's images and depth, with a list of cameras to jump to, and their photos.

    Args:
        cameras: of the run, by name; the view starts at the first.
        photo: returns the photo of a camera by its name; None if there is none.
        mode: "training" adds progress, and buttons that pause and resume training. nerfview draws while it holds `lock`.
    """

    def __init__(
        self, painter: Painter, cameras: Mapping[str, Camera], *, title: str, photo: Photos = lambda _: None,
        port: int = 8080, host: str = "127.0.0.1", out: Path | None = None,
        mode: Literal["rendering", "training"] = "rendering",
    ) -> None:  # fmt: skip
        self._painter, self._cameras, self._photo = painter, cameras, photo
        self._logged = set[tuple[str, int]]()  # lines of code whose errors have been logged
        # viser's, of a browser that disconnects while its image is drawn.
        warnings.filterwarnings("ignore", message=".*it will never be delivered")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its address, as the caller does
            server = viser.ViserServer(host=host, port=port, verbose=False, label=title)
        if cameras:
            _aim(server, list(cameras.values()))
        super().__init__(server, self._render, output_dir=out, mode=mode)
        server.gui.set_panel_label(title)
        # nerfview's theme, without the button that uploads the scene.
        server.gui.configure_theme(
            control_layout="collapsible", dark_mode=True, show_logo=False, show_share_button=False
        )

    @property
    def address(self) -> str:
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def get_camera_state(self, client: Any) -> Any:
        """The camera of a browser, its aspect clamped; a default one if viser knows none."""
        try:
            state = super().get_camera_state(client)
        except Exception as error:  # of any type, raised by viser or numpy
            self._log_once(error)
            return nerfview.CameraState(fov=1.0, aspect=1.0, c2w=np.eye(4))
        least, most = _ASPECT
        state.aspect = min(most, max(least, state.aspect))  # `least` for NaN
        return state

    def update(self, step: int, num_train_rays_per_step: int) -> None:
        """Call nerfview's update, in the training thread, and log errors, e.g. of a browser that disconnects."""
        try:
            super().update(step, num_train_rays_per_step)
        except Exception as error:
            self._log_once(error)

    def close(self) -> None:
        """Stop serving and drawing: a thread that still draws when the process ends would abort it."""
        drawing = [thread for thread in threading.enumerate() if isinstance(thread, Renderer) and thread.viewer is self]
        for thread in drawing:
            thread.running = False
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()
        for thread in drawing:
            thread.join(_PICTURE)

    def draw(self, pose: Float[np.ndarray, "4 4"], fov: float, size: tuple[int, int]) -> Pixels:
        """Draw an image of `size` (width, height) pixels.

        Args:
            pose: camera to world, OpenCV axes. fov: vertical, radians.
        """
        width, height = size
        focal, world_to_camera = height / 2 / math.tan(fov / 2), np.linalg.inv(pose.astype(np.float64))
        camera = Camera(torch.from_numpy(world_to_camera), focal, focal, width / 2, height / 2, width, height)
        if not self._depth.value:
            self._caption(f"Drawn: the colour of {len(self._painter.field):,} Gaussians, as the metrics see it.")
            return to_bytes(self._painter.color(camera))
        depth = self._painter.depth(camera)
        near, far = depth_range(depth)
        self._caption(f"Drawn: depth, bright at {near:.3g} and dark at {far:.3g} world units; grey where nothing is.")
        return colored(depth, near, far)

    def _caption(self, drawn: str) -> None:
        """Set the caption, which is sent to browsers only if it changes."""
        if self._drawn.content != drawn:
            self._drawn.content = drawn

    def _jump(self, client: viser.ClientHandle, name: str) -> None:
        """Move a browser's view to a camera, with its whole photo in view."""
        camera, view = self._cameras[name], client.camera
        with client.atomic():
            view.position, view.look_at, view.up_direction = _look_at(camera, looked_at(list(self._cameras.values())))
            view.fov = 2 * math.atan(max(camera.height / camera.fy, camera.width / camera.fx / view.aspect) / 2)

    def _init_rendering_tab(self) -> None:
        super()._init_rendering_tab()
        self.render_tab_state = _Sizes()

    def _populate_rendering_tab(self) -> None:
        gui = self.server.gui
        self._drawn = gui.add_markdown("", order=-1)
        self._depth = gui.add_checkbox("Depth", False, order=0)
        self._depth.on_update(self.rerender)
        if self._cameras:
            chosen = gui.add_dropdown("Camera", tuple(self._cameras), order=0, hint="Look from the place of a photo.")
            again = gui.add_button("Look from it again", order=0)
            shown = gui.add_image(_BLACK, label="Its photo", order=0, visible=False)

            def show_photo() -> None:
                photo = self._photo(chosen.value)
                shown.visible = photo is not None
                if photo is not None:
                    times = -(-_PHOTO // photo.shape[1])
                    shown.image = photo.repeat(times, 0).repeat(times, 1)

            def jump(event: Any) -> None:
                show_photo()
                if event.client is not None:
                    self._jump(event.client, chosen.value)

            show_photo()
            chosen.on_update(jump)
            again.on_click(jump)
        super()._populate_rendering_tab()
        self._rendering_tab_handles["viewer_res_slider"].value = self.render_tab_state.viewer_res = _SIZE
        self._rendering_folder.expand_by_default = False

    def _render(self, state: Any, tab: Any) -> Pixels:
        """Draw for nerfview, which calls this in a thread of each browser and ends the process on an error: none may pass."""
        size = (tab.render_width, tab.render_height) if tab.preview_render else (tab.viewer_width, tab.viewer_height)
        try:
            return self.draw(state.c2w, state.fov, size)
        except InterruptRenderException:  # nerfview stops an image that is no longer needed
            raise
        except Exception as error:  # of any type, e.g. raised by a user's rasterizer
            self._log_once(error)
            return _BLACK

    def _log_once(self, error: Exception) -> None:
        """Log an error once for each line of code that raises it: it would be raised again in every frame."""
        *_, (frame, line) = traceback.walk_tb(error.__traceback__)
        if (place := (frame.f_code.co_filename, line)) not in self._logged:
            self._logged.add(place)
            _log.warning("the viewer could not draw: %s: %s", type(error).__name__, one_line(error))


@contextlib.contextmanager
def watched(
    painter: Painter, cameras: Mapping[str, Camera], title: str, photo: Photos = lambda _: None
) -> Iterator[Callable[[int], None]]:
    """Open a viewer during training. Yields a function to call after each iteration, with its number.

    The caller holds nerfview's lock, except in that function, so that the field is never drawn while an iteration changes it. The
    run's bits are those of a run without a viewer.
    """
    viewer = SplatViewer(painter, cameras, title=title, photo=photo, mode="training")
    _log.info("look while it trains: %s", viewer.address)
    held, began = viewer.lock.acquire(), time.monotonic()

    def after_step(iteration: int) -> None:
        nonlocal held, began
        # nerfview divides time between drawing and training by their pixels per second; an iteration counts as one pixel.
        viewer.render_tab_state.num_train_rays_per_sec = 1 / max(time.monotonic() - began, 1e-9)
        held = False
        viewer.lock.release()
        try:
            viewer.update(iteration, 1)
            if viewer.server.get_clients():
                time.sleep(_RELEASED)
            while viewer.state == "paused" and not signals.asked():
                time.sleep(_POLL)
        finally:
            held = viewer.lock.acquire()
        began = time.monotonic()

    try:
        yield after_step
    finally:
        if held:  # else interrupted by Ctrl-C while waiting for an image
            viewer.lock.release()
        viewer.close()


def _aim(server: viser.ViserServer, cameras: Sequence[Camera]) -> None:
    """Set the initial view: from the first camera, at the point on its axis as far away as the point that all look at."""
    server.scene.set_up_direction(up(cameras))
    first, view = cameras[0], server.initial_camera
    view.position, view.look_at, view.up = _look_at(first, looked_at(cameras))
    view.fov = 2 * math.atan(first.height / 2 / first.fy)


Vector = tuple[float, float, float]


def _look_at(camera: Camera, focus: Float[Tensor, " 3"]) -> tuple[Vector, Vector, Vector]:
    """(position, point on the axis at the distance of `focus`, up) of a camera."""
    pose, center = camera.world_to_camera.double(), camera.center.double()
    distance = float((focus - center).norm())
    x, y, z = (tuple(v.tolist()) for v in (center, center + distance * pose[2, :3], -pose[1, :3]))
    return x, y, z
