"""The rasterizer of a job, the device of its field, and its number of threads."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Final

import torch
from hydra.core.hydra_config import HydraConfig
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.core.points import spread
from clear_strategies.errors import SettingError
from clear_strategies.settings import TARGET
from clear_strategies.training.settings import Device
from rasterizers.interface import BackendUnavailable, Color, Rasterizer, RasterSettings

_log = logging.getLogger(__name__)

_SHARED: Final = RasterSettings()


@dataclass(frozen=True, slots=True)
class RasterizerSettings:
    """A rasterizer of this repository by name, and its settings; None: the backend's default.

    Args:
        name: auto, or a name of `rasterizers.names`.
        preset: fast, accurate or exact: sets alpha_min and transmittance_min where these are None. None: the backend's.
        kernel: variance of the 2D Mip kernel, px².
        near: smallest depth at which a Gaussian is drawn, world units.
        alpha_min: a contribution below it is not blended; None: by the preset.
        alpha_max: cap on a single contribution, in (0, 1 - 1e-7].
        transmittance_min: a pixel ends before its transmittance falls below it; None: by the preset.
        antialiased: scale the opacity to make up for the blur of the 2D kernel (Mip-Splatting).
        background: RGB in [0, 1]; None: that of the data set.
        memory: MiB that the lists of one image may take (cpp, warp).
        threads: number of threads of the kernels (cpp); None: as many as torch has.
        isa: instruction set of the kernels (cpp): avx512, avx2 or baseline; None: the fastest of this processor.
        lanes: pixel-Gaussian pairs that are blended at a time (torch).
        device: cpu or cuda (warp); None: that of the job.
    """

    name: str = "auto"
    preset: str | None = None
    kernel: float = _SHARED.kernel
    near: float = _SHARED.near
    alpha_min: float | None = None
    alpha_max: float = _SHARED.alpha_max
    transmittance_min: float | None = None
    background: Color | None = None
    antialiased: bool = _SHARED.antialiased
    memory: int | None = None
    threads: int | None = None
    isa: str | None = None
    lanes: int | None = None
    device: str | None = None

    def load(self, device: Device | None) -> tuple[str, functools.partial[Rasterizer]]:
        """The name of the backend, and a function that makes the rasterizer."""
        name = rasterizers.fastest(device) if self.name == "auto" else self.name
        settings = {key: value for key, value in asdict(self).items() if key != "name" and value is not None}
        of_device = {} if device is None else rasterizers.for_device(name, device)
        return name, functools.partial(rasterizers.load, name, **{**of_device, **settings})


BY_NAME: Final = f"{RasterizerSettings.__module__}.{RasterizerSettings.__qualname__}"
"""The `_target_` of a rasterizer of this repository."""


def rasterizer_node(node: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration's `rasterizer` for `build`. For a class of another package, `rasterizer._target_=pkg.Mine`, the
    fields of `RasterSettings` are kept, since they mean the same for each rasterizer; `name` and every None are left out.
    """
    if node.get(TARGET) in (None, BY_NAME):
        return dict(node)
    return {key: value for key, value in node.items() if key != "name" and value is not None} | {"_partial_": True}


@dataclass(frozen=True, slots=True)
class ReadyRasterizer:
    """A rasterizer that is ready to draw.

    Args:
        name: for the plan. device: of the drawing and the field.
        make: makes the rasterizer again, with other settings.
    """

    rasterizer: Rasterizer
    name: str
    device: Device
    make: functools.partial[Rasterizer]

    @property
    def rules(self) -> RasterSettings:
        """The settings that all rasterizers have in common."""
        given = self.make.keywords
        return RasterSettings(**{f.name: given[f.name] for f in fields(RasterSettings) if f.name in given})

    def of_scene(self, background: Color, means: Float[Tensor, "N 3"]) -> ReadyRasterizer:
        """Return the rasterizer for a scene of these points: over its background, unless the settings name one; if the points'
        `spread` is below 1, it scales a default near plane.
        """
        own: dict[str, Any] = {"background": background, **self.make.keywords}
        if own.get("near") == _SHARED.near and len(means) and 0 < (size := spread(means)) < 1:
            own["near"] = _SHARED.near * size
        make = functools.partial(self.make, **own)
        return replace(self, rasterizer=make(), make=make)


def load_rasterizer(
    settings: RasterizerSettings | functools.partial[Rasterizer], asked: Device | None
) -> ReadyRasterizer:
    """Make the rasterizer of the settings on the device that was asked for."""
    if asked == "cuda" and not torch.cuda.is_available():
        raise SettingError(
            "fit.device: is cuda, and torch finds no CUDA device. Install NVIDIA's driver and a torch built for CUDA, or "
            "take fit.device=cpu."
        )
    try:
        if isinstance(settings, RasterizerSettings):
            name, make = settings.load(asked)
        else:
            name, make = settings.func.__name__, settings
        rasterizer = make()
    except (ValueError, TypeError, BackendUnavailable) as error:
        raise SettingError(f"rasterizer: {error}") from error
    if not isinstance(rasterizer, Rasterizer):
        raise SettingError(
            f"rasterizer: {name} is no Rasterizer. rasterizers.testing.check_rasterizer says what is missing."
        )
    device = drawn_on(rasterizer.traits.devices, name, asked)
    return ReadyRasterizer(rasterizer, name if device == "cpu" else f"{name} on {device}", device, make)


def log_choice(settings: RasterizerSettings | functools.partial[Rasterizer], chosen: ReadyRasterizer) -> None:
    """Log why other backends were not chosen, if `auto` found neither CUDA nor compiled kernels."""
    auto = isinstance(settings, RasterizerSettings) and settings.name == "auto"
    if auto and chosen.device == "cpu" and not chosen.rasterizer.traits.native_threads:
        for name, reason in rasterizers.available().items():
            if reason is not None:
                _log.info("rasterizer %s is not available: %s", name, reason)


def drawn_on(devices: frozenset[str], name: str, asked: Device | None) -> Device:
    """The device that was asked for; None: the best one that this rasterizer draws on."""
    if asked is None:
        return "cuda" if "cuda" in devices and torch.cuda.is_available() else "cpu"
    if asked not in devices:
        raise SettingError(
            f"fit.device: is {asked}, and the rasterizer {name} draws on {' or '.join(sorted(devices))} alone. Choose "
            "another of the two, or leave fit.device=null."
        )
    return asked


def threads(asked: int | None) -> tuple[int, str]:
    """The number of threads of a job, at most torch's own, which OMP_NUM_THREADS sets; and the reason for it.

    Two jobs must not use the same core: OpenMP's threads wait by spinning, so two jobs of two threads on two cores are
    tens of times slower than two jobs of one thread.
    """
    if asked is not None:
        return asked, "fit.threads"
    jobs, here = jobs_at_once(), cores()
    at_once = jobs if jobs > 0 else max(1, here + 1 + jobs)  # as joblib counts: -1 is one job per core, -2 one fewer
    reason = f"of {here} here" if jobs == 1 else f"of {here} here, hydra.launcher.n_jobs={jobs}"
    return max(1, min(_threads_of_torch(), here // at_once)), reason


def jobs_at_once() -> int:
    """The number of jobs that share this machine and its terminal, as joblib counts them; 1 for other launchers."""
    launcher = HydraConfig.get().launcher if HydraConfig.initialized() else None
    return int(launcher.n_jobs) if launcher is not None and "n_jobs" in launcher else 1


def cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def _threads_of_torch() -> int:
    """The number of torch's threads before the first of a process's jobs changed it."""
    return torch.get_num_threads()
