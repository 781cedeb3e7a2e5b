"""CLEAR in a 3DGS-style loop: a `GaussianModel`, its optimizer, its cameras, and `render`."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import torch
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.signatures import signature_of
from integration.announcement import Once
from integration.attachment import Attachment
from integration.autograd_shot import HostOutput, Target
from integration.densification import require_end, warn_if_score_is_unused
from integration.detail import sh0_offset
from integration.host import Host
from integration.inria.cameras import HostViews, enlarged_camera, replaced_camera
from integration.inria.detail import DetailFeature
from integration.inria.model_proxy import Overrides, host_output, proxy
from integration.inria.rows import CarriedRows
from integration.replacing import replaced_attribute, replaced_everywhere, replaced_methods
from integration.settings import Settings
from integration.views import SuperResolve
from rasterizers.differentiable import collected_drawings
from rasterizers.interface import Camera
from rasterizers.modes import uncompiled
from rasterizers.sending import color_on

_log = logging.getLogger(__name__)

_ATTRIBUTES: Final = {
    "means": "_xyz", "quats": "_rotation", "scales": "_scaling", "opacities": "_opacity", "sh0": "_features_dc",
    "shN": "_features_rest",
}  # fmt: skip
_SAVERS: Final = ("save_ply", "save_fused_ply")
_STATE: Final = "clear"
"""Key of our state in the optimizer's state, which the host's checkpoints hold."""


class Attached:
    """The strategies of a conductor in a 3DGS-style loop; `install` makes one from the host's own options.

    Args:
        gaussians: the host's GaussianModel, after `training_setup`.
        cameras: all training cameras (`scene.getTrainCameras()`), each with its photo.
        sr: the folder of the SR images, or a function that makes them (`clear_strategies.data.priors` has some). None:
            there are none, for strategies and objectives that do not use HR. suffix: what the SR tool appended to the names.
        factor: HR pixels per LR pixel.
        threshold: opt.densify_grad_threshold (by default 3DGS's own), which scales P2G's score; None: it reads no score.
        densify_until: opt.densify_until_iter; refused where an anchor would be taken before.
        detail: train the detail feature f_det beside the host's parameters.
        own_background: the host chooses the colour behind its renderings (`--random_background`); else the strategies may choose
            another for `bg_color` where that is black.
        accumulation: see `integration.host.Host`.

    Attributes:
        views: the training views, by name and by camera.
        detail: f_det, which follows the host's structure even if it is not trained.

    Raises:
        SettingError: HR is used, but there is no `sr`; there is no camera; densification outlasts the anchor.
        DataError: two cameras have one name; an SR image is missing, or is not `factor` times as large as its photo.
        HostError: `gaussians` is not a GaussianModel as in 3DGS.
    """

    def __init__(
        self,
        gaussians: Any,
        cameras: Sequence[Any],
        conductor: Conductor,
        *,
        sr: SuperResolve | str | Path | None = None,
        suffix: str = "",
        factor: int = 4,
        threshold: float | None = 2e-4,
        densify_until: int | None = None,
        detail: bool = True,
        own_background: bool = False,
        accumulation: int = 1,
        seed: int = 0,
    ) -> None:
        required = (*_ATTRIBUTES.values(), "optimizer")
        if missing := [attribute for attribute in required if getattr(gaussians, attribute, None) is None]:
            raise HostError(
                f"{type(gaussians).__name__} has no {missing[0]}, which a GaussianModel has in 3DGS. Attach after "
                "gaussians.training_setup(opt). A model whose Gaussians a network computes, as in Scaffold-GS, has none, and its "
                "trainer does not work."
            )
        rows = {attribute: len(getattr(gaussians, attribute)) for attribute in _ATTRIBUTES.values()}
        if len({*rows.values()}) > 1:
            raise HostError(
                f"the Gaussians of {type(gaussians).__name__} must be rows of {', '.join(rows)}, got "
                f"{', '.join(map(str, rows.values()))} rows. A trainer that computes them from other parameters, as SCGaussian "
                "does their positions, does not work. FSGS and Binocular3DGS, also for few photos, do."
            )
        if "save_ply" in vars(gaussians):
            raise HostError("these gaussians are attached already; remove() the attachment that did it first.")
        require_end(conductor, densify_until, "densify_until_iter")
        self._model = gaussians
        self.views = HostViews(
            cameras, *Settings(sr=sr, suffix=suffix, factor=factor).sr_source(conductor), gaussians._xyz.device
        )
        warn_if_score_is_unused(conductor, gaussians, threshold)
        self._rows = CarriedRows(gaussians, self._host_params)
        self.detail, self._trains_detail = DetailFeature(lambda: gaussians._xyz, self._rows, conductor.detail), detail
        self._warn_once = Once(_log.warning)
        host = Host(
            self.params, self.detail.poll_parents, threshold=threshold, accumulation=accumulation, masks=self.views.masks,
            own_background=own_background, remedy="Nothing has their colour and rotation. End densification first.",
        )  # fmt: skip
        self.attachment = Attachment(conductor, host, self.views.all, seed=seed)
        undo = self.attachment.undo
        undo.callback(self._rows.remove)
        undo.enter_context(replaced_methods(gaussians, {
            **dict.fromkeys(_SAVERS, self._save_with_detail), "compute_3D_filter": self._compute_filter_at_hr,
            "training_setup": self._training_setup, "relocate_gs": self._relocate,
            "add_densification_stats": self._add_densification_stats,
        }))  # fmt: skip
        self._black: bool | None = None  # the host's background, once it is known
        self._centres = "viewspace_points"  # of a rendering, the tensor whose gradient the densifier reads
        self._rendered: Mapping[str, Any] = {}  # at LR, until the densifier has it
        self._hooks: list[Any] = []
        self._hook_optimizer()

    def params(self) -> dict[str, Tensor]:
        """The current leaves, by gsplat's names."""
        return {**self._host_params(), **({"detail": self.detail.value} if self._trains_detail else {})}

    def wrap(self, render: Callable[..., Any]) -> Callable[..., Any]:
        """`render` that renders training cameras at both scales, and shows f_base + f_det anywhere else."""
        signature = signature_of(render)

        @functools.wraps(render)
        @uncompiled
        def wrapped(viewpoint_camera: Any, pc: Any, *args: Any, **kwargs: Any) -> Any:
            other_colors = kwargs.get("override_color") is not None  # depth, normals: no photo
            if self.attachment.removed or pc is not self._model or other_colors:
                return render(viewpoint_camera, pc, *args, **kwargs)
            view = self.views.find(viewpoint_camera) if torch.is_grad_enabled() else None
            if view is None:  # evaluation, a viewer, a camera without a photo
                shown = Overrides(detail=self.detail.value.detach() if self._trains_detail else None)
                return render(viewpoint_camera, proxy(self._model, shown), *args, **kwargs)
            if kwargs.get("subpixel_offset") is not None:
                raise HostError(
                    "rays are jittered, and two scales of a view cannot share that. Train without ray_jitter."
                )
            self._require_pose_of_camera(signature.bind(viewpoint_camera, pc, *args, **kwargs).arguments)
            if self._model.optimizer is not self._optimizer:
                self._hook_optimizer()

            def render_at(target: Target, gate: Tensor | None, sized: View) -> HostOutput:
                camera, pinhole = self._camera_of(target, viewpoint_camera, sized)
                params = self.params() if target == "hr" else self._host_params()
                overrides = Overrides(gate, params.get("detail"))
                call = signature.bind(camera, proxy(self._model, overrides), *args, **kwargs)
                call.arguments |= self._bg_color(call.arguments.get("bg_color"))
                with collected_drawings() as drawings:
                    result = render(*call.args, **call.kwargs)
                ranks = hasattr(self._model, "xyz_gradient_accum_abs")
                output = host_output(
                    result, pinhole, params, gate, drawings, centres=self._centres, ranks_by_third_column=ranks
                )
                if target == "lr":
                    self._rendered = result
                self._warn_of_what_was_not_read(overrides, output)
                return output

            output = self.attachment.render_view(view, render_at)
            if not self.attachment.passes:
                self.detail.forget_gradient()
            return output

        return wrapped

    def replace_everywhere(self, render: Callable[..., Any]) -> Callable[..., Any]:
        """Replace the function by its wrapped version in every loaded module, under any name; `remove` undoes it."""
        wrapped = self.wrap(render)
        self.attachment.undo.enter_context(replaced_everywhere(render, wrapped))
        return wrapped

    @torch.no_grad()
    def fold_detail(self) -> None:
        """Add f_det to the constant band of the colours and set it to 0."""
        self._model._features_dc += sh0_offset(self.detail.value, self._model._features_dc)
        self.detail.value.zero_()

    def remove(self) -> None:
        """Restore the loop; f_det is no longer shown, see `fold_detail`."""
        self.attachment.remove()
        for hook in self._hooks:
            hook.remove()

    def _host_params(self) -> dict[str, Tensor]:
        return {name: getattr(self._model, attribute) for name, attribute in _ATTRIBUTES.items()}

    def _require_pose_of_camera(self, call: Mapping[str, Any]) -> None:
        """InstantSplat's render takes its pose from an argument, not from the camera."""
        making = [type(s).__name__ for s in self.attachment.conductor.showing]
        if making and call.get("camera_pose") is not None:
            raise HostError(
                f"render is given camera_pose, from which it would also draw the views of {', '.join(making)}, whose cameras lie "
                "elsewhere. Leave that strategy out, e.g. --overrides '~strategies.pseudo_views'."
            )

    def _camera_of(self, target: Target, camera: Any, view: View) -> tuple[Any, Camera]:
        """The host's camera that draws the target, and the same as a pinhole camera."""
        if isinstance(target, Camera):
            return replaced_camera(camera, target), target
        return (camera, view.lr.camera) if target == "lr" else (enlarged_camera(camera, view.factor), view.hr.camera)

    def _warn_of_what_was_not_read(self, overrides: Overrides, output: HostOutput) -> None:
        scoring = self.attachment.conductor.owner("score")
        if overrides.gate is not None and "gate" not in overrides.used:
            self._warn_once("render reads none of the model's opacity getters: dropout has no effect.")
        if overrides.detail is not None and "detail" not in overrides.used:
            self._warn_once("render does not read the model's constant colours: the detail feature has no effect.")
        if output.shot.gradient_slot.tensor.shape[-1] == 4 and scoring is not None:
            self._warn_once(
                "viewspace_points have 4 columns: absolute gradients stay those of the LR image, and the densification "
                "score of %s goes to the first two columns only.", type(scoring).__name__,
            )  # fmt: skip

    def _bg_color(self, own: Tensor | None) -> dict[str, Tensor]:
        """The colour that the strategies choose for this iteration, in place of the host's own, which must be black."""
        color = self.attachment.background
        if color is None or own is None:
            return {}
        if self._black is None:
            self._black = not bool(own.any())
            if not self._black:
                _log.warning("the background stays as it is: strategies choose another only in place of a black one.")
        return {"bg_color": color_on(color, own.device, own.dtype)[0]} if self._black else {}

    def _relocate(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """3dgs-mcmc has a threshold of the gradient among its options, but reads opacities alone."""
        if (scoring := self.attachment.conductor.owner("score")) is not None:
            self._warn_once(
                "%s relocates Gaussians by their opacity: the densification score of %s has no effect.",
                type(self._model).__name__, type(scoring).__name__,
            )  # fmt: skip
        return original(*args, **kwargs)

    def _add_densification_stats(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """Its first argument is viewspace_points; in Deformable 3DGS and others it is viewspace_points_densify."""
        centres, rendered, self._rendered = next(iter((*args, *kwargs.values())), None), self._rendered, {}
        self._centres = next((name for name, x in rendered.items() if x is centres), self._centres)
        return original(*args, **kwargs)

    def _training_setup(self, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """The host starts again with a new optimizer, as `restore` does with the parameters of a checkpoint."""
        result = original(*args, **kwargs)
        self._hook_optimizer()
        return result

    def _compute_filter_at_hr(self, original: Callable[..., Any], cameras: Sequence[Any]) -> Any:
        """Mip-Splatting's 3D filter limits Gaussians to what the finest training camera samples, and that is one at HR."""
        return original([enlarged_camera(camera, self.views.factor) for camera in cameras])

    def _hook_optimizer(self) -> None:
        for hook in self._hooks:
            hook.remove()
        self._optimizer = optimizer = self._model.optimizer
        self._hooks = [
            optimizer.register_step_post_hook(lambda *_: self.detail.step()),
            optimizer.register_state_dict_post_hook(self._save_state),
            optimizer.register_load_state_dict_pre_hook(self._load_state),
        ]
        ours = set(map(id, self._host_params().values()))
        self.attachment.hook([  # Taming-3DGS and FastGS have one more, of the higher SH bands
            o for o in vars(self._model).values()
            if isinstance(o, torch.optim.Optimizer) and any(id(p) in ours for g in o.param_groups for p in g["params"])
        ])  # fmt: skip

    def _save_state(self, _: Any, stored: dict[str, Any]) -> None:
        stored[_STATE] = {"detail": self.detail.state_dict(), "attachment": self.attachment.state_dict()}

    def _load_state(self, _: Any, stored: dict[str, Any]) -> None:
        if _STATE not in stored:
            raise HostError(
                "the checkpoint was written without CLEAR: it holds neither the iteration nor f_det. Start from the "
                "beginning, or from a checkpoint of a run with CLEAR."
            )
        self.detail.load_state_dict(stored[_STATE]["detail"])
        self.attachment.load_state_dict(stored[_STATE]["attachment"])

    def _save_with_detail(self, save: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """`save_ply` with f_det in the colours of the file."""
        trained = self._model._features_dc
        shown = torch.nn.Parameter(trained.detach() + sh0_offset(self.detail.value.detach(), trained))
        with replaced_attribute(self._model, "_features_dc", shown):
            return save(*args, **kwargs)


attach = Attached
