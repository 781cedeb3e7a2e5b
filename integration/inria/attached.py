"""`attach` for 3DGS-style loops: a `GaussianModel`, its optimizer, its cameras, and `render`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from integration.attachment import Attachment, HostRendering, Resolution
from integration.detail import DetailFeature
from integration.errors import HostError
from integration.host_score import warn_if_densification_outlasts
from integration.model_proxy import ModelRenderer, Role, enlarged_camera
from integration.views import SuperResolve, sr_source, view

Render = Callable[..., Any]

_ATTRIBUTES: Final = {
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
"""3DGS's default of densify_grad_threshold."""


class Attached:
    """The strategies of a conductor in a 3DGS-style loop; `attach` makes one, after `gaussians.training_setup(opt)`.

    Args:
        gaussians: the host's GaussianModel.
        cameras: all training cameras (`scene.getTrainCameras()`), each with its photo.
        sr: the folder of the SR images, or a function that makes them (`clear_strategies.data.priors` has some). None:
            there are none, for strategies and objectives that do not use HR.
        factor: HR pixels per LR pixel.
        threshold: opt.densify_grad_threshold, which scales P2G's score; None: a loop without densification.
        densify_until: opt.densify_until_iter, for a warning where a strategy ends densification earlier.
        detail: train the detail feature f_det beside the host's parameters.

    Attributes:
        views: the training views by the name of their photo.

    Raises:
        SettingError: HR is used, but there is no `sr`.
        ValueError: there is no camera, or two cameras have the same name.
        DataError: an SR image is missing, or is not `factor` times as large as its photo.
        HostError: `gaussians` is not a GaussianModel as in 3DGS.
    """

    def __init__(
        self,
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
    ) -> None:
        required = (*_ATTRIBUTES.values(), "optimizer")
        if missing := [attribute for attribute in required if getattr(gaussians, attribute, None) is None]:
            raise HostError(
                f"{type(gaussians).__name__} has no {missing[0]}, which a GaussianModel has in 3DGS. Attach after "
                "gaussians.training_setup(opt)."
            )
        if isinstance(getattr(gaussians.save_ply, "__self__", None), Attached):
            raise HostError("these gaussians are attached already; remove() the attachment that did it first.")
        self._model = gaussians
        self.views = self._views_of(cameras, *sr_source(sr, conductor, factor))
        self._detail = DetailFeature(self._host_params)
        self._renderer = ModelRenderer(
            gaussians, _ROLES, self._host_params, self._detail if detail else None, conductor
        )
        warn_if_densification_outlasts(conductor, densify_until, "densify_until_iter")
        self.attachment = Attachment(
            conductor, self.params, n_views=len(self.views), seed=seed, threshold=threshold,
            poll_parents=lambda: self._detail.poll_parents(conductor.state_dict),
        )  # fmt: skip
        self._optimizer, self._save_ply = gaussians.optimizer, gaussians.save_ply
        self._step_hook = gaussians.optimizer.register_step_post_hook(lambda *_: self._detail.step())
        gaussians.save_ply = self._save_ply_with_detail

    def params(self) -> dict[str, Tensor]:
        """The current leaves, by gsplat's names."""
        return self._renderer.params()

    def wrap(self, render: Render) -> Render:
        """`render` that renders training cameras at both scales, and shows f_det in renderings without gradients."""

        @functools.wraps(render)
        def wrapped(viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
            if self.attachment.removed or pc is not self._model:
                return render(viewpoint_camera, pc, *args, **kwargs)
            if not torch.is_grad_enabled():
                return render(viewpoint_camera, self._renderer.with_detail(), *args, **kwargs)
            found = self._find_view(viewpoint_camera)
            if found is None:
                return render(viewpoint_camera, pc, *args, **kwargs)
            if pc.optimizer is not self._optimizer:
                raise HostError("gaussians has a new optimizer. Attach after the last training_setup or restore.")
            if kwargs.get("subpixel_offset") is not None:
                raise HostError(
                    "rays are jittered, and two scales of a view cannot share that. Train without ray_jitter."
                )

            def render_at(resolution: Resolution, gate: Tensor | None) -> HostRendering:
                camera = enlarged_camera(viewpoint_camera, found.factor) if resolution == "hr" else viewpoint_camera
                return self._renderer.render(
                    lambda model: render(camera, model, *args, **kwargs), found, resolution, gate
                )

            return self.attachment.render_view(found, render_at)

        return wrapped

    @torch.no_grad()
    def fold_detail(self) -> None:
        """Add f_det to the constant band of the colours and set it to 0."""
        self._model._features_dc += self._detail.offset(self._model._features_dc)
        self._detail.value.zero_()

    def remove(self) -> None:
        """Restore the loop; f_det is no longer shown, see `fold_detail`."""
        self.attachment.remove()
        self._step_hook.remove()
        vars(self._model).pop("save_ply", None)  # the instance's replacement of its class's method

    def _host_params(self) -> dict[str, Tensor]:
        return {name: getattr(self._model, attribute) for name, attribute in _ATTRIBUTES.items()}

    def _views_of(self, cameras: Sequence[Any], sr: SuperResolve, factor: int) -> dict[str, View]:
        if not cameras:
            raise ValueError("at least one training camera is needed, got none. Pass scene.getTrainCameras().")
        views: dict[str, View] = {}
        for camera in cameras:
            name = camera.image_name
            if name in views:
                raise ValueError(f"two training cameras are called {name!r}. Give every photo its own name.")
            image = camera.original_image.permute(1, 2, 0).to(self._model._xyz.device)
            pose = camera.world_view_transform.T
            views[name] = view(_file_name(name), image, pose, intrinsics(camera), sr, factor)
        return views

    def _find_view(self, camera: Any) -> View | None:
        name = getattr(camera, "image_name", None)
        if name not in self.views:
            self._renderer.warn_once(
                "a camera (%s) is none of the %d views; its renderings are left unchanged.", name, len(self.views)
            )
        return self.views.get(name)  # type: ignore[arg-type]

    def _save_ply_with_detail(self, *args: Any, **kwargs: Any) -> Any:
        """`save_ply` with f_det in the colours of the file."""
        trained = self._model._features_dc
        self._model._features_dc = torch.nn.Parameter(trained.detach() + self._detail.offset(trained))
        try:
            return self._save_ply(*args, **kwargs)
        finally:
            self._model._features_dc = trained


attach = Attached


def intrinsics(camera: Any) -> Float[Tensor, "3 3"]:
    """K in pixels, from the host's projection (for row vectors, to NDC)."""
    pose, full = (m.detach().double().cpu() for m in (camera.world_view_transform, camera.full_proj_transform))
    projection = torch.linalg.solve(pose, full)
    w, h = camera.image_width / 2, camera.image_height / 2
    fx, fy, cx, cy = projection[0, 0], projection[1, 1], projection[2, 0], projection[2, 1]
    return torch.tensor([[fx * w, 0, (cx + 1) * w], [0, fy * h, (cy + 1) * h], [0, 0, 1]], dtype=torch.float64)


def _file_name(image_name: str) -> str:
    """A name with an image suffix; a suffix is added where the host has dropped it, even if the name contains dots."""
    from clear_strategies.data.photo_files import SUFFIXES

    return image_name if Path(image_name).suffix.lower() in SUFFIXES else f"{image_name}.png"
