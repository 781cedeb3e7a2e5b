"""CLEAR in gaussian-splatting-lightning, by the class path of its density controller:

    model:
      density:
        class_path: integration.lightning.ClearDensityController
        init_args: {clear: clear, sr: data/fern/sr_x4}

The controller that it wraps (`base`) is built as it would be without, and stays what the host sees: names in checkpoints
are the same. Imported by that host only, for it derives from its `DensityController`.
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
from clear_strategies.data.priors import Images
from clear_strategies.merging.conductor import Conductor
from integration.attach import Attachment, Drawing, HostError, Which
from integration.densify import warn_of_early_end, warn_of_unread_score
from integration.lineage import Detail
from integration.seen import Eye, Role, enlarged
from integration.views import super_resolve, view

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
    """A density controller, and CLEAR in the module that it is set up for.

    Args:
        base: what controls density; None: the host's VanillaDensityController.
        clear: strategies of conf/: "clear", "gco", "gco,svs" …
        overrides: settings, e.g. "strategies.gco.tolerance=0.1".
        sr: folder of SR pictures, named like the photographs; None: HR takes no part.
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
        def with_clear(stage: str, pl_module: Any) -> None:
            setup(stage, pl_module)
            if stage == "fit":
                Attached(self, base, pl_module)

        controller.setup = with_clear
        return controller


class Attached:
    """CLEAR in one LightningModule; it begins with the first training step, when parameters and optimizers are in place."""

    def __init__(self, settings: ClearDensityController, density: Any, module: Any) -> None:
        from clear_strategies.compose import conductor

        if not module.trainer.max_steps > 0:
            raise HostError(
                f"schedules need the number of steps, got max_steps={module.trainer.max_steps}. Set trainer.max_steps."
            )
        self._settings, self._density, self._module = settings, density, module
        sr = None if settings.sr is None else Images(settings.sr, settings.suffix)
        self._conductor: Conductor = conductor(settings.clear, *settings.overrides, iterations=module.trainer.max_steps)
        self._sr, self._factor = super_resolve(sr, self._conductor, settings.factor)
        self._views: dict[str, View] = {}
        self._image: tuple[str, Tensor] | None = None  # of the step that is under way
        self.attachment: Attachment | None = None
        renderer = module.renderer
        _replace(module, "training_step", self._training_step)
        _replace(module, "save_gaussians", self._saving_detail)
        _replace(renderer, "training_forward", self._training_forward)
        _replace(renderer, "forward", self._shown)
        module.on_train_batch_end_hooks.append(lambda *_: self._detail.step())

    def _begin(self) -> Attachment:
        done, settings = self._module.trainer.global_step, self._settings
        threshold = getattr(self._density, "densify_grad_threshold", None)
        warn_of_unread_score(self._conductor, self._density, threshold)
        warn_of_early_end(self._conductor, getattr(self._density, "densify_until_iter", None), "densify_until_iter")
        model = self._module.gaussian_model
        self._detail = Detail(self._leaves)
        self._eye = Eye(model, _ROLES, self._leaves, self._detail if settings.detail else None, self._conductor)
        names = self._module.trainer.datamodule.dataparser_outputs.train_set.image_names
        attachment = Attachment(
            self._conductor, self._eye.params, n_views=len(names), seed=settings.seed, threshold=threshold,
            rows=lambda: self._detail.rows(self._conductor.state_dict),
        )  # fmt: skip
        if done:
            _log.warning("resumed at step %d: f_det and what strategies remember of Gaussians begin anew.", done)
            attachment.t = done + 1
        return attachment

    def _leaves(self) -> dict[str, Tensor]:
        gaussians = self._module.gaussian_model.gaussians
        return {name: gaussians[own] for name, own in _NAMES.items()}

    def _training_step(self, original: Callable[..., Any], batch: Any, *args: Any, **kwargs: Any) -> Any:
        _, (name, image, masked), _ = batch
        self._image = name, image
        if self.attachment is None:
            self.attachment = self._begin()
        if masked is not None:
            self._eye.say("masks are for the photographs alone: SR pictures are compared as a whole.")
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
        if self.attachment is None or self._image is None:
            return original(step, module, viewpoint_camera, pc, *args, **kwargs)
        of = self._view(viewpoint_camera, *self._image)

        def draw(which: Which, gate: Tensor | None) -> Drawing:
            camera = enlarged(viewpoint_camera, of.factor) if which == "hr" else viewpoint_camera
            return self._eye.draw(
                lambda model: original(step, module, camera, model, *args, **kwargs), of, which, gate, _unit
            )

        return self.attachment.draw(of, draw)

    def _shown(self, original: Callable[..., Any], viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
        """`forward`, with f_det where nothing is trained."""
        looked_at = pc is self._module.gaussian_model and not torch.is_grad_enabled()
        model = self._eye.whole() if looked_at and self.attachment is not None else pc
        return original(viewpoint_camera, model, *args, **kwargs)

    @torch.no_grad()
    def _saving_detail(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """`save_gaussians`, with f_det in the colours of its files."""
        if self.attachment is None:
            return original(*args, **kwargs)
        colours = self._leaves()["sh0"]
        trained = colours.clone()
        colours += self._detail.offset(colours)
        try:
            return original(*args, **kwargs)
        finally:
            colours.copy_(trained)

    def _view(self, camera: Any, name: str, image: Float[Tensor, "3 h w"]) -> View:
        if name not in self._views:
            fx, fy, cx, cy = (float(getattr(camera, k)) for k in ("fx", "fy", "cx", "cy"))
            K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
            pixels = image.permute(1, 2, 0)
            self._views[name] = view(name, pixels, camera.world_to_camera.T, K, self._sr, self._factor)
        return self._views[name]


def _unit(result: Mapping[str, Any]) -> tuple[float, float] | None:
    """Gsplat's renderers keep centres in pixels, and say so by giving the way to NDC."""
    return (1.0, 1.0) if result.get("viewspace_points_grad_scale") is not None else None


def _replace(owner: Any, name: str, replacement: Callable[..., Any]) -> None:
    """The method of this object, by one that is given the original first."""
    original = getattr(owner, name)
    setattr(owner, name, functools.wraps(original)(functools.partial(replacement, original)))
