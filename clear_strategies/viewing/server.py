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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import nerfview
import numpy as np
import torch
import viser
import viser.transforms
from jaxtyping import Float
from nerfview._renderer import RenderTask
from nerfview.render_panel import populate_general_render_tab
from torch import Tensor

from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import read_image
from clear_strategies.viewing.aim import add_camera, aim, drawn_length, wxyz
from clear_strategies.viewing.cameras import SavedCamera, at_most
from clear_strategies.viewing.film import DepthScale
from clear_strategies.viewing.look import AS_MEASURED, Look, Painter
from clear_strategies.viewing.video import Frame
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_COLOR, _DEPTH, _COVERAGE = "color", "depth", "coverage"
_WINDOW, _LR, _HR = "window", "LR pixels", "HR pixels"
_SMALL: Final = 96  # px, longest edge of the pictures that the colours of depth are chosen by
_SHARP: Final = 1024  # px: enlarged pixels fill at least so many, so that the browser does not blur them
_LARGEST: Final = 2048  # px, longest edge of a picture
_EVERY: Final = 1.0  # seconds between pictures of a run that trains, where nobody moves
_MOST_FRUSTUMS: Final = 200

Points = Mapping[str, Float[Tensor, "N 3"]]
"""What the Gaussians can be coloured by: a name and RGB in [0, 1] each."""


@dataclass(frozen=True, slots=True)
class View:
    """The choices of the panel.

    Args:
        show: color, depth, coverage, or a name in `Points`.
        grid: draw the pixels of the window, or those of an LR or HR camera, enlarged.
    """

    show: str = _COLOR
    look: Look = AS_MEASURED
    grid: str = _WINDOW


@dataclass(frozen=True, eq=False)
class Screen:
    """Draws what a browser's camera sees.

    Args:
        cameras: of the run; the first one's pixels are those of the grids.
        points: returns `Points`; called when the panel shows one of them.
    """

    painter: Painter
    cameras: Sequence[SavedCamera]
    points: Callable[[], Points] = dict

    def draw(self, view: View, pose: Float[np.ndarray, "4 4"], fov: float, size: tuple[int, int]) -> Frame:
        """The picture of at most `size` (width, height) pixels; of the LR or HR grid, each pixel a square.

        Args:
            pose: camera to world, OpenCV axes. fov: vertical, radians.
        """
        width, height = self._grid_size(view.grid, fov, size)
        focal, world_to_camera = height / 2 / math.tan(fov / 2), np.linalg.inv(pose.astype(np.float64))
        camera = Camera(torch.from_numpy(world_to_camera), focal, focal, width / 2, height / 2, width, height)
        picture = self._picture(view, camera)
        times = 1 if view.grid == _WINDOW else max(1, math.ceil(_SHARP / max(width, height)))
        return picture.repeat(times, axis=0).repeat(times, axis=1)

    def _grid_size(self, grid: str, fov: float, size: tuple[int, int]) -> tuple[int, int]:
        width, height = size
        if grid != _WINDOW and self.cameras:
            first = self.cameras[0]
            focal = first.camera.fy / (first.scale if grid == _LR else 1)
            times = 2 * focal * math.tan(fov / 2) / height
            times = min(times, _LARGEST / max(width, height))
            width, height = round(width * times), round(height * times)
        return max(1, width), max(1, height)

    def _picture(self, view: View, camera: Camera) -> Frame:
        if view.show == _DEPTH:
            return self.depth_scale.picture(self.painter.depth(camera, view.look))
        if view.show == _COVERAGE:
            ones = torch.ones(len(self.painter.field))
            return to_bytes(self.painter.numbers(camera, ones, view.look)[..., None].expand(-1, -1, 3))
        if view.show != _COLOR and (rgb := self.points().get(view.show)) is not None:
            return to_bytes(self.painter.points(camera, rgb, view.look))
        return to_bytes(self.painter.color(camera, view.look))

    @functools.cached_property
    def depth_scale(self) -> DepthScale:
        """From the cameras of the run; 0 to 10 where none is known."""
        cameras = [at_most(saved.camera, _SMALL) for saved in self.cameras]
        return DepthScale.of(self.painter, cameras) if cameras else DepthScale(0.0, 10.0)


class SplatViewer(nerfview.Viewer):  # type: ignore[misc]  # nerfview has no types
    """nerfview's viewer with the switches of `View` and the cameras of the run.

    Args:
        around: calls a function that draws; while a run trains, between two of its iterations.
        live: whether a run trains: shows its progress and a button that pauses it.
    """

    def __init__(
        self, screen: Screen, *, title: str, names: Sequence[str] = (), port: int = 8080, host: str = "127.0.0.1",
        out: Path | None = None, live: bool = False, around: Callable[[Callable[[], Frame]], Frame] | None = None,
    ) -> None:  # fmt: skip
        self._screen, self._names = screen, tuple(names)
        self._around = around if around is not None else lambda draw: draw()
        self._failed: str | None = None
        # A browser that goes away while its picture is drawn.
        warnings.filterwarnings("ignore", message=".*it will never be delivered")
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its address; whoever opens it does
            server = viser.ViserServer(host=host, port=port, verbose=False, label=title)
        aim(server, [saved.camera for saved in screen.cameras])
        super().__init__(server, self._render, output_dir=out, mode="rendering")
        server.gui.set_panel_label(title)
        self._training: dict[str, Any] | None = None
        if live:
            with server.gui.add_folder("Training", order=-1):
                iteration = server.gui.add_number("Iteration", 0, disabled=True)
                self._training = {"iteration": iteration, "pause": server.gui.add_checkbox("Pause", False)}
        self._shown_at = 0.0
        self._add_cameras()

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def view(self) -> View:
        """The choices of the panel now."""
        values = {name: switch.value for name, switch in self._switches.items()}
        show, grid = values.pop("show"), values.pop("grid")
        return View(show, Look(**values), grid)

    @property
    def paused(self) -> bool:
        """Whether the button pauses the run that trains."""
        return self._training is not None and bool(self._training["pause"].value)

    def show_progress(self, iteration: int) -> None:
        """Show the iteration, and draw the field as it is now; at most once in `_EVERY` seconds."""
        if self._training is None or time.monotonic() - self._shown_at < _EVERY:
            return
        self._shown_at = time.monotonic()
        self._training["iteration"].value = iteration
        for number, client in self.server.get_clients().items():
            if (renderer := self._renderers.get(number)) is not None:
                renderer.submit(RenderTask("update", self.get_camera_state(client)))

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
        gui = self.server.gui
        with gui.add_folder("Look", order=0):
            self._switches: dict[str, Any] = {
                "show": gui.add_dropdown("Show", (_COLOR, _DEPTH, _COVERAGE, *self._names)),
                "grid": gui.add_dropdown(
                    "Pixels", (_WINDOW, _LR, _HR) if self._screen.cameras else (_WINDOW,),
                    hint="LR, HR: pixels as large as those of the run's cameras from here, enlarged",
                ),
                "sh": gui.add_checkbox("SH", True, hint="colour depends on the direction"),
                "detail": gui.add_checkbox("f_det", True, hint="the detail that HR renders add and LR renders do not"),
                "filter_3d": gui.add_checkbox("3D filter", True, hint="Mip-Splatting: no Gaussian thinner than a pixel"),
                "mip": gui.add_checkbox("2D Mip filter", True, hint="off: 3DGS's blur of 0.3 px²"),
            }  # fmt: skip
            for handle in self._switches.values():
                handle.on_update(self.rerender)
            resolution = gui.add_slider("Longest edge, px", min=128, max=_LARGEST, step=64, initial_value=1024)
            self.render_tab_state.viewer_res = resolution.value

            def resize(event: Any) -> None:
                self.render_tab_state.viewer_res = int(resolution.value)
                self.rerender(event)

            resolution.on_update(resize)

        self._rendering_folder.expand_by_default = False
        handles = populate_general_render_tab(
            self.server, output_dir=self.output_dir, folder=self._rendering_folder, render_tab_state=self.render_tab_state,
            extra_handles={}, scale_ratio=1.0,
        )  # fmt: skip
        self._rendering_tab_handles.update(handles)

    def _render(self, state: Any, tab: Any) -> Frame:
        """Called by nerfview in a thread of each browser, which ends the process on an error: so none may pass."""
        size = (tab.render_width, tab.render_height) if tab.preview_render else (tab.viewer_width, tab.viewer_height)
        view = self.view()
        try:
            return self._around(lambda: self._screen.draw(view, state.c2w, state.fov, size))
        except (RuntimeError, ValueError) as error:
            if str(error) != self._failed:  # once, not in every frame
                self._failed = str(error)
                _log.warning("the viewer could not draw: %s", error)
            return np.zeros((size[1], size[0], 3), np.uint8)

    def _add_cameras(self) -> None:
        train = [saved for saved in self._screen.cameras if saved.split == "train"][:_MOST_FRUSTUMS]
        if not train:
            return
        size = drawn_length([saved.camera for saved in train])
        gui, frustums = self.server.gui, [self._add_frustum(saved, size) for saved in train]
        with gui.add_folder("Training cameras", order=1):
            shown = gui.add_checkbox("Show, with their photos", False, hint="a click on one goes there")
            chosen = gui.add_dropdown("Go to", tuple(saved.name for saved in train))

        def show(_: Any) -> None:
            for frustum in frustums:
                frustum.visible = shown.value

        def go(event: Any) -> None:
            saved = next(saved for saved in train if saved.name == chosen.value)
            for client in [event.client] if event.client is not None else self.server.get_clients().values():
                _go_to(client, saved.camera)

        shown.on_update(show)
        chosen.on_update(go)

    def _add_frustum(self, saved: SavedCamera, size: float) -> Any:
        camera = saved.camera
        image = None if saved.photo is None else to_bytes(read_image(saved.photo))
        frustum = add_camera(
            self.server, f"/cameras/{saved.name}", camera, size, color=(255, 180, 60), image=image, visible=False
        )
        frustum.on_click(lambda event: _go_to(event.client, camera))
        return frustum


def _go_to(client: Any, camera: Camera) -> None:
    with client.atomic():
        client.camera.wxyz = wxyz(camera)
        client.camera.position = tuple(camera.center.tolist())
        client.camera.fov = 2 * math.atan(camera.height / 2 / camera.fy)
