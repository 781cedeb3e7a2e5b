"""Each rasterizer's picture of a few Gaussians against the reference's, for `clear-strategies doctor`."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Final

import torch
from torch import Tensor

import rasterizers
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.errors import one_line
from rasterizers import native
from rasterizers.interface import BackendUnavailable, Camera, Splats

_TOLERANCE: Final = 2e-3  # backends differ in rounding, a wrong one by far more
_GAUSSIANS, _SIZE = 300, 64
_SLOW_TO_COMPILE: Final = ("warp",)  # on a CPU its first picture takes a minute, and its import half a second


def backends(broken: list[str], *, slow: bool) -> Iterator[tuple[str, str]]:
    """Each backend: why it is not here, or how its picture compares with the reference's and how long it took.

    Args:
        broken: takes the names of those that fail or differ.
        slow: test also those that compile for long first.
    """
    splats, camera = _scene()
    # For pictures this small, torch's own threads cost more than they bring.
    with native.kernel_threads(native.threads()):
        exact = rasterizers.load("torch", preset="accurate")(splats, camera).image
        for name in rasterizers.names():
            if name in _SLOW_TO_COMPILE and find_spec(name) is not None and not torch.cuda.is_available() and not slow:
                yield name, "installed, not tested: it compiles for a minute first (--all tests it); slow without CUDA"
                continue
            try:
                rasterizers.load(name)
            except BackendUnavailable as reason:
                yield name, f"not here: {reason}"
                continue
            try:
                text, works = _compared(name, splats, camera, exact)
            except (BackendUnavailable, RuntimeError, ValueError) as error:
                text, works = f"FAILS: {one_line(error)[:200]}", False
            if not works:
                broken.append(name)
            yield name, text


def _compared(name: str, splats: Splats, camera: Camera, exact: Tensor) -> tuple[str, bool]:
    """How the backend's picture differs from the reference's and how long it took, and whether they are the same."""
    rasterizer = rasterizers.load(name, preset="accurate")
    device = "cuda" if "cuda" in rasterizer.traits.devices and torch.cuda.is_available() else "cpu"
    splats = Splats(**{tensor: getattr(splats, tensor).to(device) for tensor in PARAMETERS})
    rasterizer(splats, camera)
    began = time.perf_counter()
    image = rasterizer(splats, camera).image.cpu()
    milliseconds = 1e3 * (time.perf_counter() - began)
    error = float((image - exact).abs().max())
    works = error <= _TOLERANCE
    module = getattr(rasterizer, "module", None)
    verdict = ("works" if works else "WRONG") + (f" ({module})" if isinstance(module, str) else "")
    return f"{verdict}: differs from the reference by {error:.1e}, {milliseconds:.1f} ms", works


def _scene() -> tuple[Splats, Camera]:
    g = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(_GAUSSIANS, *shape, generator=g)

    scales, opacities = (normal(3) * 0.3 - 2).exp(), normal().sigmoid()
    splats = Splats(normal(3), normal(4), scales, opacities, normal(1, 3), normal(3, 3) * 0.2)
    pose = torch.eye(4)
    pose[2, 3] = 5
    focal = _SIZE / 2 / math.tan(0.4)
    return splats, Camera(pose, focal, focal, _SIZE / 2, _SIZE / 2, _SIZE, _SIZE)
