"""Settings on the command line: outside their range, of another type, or of a name that nothing has."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from clear_strategies.compose import tree
from clear_strategies.jobs import device
from clear_strategies.jobs.settings import settings_of
from tests.helpers.configs import composed
from tests.stress.bad_inputs import BadInput

# An override, and what the message says beside the setting's name.
_REFUSED: dict[str, str] = {
    "fit.iterations=0": "at least 1, got 0",
    "fit.iterations=-5": "at least 1, got -5",
    "fit.iterations=1.5": "whole number",
    "fit.iterations=many": "whole number",
    "fit.iterations=null": "whole number",
    "fit.max_degree=4": "at most 3, got 4",
    "fit.max_degree=-1": "at least 0, got -1",
    "fit.keep=0": "at least 1, got 0",
    "fit.probe_every=-1": "at least 0, got -1",
    "fit.probe_views=-1": "at least 0, got -1",
    "fit.checkpoint_every=-1": "at least 0, got -1",
    "fit.degree_every=-1": "at least 0, got -1",
    "fit.fused=sometimes": "auto",
    "fit.map_views=-1": "at least 0",
    "fit.video=-1": "at least 0",
    "fit.threads=0": "at least 1",
    "fit.device=tpu": "cpu",
    "fit.seed=x": "whole number",
    "fit.scale_schedule=7": "true or false",
    "fit.resume=[]": "text",
    "density.threshold=0": "> 0",
    "density.threshold=-1e-4": "> 0",
    "density.threshold=.inf": "finite",
    "density.threshold=.nan": "finite",
    "density.mode=best": "quantile",
    "density.reduce=median": "mean",
    "density.every=0": "at least 1",
    "density.max_gaussians=0": "at least 1",
    "density.min_gaussians=0": "at least 1",
    "density.reset_every=-1": "at least 0",
    "density.prune_world=0": "> 0",
    "density.clone_below=-1": ">= 0",
    "density.prune_opacity=1": r"\[0, 1\)",
    "density.prune_opacity=-0.1": r"\[0, 1\)",
    "optim.quats=-1": "must lie in",
    "optim.scales=1e30": "must lie in",
    "optim.opacities=.nan": "finite",
    "optim.sh0=x": "number",
    "optim.eps=1": r"\(0, 1\)",
    "optim.eps=0": r"\(0, 1\)",
    "optim.eps=-1e-15": r"\(0, 1\)",
    "optim.detail_decay=1": r"\[0, 1\)",
    "optim.detail_steps=-1": "at least 0",
    "optim.geometry_steps=-1": "at least 0",
    "optim.end=8000": "at least 9000",
    "optim.means.initial=0": r"\(0, 100\]",
    "optim.means.initial=1e30": r"\(0, 100\]",
    "decorators.back_projected.rounds=0": "at least 1",
    "decorators.back_projected.rounds=1000000000000": "at most 100",
    "strategies.pseudo_views.every=0": "at least 1",
    "strategies.pseudo_views.count=0": "at least 1",
    "strategies.pseudo_views.reach=0": "> 0",
    "strategies.pseudo_views.tolerance=-1": "> 0",
    "strategies.pseudo_views.max_pixels=0": "at least 1",
    "strategies.pseudo_views.border=.inf": "finite",
    "strategies.pseudo_views.weight=0": "> 0",
    "strategies.pseudo_views.continued=2": r"\[0, 1\]",
    "strategies.pseudo_views.border=0.5": ">= 1",
    "strategies.fading_opacity.rate=1": r"\[0, 1\)",
    "strategies.fading_opacity.rate=-0.1": r"\[0, 1\)",
    "strategies.mcmc.noise=-1": ">= 0",
    "strategies.mcmc.per_point=0.5": ">= 1",
    "strategies.mcmc.dead_opacity=0": r"\(0, 1\)",
    "strategies.mcmc.every=0": "at least 1",
    "strategies.mcmc.growth=-0.1": ">= 0",
    "skips.plateau_gain=-1": r"\[0, 1\)",
    "skips.coarse_until=-1": "at least 0",
    "rasterizer.alpha_max=1": "alpha_max",
    "rasterizer.alpha_min=0": "alpha_min",
    "rasterizer.alpha_min=0.999": "alpha_min",
    "rasterizer.transmittance_min=1": "transmittance_min",
    "rasterizer.near=0": "near",
    "rasterizer.kernel=-1": "kernel",
    "rasterizer.memory=0": "memory",
    "rasterizer.preset=best": "preset",
    "rasterizer.name=opengl": "opengl",
    "rasterizer.background=[0,0]": "background",
    "rasterizer.background=[0,0,2]": "background",
    "strategies.gco.tolerance=1": r"\[0, 1\)",
    "strategies.gco.tolerance=-0.1": r"\[0, 1\)",
    "strategies.gco.weight_min=0.9": "weight_min",
    "strategies.gco.weight_max=2": "weight_max",
    "strategies.gco.groups=[colour]": "groups",
    "strategies.gco.tolerances=0.1": "",
    "strategies.p2g.reliability_scale=0": "reliability_scale",
    "strategies.p2g.reliability_scale=relative:x": "reliability_scale",
    "strategies.p2g.reliability_scale=relative:0": "reliability_scale",
    "strategies.p2g.floor=1.1": r"\[0, 1\]",
    "strategies.p2g.patch=0": "at least 1",
    "strategies.p2g.detail_eps=0": "> 0",
    "strategies.p2g.down=sharp": "bicubic",
    "strategies.p2g.score_by=luck": "evidence",
    "strategies.svs.looks=-1": "at least 0",
    "strategies.svs.anchor_strength=-1": ">= 0",
    "strategies.svs.reduction=max": "sum",
    "strategies.svs.anchor_weights.means=-1": ">= 0",
    "+strategies.svs.anchor_weights.mean=1": "mean",
    "strategies.svs.dropout.maximum=1": "",
    "objective.lambda_ssim=1.5": r"\[0, 1\]",
    "objective.lambda_hf=-1": ">= 0",
    "objective.lambda_lr=-1": ">= 0",
    "objective.haar_levels=0": "at least 1",
    "objective.kernels=fortran": "kernels",
    "objective.lambda_hr.start=9999": "<=",
    "objective.lr_from=sr": "lr",
    "+strategies.mine={}": "",
    "+strategies.mine._target_=nowhere.Mine": "cannot be imported",
    "data.views.sr_scale=0": "sr_scale",
    "data.views.sr_scale=2.5": "sr_scale",
    "data.views.shrink=0": "shrink",
    "data.views.train=0": "train",
    "data.views.photos_are=low": "photos_are",
    "data.views.sr_scale=4.0": "whole number",
    "data.views.test_every=1": "at least 2",
    "data.views.test_limit=-1": "at least",
    "data.views.sizes=pad": "crop",
    "data.views.train_names=r_2": "a list",
    "data.views.train_names=[]": "train_names",
    "data.cloud.init=magic": "stereo",
    "data.cloud.init=ply": "needs a PLY file",
    "data.cloud.densify=maybe": "auto",
    "data.cloud.stride=0": "at least 1",
    "data.cloud.max_points=-1": "at least 1",
    "data.cloud.outlier_neighbours=1": "0 or at least 2",
    "data.cloud.outlier_ratio=.nan": "finite",
    "data.cloud.box=.inf": "finite",
}  # fmt: skip


@cache
def _sound() -> DictConfig:
    return composed("+strategy=best")


def _given(override: str) -> Callable[[Path], object]:
    def give(folder: Path) -> object:
        config = copy.deepcopy(_sound())
        key, _, value = override.partition("=")
        added = key.startswith("+")
        OmegaConf.update(
            config, key.lstrip("+"), OmegaConf.create(f"v: {value}")["v"], merge=not added, force_add=added
        )
        settings = settings_of(tree(config))
        return device.drawing(settings.rasterizer, settings.fit.device)

    return give


def _pattern(override: str, says: str) -> str:
    """The message names the setting, or what holds it."""
    words = "|".join(override.lstrip("+").partition("=")[0].split(".")[-2:])
    return says if "|" in says else rf"(?=.*({words})).*{says}"


INPUTS = [
    BadInput("setting", override, _given(override), _pattern(override, says)) for override, says in _REFUSED.items()
]
