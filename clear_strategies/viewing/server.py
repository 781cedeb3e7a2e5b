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
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Literal
from weakref import WeakKeyDictionary

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
_NONE: Final = np.zeros((1, 1, 3), np.uint8)
_PHOTO: Final = 300  # px, the width of the panel: an LR photo has less
_TURN: Final = 0.002  # seconds that the lock is free after an iteration, so that a thread that waits for it gets it

Photos = Callable[[str], Pixels | None]


class _Sizes(nerfview.RenderTabState):  # type: ignore[misc]
    """nerfview's state of the panel, with sizes that can be drawn: a slider's range binds the page alone."""

    def __setattr__(self, name: str, value: Any) -> None:
        least, most = _SIZES.get(name, (None, None))
        super().__setattr__(name, value if least is None or most is None else min(max(value, least), most))


class SplatViewer(nerfview.Viewer):  # type: ignore[misc]  # nerfview has no types
    """nerfview's viewer of what a painter draws, and of its depth; a choice of cameras moves it to one, and shows its photo.

    Args:
        cameras: of the run, by name; the first is where it begins.
        photo: the photo of a camera by its name; None where there is none.
        mode: "training": with its progress, and buttons that pause and resume it. nerfview draws while it holds `lock`.
    """

    def __init__(
        self, painter: Painter, cameras: Mapping[str, Camera], *, title: str, photo: Photos = lambda _: None,
        port: int = 8080, host: str = "127.0.0.1", out: Path | None = None,
        mode: Literal["rendering", "training"] = "rendering",
    ) -> None:  # fmt: skip
        self._painter, self._cameras, self._photo = painter, cameras, photo
        self._told = set[tuple[str, int]]()
        self._drawable = WeakKeyDictionary[Any, Any]()  # the last camera of each browser
        # A browser that goes away while its picture is drawn.
        warnings.filterwarnings("ignore", message=".*it will never be delivered")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its address; whoever opens it does
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
            self._say(f"Drawn: the colour of {len(self._painter.field):,} Gaussians, as the metrics see it.")
            return to_bytes(self._painter.color(camera))
        depth = self._painter.depth(camera)
        near, far = depth_range(depth)
        self._say(f"Drawn: depth, bright at {near:.3g} and dark at {far:.3g} world units; grey where nothing is.")
        return colored(depth, near, far)

    def _say(self, drawn: str) -> None:
        if self._drawn.content != drawn:
            self._drawn.content = drawn

    def _jump(self, client: viser.ClientHandle, name: str) -> None:
        """Look from a camera, so that its whole photo is seen."""
        camera, seen = self._cameras[name], client.camera
        with client.atomic():
            seen.position, seen.look_at, seen.up_direction = _stand(camera, looked_at(list(self._cameras.values())))
            seen.fov = 2 * math.atan(max(camera.height / camera.fy, camera.width / camera.fx / seen.aspect) / 2)

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
            shown = gui.add_image(_NONE, label="Its photo", order=0, visible=False)

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
def watched(
    painter: Painter, cameras: Mapping[str, Camera], title: str, photo: Photos = lambda _: None
) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields a function to call after each iteration, with its number.

    The caller holds nerfview's lock, except in that function: the field is never drawn while an iteration changes it, and the
    run's bits are those of a run without a viewer.
    """
    viewer = SplatViewer(painter, cameras, title=title, photo=photo, mode="training")
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
    up = -torch.stack([camera.world_to_camera.double() for camera in cameras])[:, 1, :3].mean(0)
    server.scene.set_up_direction(tuple((up / up.norm().clamp_min(1e-9)).tolist()))
    stand, first, start = _stand(cameras[0], looked_at(cameras)), cameras[0], server.initial_camera
    start.position, start.look_at, start.up = stand
    start.fov = 2 * math.atan(first.height / 2 / first.fy)


Vector = tuple[float, float, float]


def _stand(camera: Camera, focus: Float[Tensor, " 3"]) -> tuple[Vector, Vector, Vector]:
    """Where a camera is, what it looks at, at the distance of `focus`, and where up is."""
    pose, center = camera.world_to_camera.double(), camera.center.double()
    distance = float((focus - center).norm())
    x, y, z = (tuple(v.tolist()) for v in (center, center + distance * pose[2, :3], -pose[1, :3]))
    return x, y, z
