"""gsplat's CUDA as functions of this package, for its examples/simple_trainer.py."""

import functools
import inspect

import gsplat.distributed
import gsplat.rendering
import gsplat.strategy.ops
import torch
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci

from rasterizers import autograd

KNOWN = set(inspect.signature(autograd.rasterization).parameters)
theirs = inspect.signature(gsplat.rendering.rasterization)


@functools.wraps(gsplat.rendering.rasterization)
def rasterization(*args, **kwargs):
    call = theirs.bind(*args, **kwargs).arguments
    call["viewmats"] = call["viewmats"].detach()  # poses have no gradient in this package
    renders, alphas, info = autograd.rasterization(**{k: v for k, v in call.items() if k in KNOWN}, backend="torch")
    if call.get("with_ut"):  # the unscented transform has no gradient of the projected centres
        info["means2d"] = info["means2d"].detach()
    return renders, alphas, info


class InThisProcess(torch.utils.data.DataLoader):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **{k: v for k, v in kwargs.items() if k in ("batch_size", "shuffle")})


gsplat.rendering.rasterization = gsplat.rasterization = rasterization
gsplat.strategy.ops.quat_scale_to_covar_preci = _quat_scale_to_covar_preci
gsplat.distributed.cli = lambda train, config, verbose=False: train(0, 0, 1, config)
torch.cuda.device_count = lambda: 1
torch.utils.data.DataLoader = InThisProcess
