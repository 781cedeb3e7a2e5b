"""Time and error of the image losses with their gradients, and time of the per-Gaussian step."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from typing import Any, Final

import pandas as pd
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from clear_strategies.bench import step
from clear_strategies.bench.rasterizers import require_device
from clear_strategies.bench.results import Results
from clear_strategies.bench.timing import interleaved, medians, one_stage
from clear_strategies.errors import DataError
from clear_strategies.kernels import losses

SIZES: Final = ("1008x756", "252x189")  # HR and LR of the iteration that is timed
SSIM, PHOTOMETRIC, HAAR = "SSIM", "L1 + SSIM", "Haar L1"
_LAMBDA: Final = 0.2  # the share of SSIM in L1 + SSIM, as in 3DGS

Image = Float[Tensor, "H W 3"]
Batch = Float[Tensor, "1 3 H W"]
Gradient = Callable[[Tensor, Tensor], Tensor]  # the gradient of a loss with respect to its first image, up to its sign


@dataclass(frozen=True, slots=True)
class Competitor:
    """An implementation of a loss.

    Args:
        prepare: converts [H, W, 3] to the layout that it takes; not timed.
        truth: evaluated in float64; the specification, or itself where its borders differ from 3DGS's.
    """

    name: str
    gradient: Gradient
    truth: Gradient
    prepare: Callable[[Tensor], Tensor] = lambda image: image


def measure(
    results: Results, *, size: Sequence[str], repeats: int, device: str = "cpu", gaussians: Sequence[int] = ()
) -> None:
    """Measure every loss at every size, and the step of each number of Gaussians.

    Raises:
        DataError: a size is not WIDTHxHEIGHT, or there is no such device.
    """
    require_device(device)
    sizes = {text: _parse(text) for text in size}
    competitors = {loss: _ours(loss, device) for loss in (SSIM, PHOTOMETRIC, HAAR)}
    competitors[SSIM] += _peers(device, results.note)
    rows, turns = [], []
    for text, (width, height) in sizes.items():
        x, y = (image.to(device) for image in images(width, height))
        for loss, of_loss in competitors.items():
            runs = {c.name: partial(c.gradient, c.prepare(x), c.prepare(y)) for c in of_loss}
            contenders = {name: one_stage("gradient", device, run) for name, run in runs.items()}
            ms = interleaved(contenders, repeats, device=device, label=f"{loss} {text}")
            turns.append(ms.assign(loss=loss, size=text))
            median = medians(ms)["gradient"]
            fastest = median[[c.name for c in of_loss if c.name.startswith("ours")]].min()
            for c in of_loss:
                row = {"loss": loss, "size": text, "implementation": c.name, "ms": median[c.name]}
                rows.append(row | {"over_our_fastest": median[c.name] / fastest, "gradient_error": _error(c, x, y)})
    results.tables |= {"kernels": pd.DataFrame(rows), "kernels_turns": pd.concat(turns)}
    if gaussians:
        steps = [step.measure(n, repeats, device, results.note) for n in gaussians]
        results.tables["kernels_step"] = pd.concat(steps)


def images(width: int, height: int) -> tuple[Image, Image]:
    """Smooth shapes with noise, and the same shapes with other noise: like a render and its photo."""
    generator = torch.Generator().manual_seed(0)
    rough = torch.rand(1, 3, max(2, height // 16), max(2, width // 16), generator=generator)
    smooth = F.interpolate(rough, size=(height, width), mode="bilinear")[0].movedim(0, -1)
    x, y = (smooth + 0.05 * torch.randn(height, width, 3, generator=generator) for _ in range(2))
    return x.clamp(0, 1).contiguous(), y.clamp(0, 1).contiguous()


def grouped_convolution(x: Batch, y: Batch) -> Tensor:
    """SSIM as 3DGS's trainer computes it: five grouped convolutions, differentiated by autograd."""
    channels = x.shape[1]
    offsets = torch.arange(11, dtype=x.dtype, device=x.device) - 5
    line = torch.exp(-(offsets**2) / (2 * 1.5**2))
    line = line / line.sum()
    window = (line[:, None] * line[None, :]).expand(channels, 1, 11, 11).contiguous()

    def mean(image: Tensor) -> Tensor:
        return F.conv2d(image, window, padding=5, groups=channels)

    mu_x, mu_y = mean(x), mean(y)
    var_x, var_y = mean(x * x) - mu_x**2, mean(y * y) - mu_y**2
    covariance = mean(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    numerator = (2 * mu_x * mu_y + c1) * (2 * covariance + c2)
    return (numerator / ((mu_x**2 + mu_y**2 + c1) * (var_x + var_y + c2))).mean()


def batch(image: Image) -> Batch:
    """The layout that most libraries take."""
    return image.movedim(-1, 0)[None].contiguous()


def _ours(loss: str, device: str) -> list[Competitor]:
    """The trainer's implementations for images on the device; the torch reference is the truth."""
    gradients = {name: _gradient_of(name, loss) for name in losses.running_on(device)}
    return [Competitor(f"ours, {name}", gradient, gradients["torch"]) for name, gradient in gradients.items()]


def _gradient_of(kernels: losses.Choice, loss: str) -> Gradient:
    if loss == PHOTOMETRIC:
        return lambda x, y: losses.photometric(x, y, _LAMBDA, kernels=kernels).gradient
    if loss == SSIM:  # photometric at λ = 1 is 1 - SSIM
        return lambda x, y: -losses.photometric(x, y, 1.0, kernels=kernels).gradient
    return lambda x, y: losses.haar_l1(x, y, kernels=kernels).gradient


def _peers(device: str, note: Callable[[str], None]) -> Iterator[Competitor]:
    """SSIM of the installed libraries. Those on CUDA have 3DGS's borders, the others their own."""
    reference = _ours(SSIM, device)[0].truth
    yield Competitor("torch, grouped conv 11x11", _by_autograd(grouped_convolution), reference, batch)
    peers: dict[str, tuple[str, str, dict[str, Any]]] = {
        "kornia": ("kornia.metrics", "ssim", {"window_size": 11}),
        "torchmetrics": ("torchmetrics.functional.image", "structural_similarity_index_measure", {"data_range": 1.0}),
        "pytorch-msssim": ("pytorch_msssim", "ssim", {"data_range": 1.0}),
    }
    on_cuda: dict[str, tuple[str, str, dict[str, Any]]] = {
        "fused-ssim": ("fused_ssim", "fused_ssim", {}),
        "gswarp": ("gswarp", "fused_ssim", {}),
    }
    for package, (module, function, settings) in (peers | on_cuda if device == "cuda" else peers).items():
        try:
            name, ssim = f"{package} {metadata.version(package)}", getattr(importlib.import_module(module), function)
        except (ImportError, metadata.PackageNotFoundError):
            note(f"{package}: not installed (pip install {package}).")
            continue
        gradient = _by_autograd(partial(ssim, **settings))
        yield Competitor(name, gradient, reference if package in on_cuda else gradient, batch)


def _by_autograd(loss: Callable[[Tensor, Tensor], Tensor]) -> Gradient:
    def gradient(x: Tensor, y: Tensor) -> Tensor:
        leaf = x.detach().requires_grad_()
        return torch.autograd.grad(loss(leaf, y).mean(), leaf)[0]

    return gradient


def _error(c: Competitor, x: Image, y: Image) -> float:
    """The relative L2 error of the gradient, whichever sign the implementation gives it."""
    found = c.gradient(c.prepare(x), c.prepare(y)).double()
    if c.truth is c.gradient:
        expected = c.truth(c.prepare(x.double()), c.prepare(y.double()))
    else:
        expected = c.prepare(c.truth(x.double(), y.double()))
    return min(float((found - sign * expected).norm()) for sign in (1, -1)) / float(expected.norm())


def _parse(size: str) -> tuple[int, int]:
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 16):
        raise DataError("--size", size, "must be WIDTHxHEIGHT, at least 16 pixels each", "e.g. 1008x756")
    return int(width), int(height)
