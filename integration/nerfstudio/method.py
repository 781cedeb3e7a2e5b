"""`clear-splatfacto`: splatfacto with the strategies attached; its trainer and viewer are nerfstudio's own.

ns-train clear-splatfacto --data scene --pipeline.model.sr scene/sr
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal, get_args

import torch
from jaxtyping import Float
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.models import splatfacto
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from nerfstudio.plugins.types import MethodSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from clear_strategies.console import show_in_host
from clear_strategies.core.checks import require_choice
from clear_strategies.errors import SettingError
from integration.densification import end_with_strategies
from integration.detail import sh0_offset
from integration.gsplat import Attached, attach
from integration.nerfstudio.data import photos_of, prior, seed_with_stereo, views_from_datamanager
from integration.replacing import replaced_attribute
from integration.views import Points, save_photos

NAMES: Final = {"sh0": "features_dc", "shN": "features_rest"}
"""gsplat's parameter name -> splatfacto's, where they differ."""


@dataclass
class ClearDatamanagerConfig(FullImageDatamanagerConfig):  # type: ignore[misc]
    """nerfstudio's settings, and whose points the Gaussians start from.

    Raises:
        SettingError: `points` is neither own nor stereo.
    """

    _target: type = field(default_factory=lambda: ClearDatamanager)
    points: Literal["own", "stereo"] = "own"
    """own: the data set's points; stereo: dense stereo between the training photos"""

    def __post_init__(self) -> None:
        require_choice("points", self.points, get_args(Points))


class ClearDatamanager(FullImageDatamanager):  # type: ignore[misc]
    """nerfstudio's data manager; for training with points=stereo, the data set's points are replaced."""

    config: ClearDatamanagerConfig

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        if self.config.points == "stereo" and self.test_mode == "val":  # otherwise a checkpoint has the Gaussians
            show_in_host()
            seed_with_stereo(self)


@dataclass
class ClearSplatfactoModelConfig(SplatfactoModelConfig):  # type: ignore[misc]
    """splatfacto's settings, the strategies' settings, and the source of the SR images.

    Raises:
        SettingError: a setting of splatfacto does not work with two scales.
    """

    _target: type = field(default_factory=lambda: ClearSplatfactoModel)
    strategies: str = "clear"
    """their names, as in +strategy= of clear-strategies: clear, gco, gco,svs, baseline ..."""
    overrides: tuple[str, ...] = ()
    """settings of the strategies and the objective: strategies.gco.tolerance=0.1 objective=paper ..."""
    sr: Path | None = None
    """folder with one SR image per photo (same stem), or an ONNX network; none: bicubic, which adds no detail"""
    factor: int = 4
    """HR pixels per LR pixel along an edge"""
    save_lr: Path | None = None
    """write the photos here as they are trained on, undistorted, for an SR tool to enlarge"""
    background_color: Literal["random", "black", "white"] = "black"
    """black: the background of the SR images"""
    num_downscales: int = 0
    """0: LR photos and SR images have one size each"""

    def __post_init__(self) -> None:
        for name, found, needed, why in (
            ("num_downscales", self.num_downscales, 0, "LR photos and SR images have one size each"),
            ("background_color", self.background_color, "black", "both scales are compared over the same colour"),
            ("camera_optimizer.mode", self.camera_optimizer.mode, "off", "a view is recognised by its pose"),
            ("use_bilateral_grid", self.use_bilateral_grid, False, "it changes the colours of one scale only"),
        ):
            if found != needed:
                raise SettingError(f"{name}: clear-splatfacto needs {needed}, got {found}: {why}.")
        for name, least in (("sh_degree", 1), ("factor", 2)):
            if getattr(self, name) < least:
                raise SettingError(f"{name}: clear-splatfacto needs at least {least}, got {getattr(self, name)}.")


class ClearSplatfactoModel(SplatfactoModel):  # type: ignore[misc]
    """splatfacto with the detail feature f_det, trained with the strategies.

    Attributes:
        attached: not None from the trainer's request for callbacks until training ends.
    """

    config: ClearSplatfactoModelConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        self.gauss_params["detail"] = torch.nn.Parameter(torch.zeros_like(self.gauss_params["means"]))
        self.attached: Attached | None = None

    @property
    def features_dc(self) -> Float[Tensor, "N 3"]:
        """f_base in training, where LR is rendered; f_base + f_det for the viewer, evaluation and exports."""
        base: Tensor = self.gauss_params["features_dc"]
        return base if self.training else base + sh0_offset(self.gauss_params["detail"], base)

    def get_gaussian_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        groups: dict[str, list[torch.nn.Parameter]] = super().get_gaussian_param_groups()
        return groups | {"detail": [self.gauss_params["detail"]]}

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        self.attached = self._attach(training_callback_attributes)
        return [
            *super().get_training_callbacks(training_callback_attributes),
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self._resume),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], self._detach),
        ]

    def get_outputs(self, camera: Any) -> dict[str, Any]:
        if not self.training or self.attached is None:
            return super().get_outputs(camera)  # type: ignore[no-any-return]
        with replaced_attribute(splatfacto, "rasterization", self.attached.wrap(splatfacto.rasterization)):
            return super().get_outputs(camera)  # type: ignore[no-any-return]

    def get_metrics_dict(self, outputs: Any, batch: Any) -> dict[str, Any]:
        metrics: dict[str, Any] = super().get_metrics_dict(outputs, batch)
        if self.training and self.attached is not None:
            metrics |= {f"clear_{name}": value for name, value in self.attached.attachment.log.items()}
        return metrics

    def _attach(self, host: TrainingCallbackAttributes) -> Attached:
        from clear_strategies.compose import conductor

        config, trainer, datamanager = self.config, host.trainer, host.pipeline.datamanager
        if accumulated := {group: n for group, n in trainer.gradient_accumulation_steps.items() if n != 1}:
            raise SettingError(
                f"gradient_accumulation_steps: clear-splatfacto merges the gradients of one view per step, got {accumulated}. "
                "Leave them at 1."
            )
        if config.random_init and getattr(datamanager.config, "points", "own") == "stereo":
            CONSOLE.log("points=stereo has no effect with random_init. Set pipeline.model.random_init=False.")
        if config.save_lr is not None:
            save_photos(photos_of(datamanager), config.save_lr)
            CONSOLE.log(
                f"CLEAR: wrote the LR photos to {config.save_lr}; enlarge them x{config.factor} for pipeline.model.sr."
            )
        end = trainer._start_step + trainer.config.max_num_iterations  # a resumed training makes as many more
        chosen = conductor(config.strategies, *config.overrides, iterations=end)
        sr = chosen.prior(prior(config.sr))
        CONSOLE.log(
            f"CLEAR: {', '.join(type(s).__name__ for s in chosen.strategies) or 'no strategy'}; "
            f"SR images x{config.factor}: {sr.label}."
        )
        show_in_host()
        end_with_strategies(chosen, self.strategy, "refine_stop_iter", first=0)
        optimizers = host.optimizers.optimizers
        self._give_loaded(optimizers)
        for group in optimizers["detail"].param_groups:
            group["lr"] = chosen.detail.rate
        return attach(
            self.gauss_params, optimizers, views_from_datamanager(datamanager, sr, config.factor, self.device),
            chosen,
            strategy=self.strategy, state=self.strategy_state, names=NAMES, seed=trainer.config.machine.seed,
            loss_scale=host.grad_scaler.get_scale,
        )  # fmt: skip

    def _give_loaded(self, optimizers: Mapping[str, torch.optim.Optimizer]) -> None:
        """Have the optimizers step the parameters of a checkpoint, which splatfacto loads into new ones: they hold the old."""
        for name, (p,) in self.get_gaussian_param_groups().items():
            optimizer = optimizers[name]
            (held,) = optimizer.param_groups[0]["params"]
            if held is not p:
                optimizer.param_groups[0]["params"], optimizer.state[p] = [p], optimizer.state.pop(held, {})

    def _resume(self, step: int) -> None:
        """Continue a resumed training at its iteration."""
        attached = self.attached
        if attached is not None and not attached.attachment.counts and step > 0:
            CONSOLE.log(f"CLEAR: resumed at step {step}; the strategies' per-Gaussian state (SVS's anchor) is lost.")
            attached.attachment.t = step + 1

    def _detach(self, step: int) -> None:
        if self.attached is not None:
            CONSOLE.log(f"CLEAR: detached after step {step}: {self.attached.attachment.summary()}.")
            self.attached.remove()
            self.attached = None


@cache
def specification() -> MethodSpecification:
    """The method as nerfstudio's registry expects it: splatfacto's trainer, optimizers and data parser, with our data manager and
    model, and an optimizer of f_det. Its methods must be there, see `integration.nerfstudio`.
    """
    from nerfstudio.configs.method_configs import method_configs

    config = deepcopy(method_configs["splatfacto"])
    theirs = config.pipeline.datamanager
    config.method_name = "clear-splatfacto"
    config.pipeline.datamanager = ClearDatamanagerConfig(
        dataparser=theirs.dataparser, cache_images_type=theirs.cache_images_type
    )
    config.pipeline.model = ClearSplatfactoModelConfig()
    config.optimizers["detail"] = deepcopy(config.optimizers["features_dc"])  # at another rate, see `_attach`
    return MethodSpecification(config, "splatfacto on LR photos and SR images, merged by CLEAR's strategies")
