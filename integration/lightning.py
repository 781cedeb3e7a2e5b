"""CLEAR in gaussian-splatting-lightning, by the class path of its density controller:

    model:
      density:
        class_path: integration.lightning.ClearDensityController
        init_args: {clear: clear, sr: data/fern/sr_x4}

The wrapped controller (`base`) is the one that the host would build, so names in checkpoints stay the same. Only that host
can import this module, which derives from its `DensityController`.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import torch
from internal.density_controllers.density_controller import DensityController
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from integration.attachment import Attachment, HostRendering, Resolution
from integration.detail import DetailFeature
from integration.errors import HostError
from integration.host_score import warn_if_densification_outlasts, warn_if_score_is_unused
from integration.model_proxy import ModelRenderer, Role, enlarged_camera
from integration.views import SuperResolve, sr_source, view

_log = logging.getLogger(__name__)

_NAMES: Final = {
    "means": "means", "quats": "rotations", "scales": "scales", "opacities": "opacities", "sh0": "shs_dc", "shN": "shs_rest",
}  # fmt: skip
_ROLES: Final[tuple[tuple[str, Role], ...]] = (
    ("get_opacities", "gate"),
    ("get_opacity", "gate"),
    ("shs_dc", "detail"),
    ("get_shs_dc", "detail"),
)


@dataclass
class ClearDensityController(DensityController):  # type: ignore[misc]
    """A density controller that also attaches CLEAR to the module it is set up for.

    The controller that the host gets has the attachment as its attribute `clear` after `setup("fit", …)`.

    Args:
        base: the controller that densifies; None: the host's VanillaDensityController.
        clear: strategies of conf/: "clear", "gco", "gco,svs" …
        overrides: settings, e.g. "strategies.gco.tolerance=0.1".
        sr: folder of SR images, named like the photos; None: HR is not used.
        suffix: what the SR tool appended to the names, e.g. "_x4".
        factor: HR pixels per LR pixel.
        detail: train the detail feature f_det.
    """

    base: DensityController | None = None
    clear: str = "clear"
    overrides: list[str] = field(default_factory=list)
    sr: str | None = None
    suffix: str = ""
    factor: int = 4
    detail: bool = True
    seed: int = 0

    def instantiate(self, *args: Any, **kwargs: Any) -> Any:
        base = self.base
        if base is None:
            from internal.density_controllers.vanilla_density_controller import VanillaDensityController

            base = VanillaDensityController()
        controller = base.instantiate(*args, **kwargs)
        setup = controller.setup

        @functools.wraps(setup)
        def setup_and_attach(stage: str, pl_module: Any) -> None:
            setup(stage, pl_module)
            if stage == "fit":
                controller.clear = Attached(self, base, pl_module)

        controller.setup = setup_and_attach
        return controller


class Attached:
    """CLEAR in one LightningModule.

    Attributes:
        attachment: None before the first training step, which is the first to have parameters and optimizers.
    """

    def __init__(self, settings: ClearDensityController, density: Any, module: Any) -> None:
        from clear_strategies.compose import conductor

        if not module.trainer.max_steps > 0:
            raise HostError(
                f"schedules need the number of steps, got max_steps={module.trainer.max_steps}. Set trainer.max_steps."
            )
        self._settings, self._density, self._module = settings, density, module
        self._conductor: Conductor = conductor(settings.clear, *settings.overrides, iterations=module.trainer.max_steps)
        self._sr, self._factor = sr_source(_sr_images(settings), self._conductor, settings.factor)
        self._views: dict[str, View] = {}
        self._photo: tuple[str, Tensor] | None = None  # name and pixels of the current step's photo
        self.attachment: Attachment | None = None
        _replace(module, "training_step", self._training_step)
        _replace(module, "save_gaussians", self._save_with_detail)
        _replace(module.renderer, "training_forward", self._training_forward)
        _replace(module.renderer, "forward", self._forward_with_detail)
        module.on_train_batch_end_hooks.append(lambda *_: self._detail.step())

    def _attach(self) -> Attachment:
        steps_done, settings = self._module.trainer.global_step, self._settings
        threshold = getattr(self._density, "densify_grad_threshold", None)
        warn_if_score_is_unused(self._conductor, self._density, threshold)
        until = getattr(self._density, "densify_until_iter", None)
        warn_if_densification_outlasts(self._conductor, until, "densify_until_iter")
        self._detail = DetailFeature(self._host_params)
        self._renderer = ModelRenderer(
            self._module.gaussian_model, _ROLES, self._host_params, self._detail if settings.detail else None,
            self._conductor,
        )  # fmt: skip
        names = self._module.trainer.datamodule.dataparser_outputs.train_set.image_names
        attachment = Attachment(
            self._conductor, self._renderer.params, n_views=len(names), seed=settings.seed, threshold=threshold,
            poll_parents=lambda: self._detail.poll_parents(self._conductor.state_dict),
        )  # fmt: skip
        if steps_done:
            _log.warning(
                "resumed at step %d: f_det and the strategies' per-Gaussian state start again from zero.", steps_done
            )
            attachment.t = steps_done + 1
        return attachment

    def _host_params(self) -> dict[str, Tensor]:
        gaussians = self._module.gaussian_model.gaussians
        return {name: gaussians[host_name] for name, host_name in _NAMES.items()}

    def _training_step(self, original: Callable[..., Any], batch: Any, *args: Any, **kwargs: Any) -> Any:
        _, (name, image, mask), _ = batch
        self._photo = name, image
        if self.attachment is None:
            self.attachment = self._attach()
        if mask is not None:
            self._renderer.warn_once("masks apply to the photos only: SR images are compared as a whole.")
        return original(batch, *args, **kwargs)

    def _training_forward(
        self,
        original: Callable[..., Any],
        step: int,
        module: Any,
        viewpoint_camera: Any,
        pc: Any,
        *args: Any,
        **kwargs: Any,
    ) -> Any:
        if self.attachment is None or self._photo is None:
            return original(step, module, viewpoint_camera, pc, *args, **kwargs)
        current = self._view(viewpoint_camera, *self._photo)

        def render_at(resolution: Resolution, gate: Tensor | None) -> HostRendering:
            camera = enlarged_camera(viewpoint_camera, current.factor) if resolution == "hr" else viewpoint_camera
            return self._renderer.render(
                lambda model: original(step, module, camera, model, *args, **kwargs),
                current,
                resolution,
                gate,
                _to_pixels,
            )

        return self.attachment.render_view(current, render_at)

    def _forward_with_detail(
        self, original: Callable[..., Any], viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any
    ) -> Any:
        """`forward`, with f_det in renderings without gradients."""
        evaluated = pc is self._module.gaussian_model and not torch.is_grad_enabled()
        model = self._renderer.with_detail() if evaluated and self.attachment is not None else pc
        return original(viewpoint_camera, model, *args, **kwargs)

    @torch.no_grad()
    def _save_with_detail(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """`save_gaussians` with f_det in the colours of its files."""
        if self.attachment is None:
            return original(*args, **kwargs)
        sh0 = self._host_params()["sh0"]
        trained = sh0.clone()
        sh0 += self._detail.offset(sh0)
        try:
            return original(*args, **kwargs)
        finally:
            sh0.copy_(trained)

    def _view(self, camera: Any, name: str, image: Float[Tensor, "3 h w"]) -> View:
        if name not in self._views:
            fx, fy, cx, cy = (float(getattr(camera, k)) for k in ("fx", "fy", "cx", "cy"))
            K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
            pixels = image.permute(1, 2, 0)
            self._views[name] = view(name, pixels, camera.world_to_camera.T, K, self._sr, self._factor)
        return self._views[name]


def _sr_images(settings: ClearDensityController) -> SuperResolve | None:
    from clear_strategies.data.priors import Images

    return None if settings.sr is None else Images(settings.sr, settings.suffix)


def _to_pixels(result: Mapping[str, Any]) -> tuple[float, float] | None:
    """The host's gsplat renderers keep centres in pixels; their results then hold a factor from pixels to NDC."""
    return (1.0, 1.0) if result.get("viewspace_points_grad_scale") is not None else None


def _replace(owner: Any, name: str, replacement: Callable[..., Any]) -> None:
    """Replace a method of this object; the replacement gets the original as its first argument."""
    original = getattr(owner, name)
    setattr(owner, name, functools.wraps(original)(functools.partial(replacement, original)))
