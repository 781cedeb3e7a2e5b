"""The viewer in the browser: viser's page and nerfview's controls, and pictures drawn by the rasterizer of the run.

Heavy: it imports viser and nerfview, and is itself imported only once a viewer opens.
"""

from __future__ import annotations

import contextlib
import functools
import io
import logging
import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import nerfview
import numpy as np
import torch
import viser
import viser.transforms
from jaxtyping import Float

from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import read_image
from clear_strategies.viewing import paths
from clear_strategies.viewing.cameras import SavedCamera, at_most
from clear_strategies.viewing.look import AS_MEASURED, DepthScale, Look, Painter
from clear_strategies.viewing.video import Pixels
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_COLOR, _DEPTH = SHOWN = ("color", "depth")
_SMALL: Final = 96  # px, longest edge of the pictures that the colours of depth are chosen by
_SIZE: Final = 1024  # px, longest edge of a picture at first
_MOST_FRUSTUMS: Final = 200
_LENGTH: Final = 0.12  # of a camera in the scene, in mean distances from the cameras to what they look at
_PATIENCE: Final = 0.02  # seconds between looks at the button while the run is paused
_TURN: Final = 0.002  # seconds that the lock is free after an iteration, so that a thread that waits for it gets it


@dataclass(frozen=True, slots=True)
class View:
    """The choices of the panel; `show` is one of `SHOWN`."""

    show: str = _COLOR
    look: Look = AS_MEASURED


@dataclass(frozen=True, eq=False)
class Screen:
    """Draws what a browser's camera sees, by the cameras of the run."""

    painter: Painter
    cameras: Sequence[SavedCamera]

    def draw(self, view: View, pose: Float[np.ndarray, "4 4"], fov: float, size: tuple[int, int]) -> Pixels:
        """The picture of `size` (width, height) pixels.

        Args:
            pose: camera to world, OpenCV axes. fov: vertical, radians.
        """
        width, height = size
        focal, world_to_camera = height / 2 / math.tan(fov / 2), np.linalg.inv(pose.astype(np.float64))
        camera = Camera(torch.from_numpy(world_to_camera), focal, focal, width / 2, height / 2, width, height)
        if view.show == _DEPTH:
            return self.depth_scale.picture(self.painter.depth(camera, view.look))
        return to_bytes(self.painter.color(camera, view.look))

    @functools.cached_property
    def depth_scale(self) -> DepthScale:
        """From the cameras of the run; 0 to 10 where none is known."""
        cameras = [at_most(saved.camera, _SMALL) for saved in self.cameras]
        return DepthScale.of(self.painter, cameras) if cameras else DepthScale(0.0, 10.0)


class SplatViewer(nerfview.Viewer):  # type: ignore[misc]  # nerfview has no types
    """nerfview's viewer with the switches of `View` and the cameras of the run.

    Args:
        mode: "training": with its progress, and buttons that pause and resume it. nerfview draws while it holds `lock`.
    """

    def __init__(
        self, screen: Screen, *, title: str, port: int = 8080, host: str = "127.0.0.1", out: Path | None = None,
        mode: Literal["rendering", "training"] = "rendering",
    ) -> None:  # fmt: skip
        self._screen, self._failed = screen, ""
        # A browser that goes away while its picture is drawn.
        warnings.filterwarnings("ignore", message=".*it will never be delivered")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its address; whoever opens it does
            server = viser.ViserServer(host=host, port=port, verbose=False, label=title)
        aim(server, [saved.camera for saved in screen.cameras])
        super().__init__(server, self._render, output_dir=out, mode=mode)
        server.gui.set_panel_label(title)
        self._add_cameras([saved for saved in screen.cameras if saved.split == "train"][:_MOST_FRUSTUMS])

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def view(self) -> View:
        """The choices of the panel now."""
        values = {name: switch.value for name, switch in self._switches.items()}
        return View(values.pop("show"), Look(**values))

    def serve_until_stopped(self) -> None:
        """Wait for Ctrl-C."""
        try:
            while True:
                time.sleep(0.5)
        except KeyboardInterrupt:
            self.close()

    def close(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _populate_rendering_tab(self) -> None:
        """Ours, then nerfview's own."""
        gui = self.server.gui
        with gui.add_folder("Look", order=0):
            self._switches: dict[str, Any] = {
                "show": gui.add_dropdown("Show", SHOWN),
                "sh": gui.add_checkbox("SH", True, hint="colour depends on the direction"),
                "detail": gui.add_checkbox("f_det", True, hint="the detail that HR renders add and LR renders do not"),
                "filter_3d": gui.add_checkbox("3D filter", True, hint="Mip-Splatting: no Gaussian thinner than a pixel"),
                "mip": gui.add_checkbox("2D Mip filter", True, hint="off: 3DGS's blur of 0.3 px²"),
            }  # fmt: skip
            for handle in self._switches.values():
                handle.on_update(self.rerender)
        super()._populate_rendering_tab()
        self._rendering_tab_handles["viewer_res_slider"].value = self.render_tab_state.viewer_res = _SIZE
        self._rendering_folder.expand_by_default = False

    def _render(self, state: Any, tab: Any) -> Pixels:
        """Called by nerfview in a thread of each browser, which ends the process on an error: so none may pass."""
        size = (tab.render_width, tab.render_height) if tab.preview_render else (tab.viewer_width, tab.viewer_height)
        try:
            return self._screen.draw(self.view(), state.c2w, state.fov, size)
        except (RuntimeError, ValueError) as error:
            if str(error) != self._failed:  # once, not in every frame
                self._failed = str(error)
                _log.warning("the viewer could not draw: %s", error)
            return np.zeros((size[1], size[0], 3), np.uint8)

    def _add_cameras(self, train: Sequence[SavedCamera]) -> None:
        """Draw the training cameras, each of which a click goes to, and a switch that shows them."""
        if not train:
            return
        focus = paths.look_at([saved.camera for saved in train])
        distances = [np.linalg.norm(saved.camera.center.double().numpy() - focus) for saved in train]
        length = _LENGTH * float(np.mean(distances))
        frustums = []
        for saved in train:
            camera = saved.camera
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{saved.name}", fov=vertical_fov(camera), aspect=camera.width / camera.height, scale=length,
                wxyz=wxyz(camera), position=tuple(camera.center.tolist()), color=(255, 180, 60), visible=False,
                image=None if saved.photo is None else to_bytes(read_image(saved.photo)),
            )  # fmt: skip
            frustum.on_click(functools.partial(_go_to, camera))
            frustums.append(frustum)
        with self.server.gui.add_folder("Training cameras", order=1):
            shown = self.server.gui.add_checkbox("Show, with their photos", False, hint="a click on one goes there")

        def show(_: Any) -> None:
            for frustum in frustums:
                frustum.visible = shown.value

        shown.on_update(show)


def _go_to(camera: Camera, event: Any) -> None:
    with event.client.atomic():
        event.client.camera.wxyz = wxyz(camera)
        event.client.camera.position = tuple(camera.center.tolist())
        event.client.camera.fov = vertical_fov(camera)


@contextlib.contextmanager
def watched(
    painter: Painter, cameras: Sequence[SavedCamera], title: str, report: Callable[[str], None]
) -> Iterator[Callable[[int], None]]:
    """A viewer while a run trains. Yields a function to call after each iteration, with its number.

    The caller holds nerfview's lock, except in that function: the field is never drawn while an iteration changes it, and the
    run's bits are those of a run without a viewer.

    Args:
        report: called with the viewer's address.
    """
    viewer = SplatViewer(Screen(painter, cameras), title=title, mode="training")
    report(viewer.address)
    viewer.lock.acquire()
    began = time.monotonic()

    def after_step(iteration: int) -> None:
        nonlocal began
        # nerfview shares the time between both by the pixels of each a second: an iteration counts as one.
        viewer.render_tab_state.num_train_rays_per_sec = 1 / max(time.monotonic() - began, 1e-9)
        viewer.lock.release()
        try:
            viewer.update(iteration, 1)
            if viewer.server.get_clients():
                time.sleep(_TURN)
            while viewer.state == "paused":
                time.sleep(_PATIENCE)
        finally:
            viewer.lock.acquire()
        began = time.monotonic()

    try:
        yield after_step
    finally:
        viewer.lock.release()
        viewer.close()


def aim(server: viser.ViserServer, cameras: Sequence[Camera], scale: float = 1.0) -> None:
    """Look from the first camera at the distance of the point that all of them look at; without cameras, do nothing.

    Args:
        scale: of what the server shows, in world units of the cameras.
    """
    if not cameras:
        return
    axes = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    up = -axes[:, 1].mean(0)
    server.scene.set_up_direction(tuple((up / up.norm().clamp_min(1e-9)).tolist()))
    first = cameras[0]
    distance = float(np.linalg.norm(paths.look_at(cameras) - first.center.double().numpy()))
    start = server.initial_camera
    start.position = tuple((scale * first.center).tolist())
    focus = first.center.double() + distance * first.world_to_camera[2, :3].double()
    start.look_at = tuple((scale * focus).tolist())
    start.up = tuple((-first.world_to_camera[1, :3]).tolist())
    start.fov = vertical_fov(first)


def vertical_fov(camera: Camera) -> float:
    """Radians."""
    return 2 * math.atan(camera.height / 2 / camera.fy)


def wxyz(camera: Camera) -> tuple[float, float, float, float]:
    """Its rotation, camera to world, as a quaternion."""
    rotation = viser.transforms.SO3.from_matrix(camera.world_to_camera[:3, :3].double().T.numpy())
    w, x, y, z = (float(value) for value in rotation.wxyz)
    return w, x, y, z
