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
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import nerfview
import numpy as np
import torch
import viser
import viser.transforms
from jaxtyping import Float
from nerfview.render_panel import populate_general_render_tab
from torch import Tensor

from clear_strategies.core.images import to_bytes
from clear_strategies.data.photo_files import read_image
from clear_strategies.viewing.aim import aim, drawn_length, vertical_fov, wxyz
from clear_strategies.viewing.cameras import SavedCamera, at_most
from clear_strategies.viewing.film import DepthScale
from clear_strategies.viewing.look import AS_MEASURED, Look, Painter
from clear_strategies.viewing.video import Pixels
from rasterizers.interface import Camera

_log = logging.getLogger(__name__)

_COLOR, _DEPTH, _COVERAGE, _OPACITY, _DETAIL = SHOWN = ("color", "depth", "coverage", "opacity", "f_det")
_SMALL: Final = 96  # px, longest edge of the pictures that the colours of depth are chosen by
_LARGEST: Final = 2048  # px, longest edge of a picture
_MOST_FRUSTUMS: Final = 200
_TOP: Final = 0.98  # quantile of |f_det| at the end of its colours


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
        if view.show == _COVERAGE:
            ones = torch.ones(len(self.painter.field))
            return to_bytes(self.painter.numbers(camera, ones, view.look)[..., None].expand(-1, -1, 3))
        if view.show == _COLOR:
            return to_bytes(self.painter.color(camera, view.look))
        return to_bytes(self.painter.points(camera, self.colors(view.show), view.look))

    def colors(self, show: str) -> Float[Tensor, "N 3"]:
        """The Gaussians by their opacity from 0 to 1, or by |f_det| up to its 98 % quantile, in viridis."""
        from matplotlib import colormaps

        field = self.painter.field
        values = field.filtered_opacities().data.cpu() if show == _OPACITY else field.detail.data.norm(dim=1).cpu()
        if show == _DETAIL and len(values):
            values = values / max(float(np.quantile(values.numpy(), _TOP)), 1e-9)
        return torch.from_numpy(colormaps["viridis"](values.clamp(0, 1).numpy())[:, :3]).float()

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
        """Ours, then nerfview's own without its scale of the world, so that saved paths are in the run's."""
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
            resolution = gui.add_slider("Longest edge, px", min=128, max=_LARGEST, step=64, initial_value=1024)
            self.render_tab_state.viewer_res = resolution.value

            def resize(event: Any) -> None:
                self.render_tab_state.viewer_res = int(resolution.value)
                self.rerender(event)

            resolution.on_update(resize)
        self._rendering_folder.expand_by_default = False
        handles = populate_general_render_tab(
            self.server, output_dir=self.output_dir, folder=self._rendering_folder, render_tab_state=self.render_tab_state,
            extra_handles=self._training_tab_handles if self.mode == "training" else {}, scale_ratio=1.0,
        )  # fmt: skip
        self._rendering_tab_handles.update(handles)

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
        length = drawn_length([saved.camera for saved in train])
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
