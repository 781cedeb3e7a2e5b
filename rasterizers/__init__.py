"""Splats and a camera in, an image and its transpose out. Usable alone: knows nothing of strategies."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

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
    "PRESETS",
    "BackendUnavailable",
    "Camera",
    "RasterSettings",
    "Rasterizer",
    "Rendering",
    "SplatGradients",
    "Splats",
    "Traits",
    "available",
    "fastest",
    "load",
]

# name -> module that defines `create(**settings)`. A backend imports its library only when it is created, so listing one
# here costs nothing.
_BACKENDS: dict[str, str] = {
    "cpp": "rasterizers.cpp",
    "torch": "rasterizers.reference",
    "warp": "rasterizers.warp_backend",
    "gsplat": "rasterizers.gsplat_backend",
}
_ON_CUDA = ("warp", "gsplat")


def load(name: str = "auto", *, preset: str | None = None, **settings: Any) -> Rasterizer:
    """The rasterizer called `name` ("auto": the fastest that runs here).

    `settings` are the fields of `RasterSettings`, plus whatever a backend documents of its own; they win over those of
    the `preset`, see `PRESETS`.

    Raises:
        BackendUnavailable: it cannot run here; the message says why and what to do.
        ValueError: no backend, or no preset, has that name.
    """
    if preset is not None:
        if preset not in PRESETS:
            raise ValueError(f"unknown preset {preset!r}; choose one of {', '.join(PRESETS)}.")
        settings = {**PRESETS[preset], **settings}
    if name == "auto":
        name = fastest()
    if name not in _BACKENDS:
        raise ValueError(f"unknown rasterizer {name!r}; choose one of auto, {', '.join(_BACKENDS)}.")
    rasterizer: Rasterizer = importlib.import_module(_BACKENDS[name]).create(**settings)
    return rasterizer


def fastest(device: str | None = None) -> str:
    """The name that "auto" stands for here.

    Args:
        device: "cpu" or "cuda", where the splats lie; None: wherever drawing is fastest.
    """
    return next(name for name, drawing in _running() if device is None or device in drawing.traits.devices)


def _running() -> Iterator[tuple[str, Rasterizer]]:
    """Those that run here, fastest first; none is loaded before it is asked for."""
    for name in _fastest_first():
        try:
            yield name, load(name)
        except BackendUnavailable:
            continue


def available() -> dict[str, str | None]:
    """Every backend by name, fastest first; the value is None, or the reason why it cannot run here."""
    reasons: dict[str, str | None] = {}
    for name in _fastest_first():
        try:
            load(name)
            reasons[name] = None
        except BackendUnavailable as reason:
            reasons[name] = str(reason)
    return reasons


def _fastest_first() -> list[str]:
    """Those that draw on CUDA win where there is CUDA; without it they can at most be checked, and come last."""
    return sorted(_BACKENDS, key=lambda name: (name in _ON_CUDA) != torch.cuda.is_available())
