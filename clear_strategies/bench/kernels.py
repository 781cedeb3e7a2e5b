"""How long do image losses with their gradients take, ours and everyone's, and how far off are they? And the pass over the
Gaussians that follows: correct, merge, anchor, step?
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from clear_strategies.bench import counting, gaussians
from clear_strategies.bench.output import Findings, Section, number, small, times
from clear_strategies.bench.peaks import Peaks, attained
from clear_strategies.bench.rasterizers import require_device
from clear_strategies.bench.rounds import WARM_UPS, Contender, Milliseconds, bar, interleaved, medians, milliseconds
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import DataError
from clear_strategies.kernels import losses

SIZES: Final = ("1008x756", "252x189")  # HR and LR of the iteration that is timed
SSIM, PHOTOMETRIC, HAAR = "SSIM", "L1 + SSIM", "Haar L1"
_LAMBDA: Final = 0.2  # share of SSIM in L1 + SSIM, as 3DGS has it
_GROUPED: Final = "torch, grouped conv 11x11"

Image = Float[Tensor, "H W 3"]
Gradient = Callable[[Image, Image], Tensor]  # ∇_x of a loss, or of minus it: signs do not matter here


@dataclass(frozen=True, slots=True)
class Competitor:
    """A way to a gradient.

    Args:
        prepare: from [H, W, 3] to the layout it likes; not timed.
        truth: what it is held against, in float64: the specification, or itself where its padding differs from 3DGS's.
    """

    name: str
    gradient: Gradient
    truth: Gradient
    prepare: Callable[[Tensor], Tensor] = lambda image: image


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line."""

    sizes: Sequence[str]
    repeats: int
    device: str = "cpu"
    gaussians: Sequence[int] = ()
    floors: bool = False


def measure(request: Request, say: Callable[[str], None]) -> Findings:
    """Every loss at every size, and the pass over so many Gaussians.

    Raises:
        DataError: a size is not WIDTHxHEIGHT, or there is no such device.
    """
    findings = Findings("kernels", torch.get_num_threads())
    rows = []

    def skip(line: str) -> None:
        say(line)
        findings.skipped.append(line)

    require_device(request.device)
    sizes = {size: _parsed(size) for size in request.sizes}
    peaks = Peaks.measured(request.device) if request.floors else None
    ours = {loss: _ours(loss, request.device) for loss in (SSIM, PHOTOMETRIC, HAAR)}
    losses = {SSIM: [*ours[SSIM], *_peers(request.device, skip)], PHOTOMETRIC: ours[PHOTOMETRIC], HAAR: ours[HAAR]}
    warm_ups = WARM_UPS[request.device]
    for size, (width, height) in sizes.items():
        x, y = (image.to(request.device) for image in images(width, height))
        for loss, competitors in losses.items():
            turns: dict[str, Contender] = {c.name: _turn(c, x, y) for c in competitors}
            with bar(len(turns) * (request.repeats + warm_ups), f"{loss} {size}") as progress:
                ms = interleaved(turns, request.repeats, warm_ups=warm_ups, progress=progress)
            for c in competitors:
                error = _error(c, x, y)
                rows.append({"loss": loss, "size": size, "name": c.name, "ms": ms[c.name]["gradient"], "error": error})
    findings.sections = [_section(rows, loss, request.sizes) for loss in losses]
    if peaks is not None:
        findings.sections += [_floor_section(rows, size, 3 * w * h, peaks) for size, (w, h) in sizes.items()]
    passes = [gaussians.measure(n, request.repeats, request.device, skip) for n in request.gaussians]
    for one in passes:
        findings.sections += one.sections(peaks)
    findings.raw = {"device": request.device, "rows": rows, "gaussians": {one.n: one.ms for one in passes}}
    return findings


def images(width: int, height: int) -> tuple[Image, Image]:
    """Smooth shapes and noise, and the same with other noise: a render beside its photo."""
    generator = torch.Generator().manual_seed(0)
    rough = torch.rand(1, 3, max(2, height // 16), max(2, width // 16), generator=generator)
    smooth = F.interpolate(rough, size=(height, width), mode="bilinear")[0].movedim(0, -1)
    x, y = (smooth + 0.05 * torch.randn(height, width, 3, generator=generator) for _ in range(2))
    return x.clamp(0, 1).contiguous(), y.clamp(0, 1).contiguous()


def grouped_convolution(x: Float[Tensor, "1 C H W"], y: Float[Tensor, "1 C H W"]) -> Tensor:
    """SSIM as 3DGS's trainer and most of its children compute it: five grouped convolutions, the rest by autograd."""
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


def _ours(loss: str, device: str = "cpu") -> list[Competitor]:
    """Every implementation that the trainer has for images on the device; float64 of the specification is the truth."""
    truth = _gradient_of(importlib.import_module("clear_strategies.kernels.losses.reference"), loss)
    return [
        Competitor(f"ours, {name}", _gradient_of(implementation, loss), truth)
        for name, implementation in losses.implementations(device).items()
    ]


def _gradient_of(implementation: Any, loss: str) -> Gradient:
    if loss == SSIM:
        return lambda x, y: implementation.ssim(x, y).gradient
    if loss == HAAR:
        return lambda x, y: implementation.haar_l1(x, y).gradient
    return lambda x, y: implementation.photometric(x, y, _LAMBDA).gradient


def _peers(device: str, skip: Callable[[str], None]) -> list[Competitor]:
    """Those that are installed. Each in its own definition: kornia reflects the border, others leave it out."""
    (specification, *_) = _ours(SSIM)
    peers = [Competitor(_GROUPED, _taped(grouped_convolution), specification.truth, _nchw)]
    for package, build in (("kornia", _kornia), ("torchmetrics", _torchmetrics), ("pytorch-msssim", _msssim)):
        if found := _installed(package, build, skip):
            version, gradient = found
            peers.append(Competitor(f"{package} {version}", gradient, gradient, _nchw))
    for package, build in (("fused-ssim", _fused_ssim), ("gswarp", _gswarp)) if device == "cuda" else ():
        if found := _installed(package, build, skip):  # float32 alone, of 3DGS's definition
            version, gradient = found
            peers.append(Competitor(f"{package} {version}", gradient, specification.truth, _nchw))
    return peers


def _installed(
    package: str, build: Callable[[], Callable[[Tensor, Tensor], Tensor]], skip: Callable[[str], None]
) -> tuple[str, Gradient] | None:
    try:
        return metadata.version(package), _taped(build())
    except (ImportError, metadata.PackageNotFoundError):
        skip(f"{package}: not installed (pip install {package}).")
        return None


def _fused_ssim() -> Callable[[Tensor, Tensor], Tensor]:
    ssim: Callable[[Tensor, Tensor], Tensor] = importlib.import_module("fused_ssim").fused_ssim
    return ssim


def _gswarp() -> Callable[[Tensor, Tensor], Tensor]:
    ssim: Callable[[Tensor, Tensor], Tensor] = importlib.import_module("gswarp").fused_ssim
    return ssim


def _kornia() -> Callable[[Tensor, Tensor], Tensor]:
    ssim = importlib.import_module("kornia.metrics").ssim
    return lambda x, y: ssim(x, y, window_size=11).mean()


def _torchmetrics() -> Callable[[Tensor, Tensor], Tensor]:
    functional = importlib.import_module("torchmetrics.functional.image")
    return lambda x, y: functional.structural_similarity_index_measure(x, y, data_range=1.0)


def _msssim() -> Callable[[Tensor, Tensor], Tensor]:
    ssim = importlib.import_module("pytorch_msssim").ssim
    return lambda x, y: ssim(x, y, data_range=1.0)


def _taped(loss: Callable[[Tensor, Tensor], Tensor]) -> Gradient:
    """∇_x by autograd."""

    def gradient(x: Tensor, y: Tensor) -> Tensor:
        leaf = x.detach().requires_grad_()
        return torch.autograd.grad(loss(leaf, y), leaf)[0]

    return gradient


def _nchw(image: Image) -> Float[Tensor, "1 3 H W"]:
    return image.movedim(-1, 0)[None].contiguous()


def _turn(c: Competitor, x: Image, y: Image) -> Contender:
    prepared = c.prepare(x), c.prepare(y)

    def turn() -> Milliseconds:
        work_log = WorkLog(x.device)
        with work_log.stage("gradient"):
            c.gradient(*prepared)
        return milliseconds(work_log)

    return turn


def _error(c: Competitor, x: Image, y: Image) -> float:
    """‖g - g*‖ / ‖g*‖."""
    found = c.gradient(c.prepare(x), c.prepare(y)).double()
    if c.truth is c.gradient:
        expected = c.truth(c.prepare(x.double()), c.prepare(y.double()))
    else:
        expected = c.prepare(c.truth(x.double(), y.double()))
    same = min(float((found - sign * expected).norm()) for sign in (1, -1))
    return same / float(expected.norm())


def _section(rows: Sequence[Mapping[str, Any]], loss: str, sizes: Sequence[str]) -> Section:
    names = list(dict.fromkeys(row["name"] for row in rows if row["loss"] == loss))
    columns: dict[str, list[str]] = {"implementation": names}
    for size in sizes:
        of = {row["name"]: row for row in rows if row["loss"] == loss and row["size"] == size}
        ms = {name: medians({"ms": row["ms"]})["ms"] for name, row in of.items()}
        best = min(ms[name] for name in names if name.startswith("ours"))
        columns[f"{size}, ms"] = [number(ms[name]) for name in names]
        if len(names) > 1:
            columns[f"over our fastest, {size}"] = [times(ms[name] / best) for name in names]
        columns[f"gradient's error, {size}"] = [small(of[name]["error"]) for name in names]
    own = ", of the peer's own definition where its borders differ from 3DGS's" if loss == SSIM else ""
    note = (
        "Value and gradient with respect to one image, 3 channels; medians of turns taken alternately. Error: relative "
        f"L2 against float64{own}."
    )
    return Section(f"{loss}, with its gradient", columns, (note,))


def _floor_section(rows: Sequence[Mapping[str, Any]], size: str, values: int, peaks: Peaks) -> Section:
    costs = {SSIM: counting.ssim(values), PHOTOMETRIC: counting.photometric(values), HAAR: counting.haar(values)}
    ours = [row for row in rows if row["size"] == size and row["name"].startswith("ours")]
    ms = {(row["name"], row["loss"]): medians({"ms": row["ms"]})["ms"] for row in ours}
    return attained(f"{size}: how near the losses come to the device's limits", ms, costs, peaks)


def _parsed(size: str) -> tuple[int, int]:
    width, _, height = size.partition("x")
    if not (width.isdecimal() and height.isdecimal() and min(int(width), int(height)) >= 16):
        raise DataError("--size", size, "must be WIDTHxHEIGHT, at least 16 pixels each", "e.g. 1008x756")
    return int(width), int(height)
