"""Rasterizers for Gaussian splats: an image from splats and a camera, and the splats' gradients from the image's.

`load(name)` builds one of the backends of this package. A third party's rasterizer needs no registration: it implements
`interface.Rasterizer`, passes `testing.check_rasterizer`, and is configured by its path like a strategy,
`rasterizer._target_=my_package.MyRasterizer`. `rasterizers.interface` lists the steps. The same works for the classes of
this package: `_target_: rasterizers.cpp.CppRasterizer`.

This package does not depend on `clear_strategies`.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from dataclasses import fields
from typing import Any, Final

import torch

from rasterizers.interface import (
    PRESETS,
    BackendUnavailable,
    Camera,
    Rasterizer,
    RasterSettings,
    Rendering,
    SplatGradients,
    Splats,
    Traits,
)

__all__ = [
    "PRESETS", "BackendUnavailable", "Camera", "RasterSettings", "Rasterizer", "Rendering", "SplatGradients", "Splats",
    "Traits", "available", "fastest", "for_device", "load", "names", "rasterization",
]  # fmt: skip

# The module and the class of each backend. A backend imports its library when it is constructed.
_BACKENDS: Final[dict[str, tuple[str, str]]] = {
    "cpp": ("rasterizers.cpp", "CppRasterizer"),
    "torch": ("rasterizers.reference", "ReferenceRasterizer"),
    "warp": ("rasterizers.warp_backend", "WarpRasterizer"),
    "gsplat": ("rasterizers.gsplat_backend", "GsplatRasterizer"),
}
_ON_CUDA: Final = ("warp", "gsplat")


def load(name: str = "auto", *, preset: str | None = None, **settings: Any) -> Rasterizer:
    """One of this package's backends.

    Args:
        name: "cpp", "torch", "warp", "gsplat", or "auto" for the fastest that runs on this machine.
        preset: cut-offs by name, see `PRESETS`.
        settings: the fields of `RasterSettings`, and those that the backend adds. They override the preset.

    Raises:
        BackendUnavailable: the backend cannot run on this machine; the message says why and what to do.
        ValueError: there is no such backend, preset or setting, or a setting is out of range.
    """
    if preset is not None:
        if preset not in PRESETS:
            raise ValueError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}.")
        settings = {**PRESETS[preset], **settings}
    if name == "auto":
        name = fastest()
    if name not in _BACKENDS:
        raise ValueError(f"unknown rasterizer {name!r}; choose one of auto, {', '.join(_BACKENDS)}.")
    module, kind = _BACKENDS[name]
    backend = getattr(importlib.import_module(module), kind)
    known = [f.name for f in fields(backend) if f.init]
    unknown = sorted(set(settings) - set(known))
    if unknown:
        raise ValueError(f"unknown rasterizer setting {unknown[0]!r}; known are {', '.join(known)}.")
    rasterizer: Rasterizer = backend(**settings)
    return rasterizer


def fastest(device: str | torch.device | None = None) -> str:
    """The name of the fastest backend on this machine.

    Args:
        device: where the splats' tensors are; None: any.

    Raises:
        BackendUnavailable: none draws tensors there.
    """
    for name in names():
        with suppress(BackendUnavailable):
            backend = load(name)
            if device is None or torch.device(device).type in backend.traits.devices:
                return name
    raise BackendUnavailable(f"no rasterizer draws tensors on '{device}'; move the splats to 'cpu' or 'cuda'.")


def for_device(name: str, device: str) -> dict[str, str]:
    """The settings of `load` with which a backend draws tensors on this device."""
    return {"device": device} if name == "warp" else {}  # the only one for a CPU and CUDA that is bound to one of them


def available() -> dict[str, str | None]:
    """Every backend by name, fastest first; the value is None, or why the backend cannot run on this machine."""
    reasons: dict[str, str | None] = {}
    for name in names():
        try:
            load(name)
            reasons[name] = None
        except BackendUnavailable as reason:
            reasons[name] = str(reason)
    return reasons


def names() -> list[str]:
    """Every backend, fastest first, whether it runs here or not.

    The CUDA backends come first where there is CUDA; without it they run slowly or not at all, and come last.
    """
    return sorted(_BACKENDS, key=lambda name: (name in _ON_CUDA) != torch.cuda.is_available())


def __getattr__(name: str) -> Any:
    """`rasterization`, whose module asks for this one."""
    if name == "rasterization":
        return importlib.import_module("rasterizers.as_gsplat").rasterization
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
