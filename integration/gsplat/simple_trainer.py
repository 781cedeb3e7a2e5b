"""`install`: one line in gsplat's examples/simple_trainer.py, with every schedule read from its own configuration."""

from __future__ import annotations

import copy
import functools
import inspect
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import torch
from torch import Tensor

from clear_strategies.console import show_in_host
from clear_strategies.core.view import View
from clear_strategies.errors import HostError, SettingError
from clear_strategies.merging.conductor import Conductor
from integration.densification import end_with_strategies, warn_of_pruning_by_size
from integration.detail import sh0_offset
from integration.gsplat.attached import Attached, require_bands
from integration.replacing import replaced_everywhere
from integration.settings import Settings
from integration.views import HostPhoto, no_stereo, stereo_points

_log = logging.getLogger(__name__)

_NEEDED: Final = {
    "batch_size": (1, "gradients of one view are merged per step"),
    "patch_size": (None, "SR images have the size of whole photos"),
    "sparse_grad": (False, "the gradients of all Gaussians are merged"),
    "visible_adam": (False, "at HR other Gaussians are visible than at LR"),
    "app_opt": (False, "its colours are no spherical harmonics"),
    "random_bkgd": (False, "the background is composed after rendering, at one scale only"),
    "use_bilateral_grid": (False, "it changes the colours of one scale only"),
    "use_fused_bilagrid": (False, "it changes the colours of one scale only"),
    "post_processing": (None, "it changes the colours of one scale only"),
    "compression": (None, "its format has no place for the detail feature"),
    "data_type": ("colmap", "other datasets have other cameras"),
}
"""Fields of the trainer's Config: what CLEAR needs, and why."""
_NEEDED_BY_STEREO: Final = {
    "camera_model": ("pinhole", "points=stereo is between such photos; undistort them, or leave points at own"),
}
_CREATE: Final = "create_splats_with_optimizers"


def install(
    runner_class: Any,
    settings: Settings | None = None,
    *,
    installed: Callable[[Attached], None] = lambda attached: None,
    **changes: Any,
) -> None:
    """Train every later `Runner` of simple_trainer.py with CLEAR.

    When its `train` begins, the strategies are attached to its splats, and gsplat's `rasterization` and `export_splats`
    are replaced wherever they were imported. A view is recognised by its `image_id`, so poses may be optimized.

    Args:
        runner_class: simple_trainer's `Runner`. Its Config stretches the schedules (`max_steps`), and
            `strategy.refine_stop_iter` is lowered to the step at which a strategy ends densification.
        settings: None: the defaults. changes: fields of `Settings` in place of those, e.g. sr="sr_x4".
        installed: called with every attachment.

    Raises:
        SettingError: see `Settings`.
        HostError: points=stereo, and the module of the class has no `create_splats_with_optimizers` or no `Dataset`.
    """
    show_in_host()
    wanted = replace(settings or Settings(), **changes)
    if wanted.points == "stereo":
        start_from_stereo(runner_class)
    train, rasterize_splats = runner_class.train, runner_class.rasterize_splats
    last: Attached | None = None  # of the last Runner, which may be evaluated after its training

    @functools.wraps(train)
    def train_with_clear(runner: Any) -> Any:
        nonlocal last
        require_supported(runner.cfg, from_stereo=wanted.points == "stereo")
        require_bands(runner.splats)  # before SR images are made
        chosen = wanted.conductor(runner.cfg.max_steps)
        end_with_strategies(chosen, runner.cfg.strategy, "refine_stop_iter", first=0)
        warn_of_pruning_by_size(runner.cfg.strategy, runner.strategy_state, runner.splats["scales"])
        source, scale = wanted.sr_source(chosen)
        photos = photos_of(runner.trainset, runner.device)
        masks = {photo.name: photo.mask for photo in photos if photo.mask is not None}
        if last is not None:
            last.fold_detail()
            last.remove()
        views = [photo.view(source, scale) for photo in photos]
        runner.clear = last = _attach(runner, views, masks, chosen, wanted)
        installed(last)
        result = train(runner)
        _log.info("%s.", last.attachment.summary())
        return result

    @functools.wraps(rasterize_splats)
    def rasterize_the_view(runner: Any, *args: Any, **kwargs: Any) -> Any:
        clear, image_ids = getattr(runner, "clear", None), kwargs.get("image_ids")
        if clear is None or image_ids is None or not torch.is_grad_enabled():
            return rasterize_splats(runner, *args, **kwargs)
        with clear.rendering(clear.views[int(image_ids)]):
            return rasterize_splats(runner, *args, **kwargs)

    runner_class.train, runner_class.rasterize_splats = train_with_clear, rasterize_the_view
    module = _module_of(runner_class)
    if "cli" in module:
        module["cli"] = in_one_process(module["cli"])


def in_one_process(cli: Callable[..., Any]) -> Callable[..., Any]:
    """Gsplat's `cli`, which refuses to start a process for each GPU: none of them would call `install`."""

    @functools.wraps(cli)
    def started(*args: Any, **kwargs: Any) -> Any:
        if (n := torch.cuda.device_count()) > 1:
            raise SettingError(
                f"CLEAR trains in one process, but gsplat would start {n} without it, one for each GPU. Set "
                "CUDA_VISIBLE_DEVICES=0."
            )
        return cli(*args, **kwargs)

    return started


def _module_of(runner_class: Any) -> dict[str, Any]:
    """The names of the module that defines the class; empty if it is unknown."""
    return getattr(inspect.unwrap(runner_class.__init__), "__globals__", {})


def require_supported(config: Any, *, from_stereo: bool) -> None:
    """Raise a SettingError for an option of simple_trainer that does not work with two scales, or with points from stereo."""
    for name, (needed, why) in (_NEEDED | (_NEEDED_BY_STEREO if from_stereo else {})).items():
        found = getattr(config, name, needed)
        if found != needed:
            raise SettingError(f"{name}: CLEAR needs {needed}, got {found}: {why}.")


def _attach(
    runner: Any, views: Sequence[View], masks: Mapping[str, Tensor], chosen: Conductor, wanted: Settings
) -> Attached:
    """Attach CLEAR to a Runner, whose files then hold f_base + f_det."""
    splats = runner.splats
    attached = Attached(
        splats, runner.optimizers, views, chosen, strategy=runner.cfg.strategy, seed=wanted.seed, masks=masks,
        state=getattr(getattr(runner, "scene", None), "signal", None), iterations=runner.cfg.max_steps, hr_by=wanted.hr_by,
        accumulation=wanted.accumulation,
    )  # fmt: skip
    attached.replace_everywhere(sys.modules["gsplat.rendering"].rasterization)
    splats.register_state_dict_post_hook(_fold)
    if (export := getattr(sys.modules["gsplat"], "export_splats", None)) is not None:

        @functools.wraps(export)
        def export_with_detail(*args: Any, **kwargs: Any) -> Any:
            if "sh0" not in kwargs:
                raise HostError("export_splats must be called with sh0=…, as simple_trainer does.")
            sh0, detail = kwargs["sh0"], splats["detail"]
            if len(sh0) == len(detail):
                kwargs["sh0"] = sh0.detach() + sh0_offset(detail.detach(), sh0)
            return export(*args, **kwargs)

        attached.attachment.undo.enter_context(replaced_everywhere(export, export_with_detail))
    return attached


def _fold(_: Any, stored: dict[str, Any], prefix: str, *__: Any) -> None:
    """Store f_base + f_det as a checkpoint's sh0, and only the keys that the trainer's evaluation expects."""
    detail = stored.pop(f"{prefix}detail")
    stored[f"{prefix}sh0"] = stored[f"{prefix}sh0"] + sh0_offset(detail, stored[f"{prefix}sh0"])


def photos_of(dataset: Any, device: torch.device | str = "cpu") -> list[HostPhoto]:
    """The photos of a `Dataset`, in its order and in the world of its parser (photo i is `image_id` i).

    gsplat sets its rendering to 0 outside of a mask.
    """
    photos = []
    for i in range(len(dataset)):
        item, name = dataset[i], str(dataset.parser.image_names[dataset.indices[i]])
        image, mask = (item["image"] / 255).to(device), item.get("mask")
        shown = None if mask is None or bool(mask.all()) else mask.to(image)
        photos.append(HostPhoto(name, image, torch.linalg.inv(item["camtoworld"]).to(device), item["K"], shown))
    return photos


def start_from_stereo(runner_class: Any) -> None:
    """Make every later `Runner` start from the stereo cloud of its training photos.

    simple_trainer's `create_splats_with_optimizers` gets a parser whose `points` and `points_rgb` are that cloud; the
    runner's own parser stays as it is. With an `init_type` other than "sfm", which reads no points, a warning says so.

    Args:
        runner_class: simple_trainer's `Runner`.

    Raises:
        HostError: the module of the class has no create_splats_with_optimizers or no Dataset.
    """
    module = _module_of(runner_class)
    if missing := [name for name in (_CREATE, "Dataset") if name not in module]:
        raise no_stereo(
            f"the module of {runner_class.__name__} has no {missing[0]}, which gsplat's simple_trainer.py has"
        )
    create, dataset = module[_CREATE], module["Dataset"]

    @functools.wraps(create)
    def create_from_stereo(parser: Any, *args: Any, **kwargs: Any) -> Any:
        call = inspect.signature(create).bind(parser, *args, **kwargs)
        call.apply_defaults()  # a fork may have another
        init_type = call.arguments.get("init_type", "sfm")
        if init_type == "sfm":
            cloud = stereo_points(photos_of(dataset(parser, split="train")))
            parser = copy.copy(parser)  # other uses of its points (depths) need the original
            parser.points, parser.points_rgb = cloud.means.numpy(), (cloud.colors * 255).numpy()
        else:
            _log.warning("points=stereo has no effect with init_type=%s. Set init_type=sfm.", init_type)
        return create(parser, *args, **kwargs)

    module[_CREATE] = create_from_stereo
