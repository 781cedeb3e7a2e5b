"""Settings on the command line: outside their range, of another type, or of a name that nothing has."""

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

# What the message says beside the setting's name (nothing: that name alone), and the overrides that are refused with it.
_REFUSED: dict[str, str] = {
    "": """
        +strategies.gco.tolerances=0.1 strategies.svs.dropout.maximum=1 +strategies.mine={} rasterizer.alpha_max=1
        rasterizer.alpha_min=0 rasterizer.alpha_min=0.999 rasterizer.transmittance_min=1 rasterizer.near=0
        rasterizer.kernel=-1 rasterizer.memory=0 rasterizer.preset=best rasterizer.background=[0,0]
        rasterizer.background=[0,0,2] strategies.gco.weight_min=0.9 strategies.gco.weight_max=2
        strategies.gco.groups=[colour] strategies.p2g.reliability_scale=0
        strategies.p2g.reliability_scale=relative:x strategies.p2g.reliability_scale=relative:0
        objective.kernels=fortran data.views.sr_scale=0 data.views.sr_scale=2.5 data.views.shrink=0
        data.views.train=0 data.views.photos_are=low data.views.train_names=[] rasterizer.lanes=0""",
    "at least 1": """
        fit.iterations=0 fit.iterations=-5 fit.keep=0 fit.threads=0 density.every=0 density.max_gaussians=0
        density.min_gaussians=0 decorators.back_projected.rounds=0 strategies.pseudo_views.every=0
        strategies.pseudo_views.count=0 strategies.pseudo_views.max_pixels=0 strategies.mcmc.every=0
        strategies.p2g.patch=0 objective.haar_levels=0 data.cloud.stride=0 data.cloud.max_points=-1
        skips.hr_every=0""",
    "whole number": "fit.iterations=1.5 fit.iterations=many fit.iterations=null fit.seed=x data.views.sr_scale=4.0",
    "at most 3": "fit.max_degree=4",
    "at least 0": """
        fit.max_degree=-1 fit.probe_every=-1 fit.probe_views=-1 fit.checkpoint_every=-1 fit.degree_every=-1
        fit.map_views=-1 fit.video=-1 density.reset_every=-1 optim.detail_steps=-1
        optim.geometry_steps=-1 skips.coarse_until=-1 strategies.svs.looks=-1""",
    "auto": "fit.fused=sometimes data.cloud.densify=maybe",
    "cpu": "fit.device=tpu",
    "true or false": "fit.scale_schedule=7",
    "text": "fit.resume=[]",
    "> 0": """
        density.threshold=0 density.threshold=-1e-4 density.prune_world=0 strategies.pseudo_views.reach=0
        strategies.pseudo_views.tolerance=-1 strategies.pseudo_views.weight=0 strategies.p2g.detail_eps=0""",
    "finite": """
        density.threshold=.inf density.threshold=.nan optim.opacities=.nan strategies.pseudo_views.border=.inf
        data.cloud.outlier_ratio=.nan data.cloud.box=.inf""",
    "quantile": "density.mode=best",
    "mean": "density.reduce=median +strategies.svs.anchor_weights.mean=1",
    ">= 0": """
        density.clone_below=-1 strategies.mcmc.noise=-1 strategies.mcmc.growth=-0.1
        strategies.svs.anchor_strength=-1 strategies.svs.anchor_weights.means=-1 objective.lambda_hf=-1
        objective.lambda_lr=-1""",
    r"\[0, 1\)": """
        density.prune_opacity=1 density.prune_opacity=-0.1 optim.detail_decay=1 strategies.fading_opacity.rate=1
        strategies.fading_opacity.rate=-0.1 skips.plateau_gain=-1 strategies.gco.tolerance=1
        strategies.gco.tolerance=-0.1""",
    "must lie in": "optim.quats=-1 optim.scales=1e30",
    "number": "optim.sh0=x",
    r"\(0, 1\)": "optim.eps=1 optim.eps=0 optim.eps=-1e-15 strategies.mcmc.dead_opacity=0",
    "at least 9000": "optim.end=8000",
    r"\(0, 100\]": "optim.means.initial=0 optim.means.initial=1e30",
    "at most 100": "decorators.back_projected.rounds=1000000000000",
    r"\[0, 1\]": "strategies.pseudo_views.continued=2 strategies.p2g.floor=1.1 objective.lambda_ssim=1.5",
    ">= 1": "strategies.pseudo_views.border=0.5 strategies.mcmc.per_point=0.5",
    "opengl": "rasterizer.name=opengl",
    "bicubic": "strategies.p2g.down=sharp",
    "evidence": "strategies.p2g.score_by=luck",
    "sum": "strategies.svs.reduction=max",
    "<=": "objective.lambda_hr.start=9999",
    "lr": "objective.lr_from=sr",
    "cannot be imported": "+strategies.mine._target_=nowhere.Mine",
    "at least 2": "data.views.test_every=1",
    "at least": "data.views.test_limit=-1",
    "crop": "data.views.sizes=pad",
    "a list": "data.views.train_names=r_2",
    "stereo": "data.cloud.init=magic",
    "needs a PLY file": "data.cloud.init=ply",
    "0 or at least 2": "data.cloud.outlier_neighbours=1",
}


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
        return device.load_rasterizer(settings.rasterizer, settings.fit.device)

    return give


def _pattern(override: str, says: str) -> str:
    """The message names the setting, or what holds it."""
    names = override.lstrip("+").partition("=")[0].split(".")
    return says if "|" in says else rf"(?=.*({'|'.join(names[-2:])})).*{says or names[-1]}"


INPUTS = [
    BadInput("setting", override, _given(override), _pattern(override, says))
    for says, overrides in _REFUSED.items()
    for override in overrides.split()
]
