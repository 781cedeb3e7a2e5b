"""Python imports this at its start: the CUDA of a real trainer is the CPU, and packages that need a network are absent.

Only for the programs that tests/hosts starts.
"""

import os
import sys
import types

import absent  # noqa: F401
import torch
from torch.overrides import TorchFunctionMode

CPU = torch.device("cpu")


def is_cuda(x):
    return str(x).startswith("cuda") if isinstance(x, str | torch.device) else False


def on_cpu(x):
    return CPU if is_cuda(x) else x


class CudaIsTheCpu(TorchFunctionMode):
    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func is torch.Tensor.cuda:
            return args[0]
        if getattr(func, "__name__", "") != "device":
            args = tuple(map(on_cpu, args))
        return func(*args, **{name: on_cpu(value) for name, value in (kwargs or {}).items()})


class Event:
    def __init__(self, *_, **__):
        pass

    def record(self):
        pass

    def elapsed_time(self, _):
        return 0.0


torch.set_num_threads(1)
CudaIsTheCpu().__enter__()
torch.nn.Module.cuda = lambda self, *_, **__: self
torch.cuda.Event = Event
for name in ("empty_cache", "synchronize", "manual_seed_all", "manual_seed", "set_device"):
    setattr(torch.cuda, name, lambda *_, **__: None)
load = torch.load
# The trainers' checkpoints are from before torch 2.6, and name a device that is not there.
torch.load = lambda *args, **kwargs: load(*args, **{"weights_only": False, **kwargs, "map_location": "cpu"})

lpips = types.ModuleType("lpipsPyTorch")  # its network would be downloaded
lpips.lpips = lambda *_, **__: torch.zeros(1)
sys.modules["lpipsPyTorch"] = lpips


class Midas(torch.nn.Module):
    """In place of FSGS's depth network."""

    def forward(self, x):
        return x.mean(1)


class Transforms:
    def dpt_transform(self, x):
        return torch.as_tensor(x).permute(2, 0, 1)[None].float() / 255


torch.hub.load = lambda repository, name, *_, **__: Transforms() if name == "transforms" else Midas()


if os.environ["HOST"].startswith("gsplat"):
    import gsplat_cpu  # noqa: F401
    import gsplat_relocation  # noqa: F401
    import no_lpips  # noqa: F401
