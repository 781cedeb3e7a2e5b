"""CLEAR in gaussian-splatting-lightning, by the class path of its density controller:

    model:
      density:
        class_path: integration.lightning.ClearDensityController
        init_args: {strategies: clear, sr: data/fern/sr_x4}

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
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.merging.conductor import Conductor
from integration.attachment import Attachment
from integration.densification import end_with_strategies
from integration.detail import sh0_offset
from integration.errors import HostError
from integration.host_cameras import enlarged_camera
from integration.host_rendering import Target
from integration.lineage import ROWS, RowNumbers
from integration.log import show_log
from integration.model_proxy import AttachedModel, Role
from integration.replacing import replace_methods, replaced_attribute
from integration.views import by_name, sr_source, view

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
_SH0: Final = f"gaussian_model.gaussians.{_NAMES['sh0']}"
_STATE: Final = "clear"
"""Key of our state in the host's checkpoints."""


@dataclass
class ClearDensityController(DensityController):  # type: ignore[misc]
    """A density controller that also attaches CLEAR to the module it is set up for.

    The controller that the host gets has the attachment as its attribute `clear` after `setup("fit", …)`.

    Args:
        base: the controller that densifies; None: the host's VanillaDensityController.
        strategies: names of conf/strategy: "clear", "gco", "gco,svs" …
        overrides: settings, e.g. "strategies.gco.tolerance=0.1".
        sr: folder of SR images, named like the photos; None: HR is not used.
        suffix: what the SR tool appended to the names, e.g. "_x4".
        factor: HR pixels per LR pixel.
        detail: train the detail feature f_det.
    """

    base: DensityController | None = None
    strategies: str = "clear"
    overrides: list[str] = field(default_factory=list)
    sr: str | None = None
    suffix: str = ""
    factor: int = 4
    detail: bool = True
    seed: int = 0

    def instantiate(self, *args: Any, **kwargs: Any) -> Any:
        show_log()
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

    The module's `forward` is replaced, and not the renderer's: the host pickles its renderer with every checkpoint.

    Attributes:
        attachment: None before the first training step, which is the first to have parameters and optimizers.
    """

    def __init__(self, settings: ClearDensityController, density: Any, module: Any) -> None:
        from clear_strategies.compose import conductor

        trainer = module.trainer
        if not trainer.max_steps > 0:
            raise HostError(
                f"schedules need the number of steps, got max_steps={trainer.max_steps}. Set trainer.max_steps."
            )
        if getattr(trainer, "world_size", 1) > 1:
            raise HostError(f"one process trains, got {trainer.world_size}. Set trainer.devices=1.")
        if str(getattr(trainer, "precision", "32")).startswith(("16", "bf16")):
            raise HostError(
                f"gradients are merged in 32 bits, got precision={trainer.precision}. Set trainer.precision=32."
            )
        self._settings, self._density, self._module = settings, density, module
        self._conductor: Conductor = conductor(settings.strategies, *settings.overrides, iterations=trainer.max_steps)
        self._sr, self._factor = sr_source(settings.sr, self._conductor, settings.factor, settings.suffix)
        end_with_strategies(self._conductor, density, "densify_until_iter")
        self._views: dict[str, View] = {}
        self._masks: dict[str, Tensor] = {}
        self._batch: Any = None  # the host's, inside a training step
        self._resumed: Mapping[str, Any] = {}
        self._sh0_holds_detail = False  # while the host writes its files
        self.attachment: Attachment | None = None
        replace_methods(module, {
            "forward": self._forward, "training_step": self._training_step, "save_gaussians": self._save_with_detail,
            "on_save_checkpoint": self._save_state, "on_load_checkpoint": self._load_state,
        })  # fmt: skip
        module.on_train_start_hooks.append(lambda *_: self._show_detail_in_viewer())
        module.on_train_batch_end_hooks.append(lambda *_: self._attached.detail.step())
        module.extra_train_metrics.append(self._add_metrics)

    def _attach(self) -> Attachment:
        module, settings = self._module, self._settings
        if missing := [name for name in _NAMES.values() if name not in module.gaussian_model.gaussians]:
            raise HostError(
                f"the Gaussians have no {missing[0]}, as those of a VanillaGaussian have. Use a model with spherical harmonics."
            )
        if any(p.requires_grad for p in module.renderer.parameters()):
            raise HostError(
                f"{type(module.renderer).__name__} trains an appearance model of its own, which two scales do not share. Use a "
                "renderer without one."
            )
        self._views_from_dataset(module.trainer.train_dataloader.dataset)
        self._filter_at_hr()
        self._attached = attached = AttachedModel(
            module.gaussian_model, _ROLES, self._host_params, self._carry_rows(), self._conductor, list(self._views.values()),
            detail=settings.detail, densifier=self._density, threshold=getattr(self._density, "densify_grad_threshold", None),
            masks=self._masks, seed=settings.seed, to_pixels=_to_pixels,
        )  # fmt: skip
        attached.attachment.hook(module.gaussian_optimizers)
        if self._resumed:
            attached.load_state_dict(self._resumed)
        elif steps_done := module.trainer.global_step:
            _log.warning("resumed at step %d from a checkpoint without CLEAR: f_det starts from zero.", steps_done)
            attached.attachment.t = steps_done + 1
        return attached.attachment

    def _carry_rows(self) -> RowNumbers:
        """Row numbers as one more property that is not trained, which the host's controllers gather with the others."""
        model = self._module.gaussian_model
        names = model.get_property_names
        model.get_property_names = lambda: (*names(), ROWS)
        return RowNumbers(model.gaussians, lambda: self._host_params()["means"])

    def _filter_at_hr(self) -> None:
        """Mip-Splatting's 3D filter limits Gaussians to what the finest training camera samples, and that is one at HR."""
        model = self._module.gaussian_model
        if hasattr(model, "_train_camera_set") and hasattr(model, "compute_3d_filter"):
            model._train_camera_set = [enlarged_camera(camera, self._factor) for camera in model._train_camera_set]
            model.compute_3d_filter()

    def _host_params(self) -> dict[str, Tensor]:
        gaussians = self._module.gaussian_model.gaussians
        return {name: gaussians[host_name] for name, host_name in _NAMES.items()}

    def _views_from_dataset(self, dataset: Any) -> None:
        """Every training photo as its dataset loads it: undistorted, over the background, with its mask."""
        device, views = self._host_params()["means"].device, []
        for i in range(len(dataset)):
            camera, (name, image, mask), _ = dataset[i]
            fx, fy, cx, cy = (float(getattr(camera, k)) for k in ("fx", "fy", "cx", "cy"))
            K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
            pixels = image.permute(1, 2, 0).to(device)
            if mask is not None:
                self._masks[name] = mask[0].to(device).float()
            pose = camera.world_to_camera.T
            views.append(view(name, pixels, pose, K, self._sr, self._factor, self._masks.get(name)))
        self._views = by_name(views)

    def _training_step(self, original: Callable[..., Any], batch: Any, *args: Any, **kwargs: Any) -> Any:
        if self.attachment is None:
            self.attachment = self._attach()
        self._batch = batch
        try:
            return original(batch, *args, **kwargs)
        finally:
            self._batch = None

    def _forward(self, original: Callable[..., Any], camera: Any, *args: Any, **kwargs: Any) -> Any:
        """Both scales in a training step; f_base + f_det in any other rendering."""
        if self.attachment is None:
            return original(camera, *args, **kwargs)
        if self._batch is None or not self._module.training:
            with replaced_attribute(self._module, "gaussian_model", self._attached.with_detail()):
                return original(camera, *args, **kwargs)
        _, photo, extra = self._batch

        def render(model: Any, sized: Any, target: Target) -> Any:
            with replaced_attribute(self._module, "gaussian_model", model):
                result = original(sized, *args, **kwargs)
            if target == "hr":  # at LR the host itself applies its exposure, bilateral grid …
                self._module.output_processor.training_forward((sized, photo, extra), result)
            return result

        return self._attached.render_view(self._views[photo[0]], camera, render)

    def _show_detail_in_viewer(self) -> None:
        """The host's viewer calls the renderer itself."""
        if (viewer := getattr(self._module, "web_viewer", None)) is not None:
            replace_methods(viewer, {"process_all_render_requests": self._show})

    def _show(self, original: Callable[..., Any], model: Any, *args: Any) -> Any:
        return original(model if self.attachment is None else self._attached.with_detail(), *args)

    def _add_metrics(
        self, outputs: Any, batch: Any, model: Any, step: int, module: Any, metrics: Any, prog_bar: Any
    ) -> None:
        """The HR losses of the last step, in the host's log and progress bar."""
        if self.attachment is not None:
            for name, value in self.attachment.log.items():
                metrics[f"clear_{name}"] = torch.as_tensor(value)
                prog_bar[f"clear_{name}"] = name == "base"

    @torch.no_grad()
    def _save_with_detail(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """`save_gaussians` with f_det in the colours of its files."""
        if self.attachment is None:
            return original(*args, **kwargs)
        sh0 = self._host_params()["sh0"]
        trained = sh0.clone()
        sh0 += self._attached.detail.offset(sh0)
        self._sh0_holds_detail = True
        try:
            return original(*args, **kwargs)
        finally:
            self._sh0_holds_detail = False
            sh0.copy_(trained)

    def _save_state(self, original: Callable[..., Any], checkpoint: dict[str, Any]) -> None:
        """A checkpoint's colours are f_base + f_det, for every program that reads it; our own state lies beside."""
        original(checkpoint)
        if self.attachment is None:
            return
        checkpoint[_STATE] = self._attached.state_dict()
        if not self._sh0_holds_detail:
            sh0 = checkpoint["state_dict"][_SH0]
            checkpoint["state_dict"][_SH0] = sh0 + self._attached.detail.offset(sh0)

    def _load_state(self, original: Callable[..., Any], checkpoint: dict[str, Any]) -> None:
        """Training continues with f_base and f_det, which the colours of a checkpoint hold as their sum."""
        self._resumed = checkpoint.get(_STATE, {})
        if self._resumed:
            sh0 = checkpoint["state_dict"][_SH0]
            detail = self._resumed["detail"]["value"].to(sh0)
            checkpoint["state_dict"][_SH0] = sh0 - sh0_offset(detail, sh0)
        original(checkpoint)


def _to_pixels(result: Mapping[str, Any]) -> tuple[float, float] | None:
    """The host's gsplat renderers keep centres in pixels; their results then hold a factor from pixels to NDC."""
    return (1.0, 1.0) if result.get("viewspace_points_grad_scale") is not None else None
