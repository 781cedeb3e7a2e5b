"""CLEAR in the `train.py` of Inria's 3DGS and of its forks: two lines after `gaussians.training_setup(opt)`,

    clear = attach(gaussians, scene.getTrainCameras(), conductor("clear", iterations=opt.iterations), sr="sr_x4",
                   threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter)
    render = clear.wrap(render)

or none:

    python -m integration.inria --sr sr_x4 train.py -s data

Nothing of those repositories is imported but by their own train.py, and nothing is needed but the names that all share.
"""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.data.photo_files import SUFFIXES
from clear_strategies.merging.conductor import Conductor
from integration.attach import Attachment, Drawing, HostError, Which
from integration.densify import warn_of_early_end
from integration.lineage import Detail
from integration.seen import Eye, Role, enlarged
from integration.views import SuperResolve, super_resolve, view

_log = logging.getLogger(__name__)

Render = Callable[..., Any]

_NAMES: Final = {
    "means": "_xyz", "quats": "_rotation", "scales": "_scaling", "opacities": "_opacity", "sh0": "_features_dc",
    "shN": "_features_rest",
}  # fmt: skip
_ROLES: Final[tuple[tuple[str, Role], ...]] = (
    ("get_opacity", "gate"),
    ("get_opacity_with_3D_filter", "gate"),
    ("get_scaling_n_opacity_with_3D_filter", "gate"),
    ("_features_dc", "detail"),
)

THRESHOLD: Final = 2e-4
"""3DGS's densify_grad_threshold."""


def attach(
    gaussians: Any,
    cameras: Sequence[Any],
    conductor: Conductor,
    *,
    sr: SuperResolve | str | Path | None = None,
    factor: int = 4,
    threshold: float | None = THRESHOLD,
    densify_until: int | None = None,
    detail: bool = True,
    seed: int = 0,
) -> Attached:
    """Attach the strategies of a conductor to an Inria-style loop, after `gaussians.training_setup(opt)`.

    Args:
        gaussians: the host's GaussianModel.
        cameras: all training cameras (`scene.getTrainCameras()`), each with its photograph.
        sr: where SR pictures come from: their folder, or a function (`clear_strategies.data.priors` has some).
            None: there are none, for strategies and objectives that never look at HR.
        factor: HR pixels per LR pixel.
        threshold: opt.densify_grad_threshold, scales P2G's score; None: a loop without densification.
        densify_until: opt.densify_until_iter, to say beforehand where a strategy ends densification earlier.
        detail: train the detail feature f_det, beside the host's parameters.

    Raises:
        ValueError: HR is wanted, but there is no `sr`; or there is no camera, or two have one name.
        DataError: an SR picture is missing, or not `factor` times its photograph.
        HostError: `gaussians` is not what 3DGS calls a GaussianModel.
    """
    return Attached(
        gaussians, cameras, conductor, sr=sr, factor=factor, threshold=threshold, densify_until=densify_until,
        detail=detail, seed=seed,
    )  # fmt: skip


class Attached:
    """The handle of `attach`: wraps `render`, and can be removed."""

    def __init__(
        self,
        gaussians: Any,
        cameras: Sequence[Any],
        conductor: Conductor,
        *,
        sr: SuperResolve | str | Path | None,
        factor: int,
        threshold: float | None,
        densify_until: int | None,
        detail: bool,
        seed: int,
    ) -> None:
        if missing := [own for own in (*_NAMES.values(), "optimizer") if getattr(gaussians, own, None) is None]:
            raise HostError(
                f"{type(gaussians).__name__} has no {missing[0]}, as 3DGS's GaussianModel has. Attach after "
                "gaussians.training_setup(opt)."
            )
        if isinstance(getattr(gaussians.save_ply, "__self__", None), Attached):
            raise HostError("these gaussians are attached already; remove() the attachment that did it first.")
        self._model = gaussians
        resolve, factor = super_resolve(sr, conductor, factor)
        self._views = self._read(cameras, resolve, factor)
        self._detail = Detail(self._leaves)
        self._eye = Eye(gaussians, _ROLES, self._leaves, self._detail if detail else None, conductor)
        warn_of_early_end(conductor, densify_until, "densify_until_iter")
        self.attachment = Attachment(
            conductor, self.params, n_views=len(self._views), seed=seed, threshold=threshold,
            rows=lambda: self._detail.rows(conductor.state_dict),
        )  # fmt: skip
        self._optimizer, self._save_ply = gaussians.optimizer, gaussians.save_ply
        self._stepped = gaussians.optimizer.register_step_post_hook(lambda *_: self._detail.step())
        gaussians.save_ply = self._saving_detail

    def params(self) -> dict[str, Tensor]:
        """The leaves of this moment, by gsplat's names."""
        return self._eye.params()

    def wrap(self, render: Render) -> Render:
        """The same function; training cameras are drawn at both scales, and whatever is drawn without gradients shows f_det."""

        @functools.wraps(render)
        def wrapped(viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
            if self.attachment.removed or pc is not self._model:
                return render(viewpoint_camera, pc, *args, **kwargs)
            if not torch.is_grad_enabled():
                return render(viewpoint_camera, self._eye.whole(), *args, **kwargs)
            photographed = self._recognise(viewpoint_camera)
            if photographed is None:
                return render(viewpoint_camera, pc, *args, **kwargs)
            if pc.optimizer is not self._optimizer:
                raise HostError("gaussians has got another optimizer. Attach after the last training_setup or restore.")
            if kwargs.get("subpixel_offset") is not None:
                raise HostError(
                    "rays are jittered, which two scales of one view cannot share. Train without ray_jitter."
                )

            def draw(which: Which, gate: Tensor | None) -> Drawing:
                camera = enlarged(viewpoint_camera, photographed.factor) if which == "hr" else viewpoint_camera
                return self._eye.draw(lambda model: render(camera, model, *args, **kwargs), photographed, which, gate)

            return self.attachment.draw(photographed, draw)

        return wrapped

    @torch.no_grad()
    def fold_detail(self) -> None:
        """Add f_det to the constant band of the colours and make it 0."""
        self._model._features_dc += self._detail.offset(self._model._features_dc)
        self._detail.value.zero_()

    def remove(self) -> None:
        """Leave the loop as it was; f_det is no longer shown, see `fold_detail`."""
        self.attachment.remove()
        self._stepped.remove()
        vars(self._model).pop("save_ply", None)  # the instance's: its class has its own

    def __enter__(self) -> Attached:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.remove()

    def _leaves(self) -> dict[str, Tensor]:
        return {name: getattr(self._model, own) for name, own in _NAMES.items()}

    def _read(self, cameras: Sequence[Any], sr: SuperResolve, factor: int) -> dict[str, View]:
        """Every training camera as a view, by the name of its photograph."""
        if not cameras:
            raise ValueError("at least one training camera is needed, got none. Pass scene.getTrainCameras().")
        views: dict[str, View] = {}
        for camera in cameras:
            if camera.image_name in views:
                raise ValueError(
                    f"two training cameras are called {camera.image_name!r}. Give every photograph its own name."
                )
            image = camera.original_image.permute(1, 2, 0).to(self._model._xyz.device)
            pose = camera.world_view_transform.T
            views[camera.image_name] = view(_file_name(camera.image_name), image, pose, intrinsics(camera), sr, factor)
        return views

    def _recognise(self, camera: Any) -> View | None:
        name = getattr(camera, "image_name", None)
        if name not in self._views:
            self._eye.say(
                "a camera (%s) is none of the %d views; what it draws is left as it is.", name, len(self._views)
            )
        return self._views.get(name)  # type: ignore[arg-type]

    def _saving_detail(self, *args: Any, **kwargs: Any) -> Any:
        """`save_ply`, with f_det in the colours of the file."""
        trained = self._model._features_dc
        self._model._features_dc = torch.nn.Parameter(trained.detach() + self._detail.offset(trained))
        try:
            return self._save_ply(*args, **kwargs)
        finally:
            self._model._features_dc = trained


def intrinsics(camera: Any) -> Float[Tensor, "3 3"]:
    """K in pixels, from the projection that the host draws by (row vectors, NDC)."""
    pose, full = (m.detach().double().cpu() for m in (camera.world_view_transform, camera.full_proj_transform))
    projection = torch.linalg.solve(pose, full)
    w, h = camera.image_width / 2, camera.image_height / 2
    fx, fy, cx, cy = projection[0, 0], projection[1, 1], projection[2, 0], projection[2, 1]
    return torch.tensor([[fx * w, 0, (cx + 1) * w], [0, fy * h, (cy + 1) * h], [0, 0, 1]], dtype=torch.float64)


def _file_name(image_name: str) -> str:
    """Some hosts drop the suffix, and what follows the last dot of the rest is none."""
    return image_name if Path(image_name).suffix.lower() in SUFFIXES else f"{image_name}.png"


if __name__ == "__main__":
    from integration.launch import main

    sys.exit(main())
