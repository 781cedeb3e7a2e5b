"""How long does the pass over the Gaussians take, once their gradients are there: chain rule, correction, merge, anchor,
Adam, projection? In one pass, one by one, and beside torch's Adam alone, which is given what the others still have to find.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.bench import counting
from clear_strategies.bench.iteration import STILL, STRATEGIES
from clear_strategies.bench.output import Section, number, times
from clear_strategies.bench.peaks import Peaks, attained
from clear_strategies.bench.rounds import WARM_UPS, Contender, Milliseconds, bar, interleaved, medians, milliseconds
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.view import Photo, View
from clear_strategies.core.work_log import WorkLog
from clear_strategies.merging.conductor import Conductor
from clear_strategies.strategies.svs import SVS
from clear_strategies.training.compiled_step import compiled_step_for
from clear_strategies.training.field import FieldShot, GaussianField
from clear_strategies.training.optim import Adam
from rasterizers.interface import Camera, Rendering, SplatGradients, Splats

PASS, STEP = "merge and step", "step alone"
FUSED, READABLE = "ours, in one pass", "ours, one by one"

_BANDS: Final = 15  # SH degree 3
_SIZE: Final = 1e-5  # of a gradient, about what mean losses leave
_T: Final = SVS().anchor_start + 1  # HR at full weight, the anchor taken


@dataclass(frozen=True, slots=True, eq=False)
class Pass:
    """What was found for so many Gaussians: contender -> stage -> ms of every repeat."""

    n: int
    ms: Mapping[str, Mapping[str, Sequence[float]]]

    def sections(self, peaks: Peaks | None) -> list[Section]:
        median = {who: medians(stages) for who, stages in self.ms.items()}
        took = {(who, stage): ms for who, stages in median.items() for stage, ms in stages.items()}
        first = next(iter(took.values()))
        columns = {
            "implementation": [who for who, _ in took],
            "what": [stage for _, stage in took],
            "ms": [number(ms) for ms in took.values()],
            "over the first": [times(ms / first) for ms in took.values()],
        }
        note = (
            "Gradients of three losses as the rasterizer leaves them, to parameters that have stepped; torch's Adam alone is "
            "given the merged gradient."
        )
        title = f"{self.n:,} Gaussians: merge and step"
        sections = [Section(title, columns, (note,))]
        if peaks is not None:
            width = sum(p.shape[1:].numel() for p in _parameters(1, "cpu").values())
            costs = {
                PASS: counting.gaussian_pass(self.n, _BANDS, 3, anchored=True),
                STEP: counting.adam(self.n * width),
            }
            sections.append(attained(f"{title}, how near to the device's limits", took, costs, peaks))
        return sections


def measure(n: int, repeats: int, device: str, skip: Callable[[str], None]) -> Pass:
    """Everyone in turn; parameters stay where they are, all learning rates being 0."""
    turns: dict[str, Contender] = {}
    if (fused := _Ours(n, device, fused=True)).how is not None:
        turns[FUSED] = fused
    else:
        skip(f"{FUSED}: no compiled pass for {device} here; the log says why.")
    turns[READABLE] = _Ours(n, device, fused=False)
    turns |= {
        "torch, fused Adam": _Torch(n, device, fused=True),
        "torch, foreach Adam": _Torch(n, device, fused=False),
    }
    warm_ups = WARM_UPS[device]
    with bar(len(turns) * (repeats + warm_ups), f"{n:,} Gaussians") as progress:
        return Pass(n, interleaved(turns, repeats, warm_ups=warm_ups, progress=progress))


class _Ours:
    """A conductor with all strategies and an optimizer, as the trainer has them."""

    def __init__(self, n: int, device: str, *, fused: bool) -> None:
        self.field = GaussianField(_parameters(n, device), degree=3)
        self.field.filter_3d += 0.01
        self.conductor = Conductor(*STRATEGIES["clear"]())
        self.conductor.on_fit_start(1, 0, device)
        self.conductor.after_step(self.field.raw(), SVS().anchor_start)
        self.optimizer = Adam(self.field.raw(), STILL, 1.0)
        self.how = compiled_step_for(self.conductor, self.optimizer, "auto" if fused else "off")
        lr, hr = self.field.render_scales(_Given(n, device), _view(device))
        if lr is None or hr is None:
            raise TypeError("both scales were asked for")
        self.lr: FieldShot = lr
        self.hr: FieldShot = hr
        generator = torch.Generator().manual_seed(2)
        reliability, demand, m = torch.rand(3, n, generator=generator).to(device)
        self.evidence, self.m = Evidence(reliability, demand), m

    def __call__(self) -> Milliseconds:
        merger: Any = self.how if self.how is not None else self.conductor
        work_log, raw = WorkLog(self.m.device), self.field.raw()
        with work_log.stage(PASS):
            (g_lr,) = merger.vjp(self.lr, self.lr.image[None])
            base, hf = merger.vjp(self.hr, self.hr.image[None].expand(2, -1, -1, -1))
            g, _ = merger.merge(raw, g_lr, base, hf, self.m, self.evidence, _T)
            if self.how is None:
                self.optimizer.step(raw, g)
                self.field.constrain()
        return milliseconds(work_log)


class _Torch:
    """torch.optim.Adam on gradients that are there."""

    def __init__(self, n: int, device: str, *, fused: bool) -> None:
        leaves = [p.requires_grad_() for p in _parameters(n, device).values()]
        for p in leaves:
            p.grad = _SIZE * torch.randn_like(p)
        self.optimizer = torch.optim.Adam(leaves, lr=0.0, eps=STILL.eps, fused=fused, foreach=not fused)
        self.device = device

    def __call__(self) -> Milliseconds:
        work_log = WorkLog(self.device)
        with work_log.stage(STEP):
            self.optimizer.step()
        return milliseconds(work_log)


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """In a rasterizer's place: draws nothing, and has gradients."""

    n: int
    device: str
    tile: int = 16
    traits: Any = None

    def __call__(self, splats: Splats, camera: Camera, tiles: Tensor | None = None) -> Rendering:
        generator = torch.Generator().manual_seed(camera.width)

        def normal(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator).to(self.device)

        k = camera.width  # LR sends one gradient back, HR two
        rows = (normal(k, self.n, width) * _SIZE for width in (3, 4, 3, 2, 3))
        means, quats, scales, screen, rgb = rows
        opacities = normal(k, self.n) * _SIZE
        g = SplatGradients(means, quats, scales, opacities, screen, rgb, normal(self.n, _BANDS + 1))
        visible = torch.ones(self.n, dtype=torch.bool, device=self.device)
        return _Drawn(normal(camera.height, camera.width, 3), normal(self.n, 2), visible, g)

    def render_scales(
        self, jobs: Sequence[tuple[Splats, Camera]], tiles: Sequence[Tensor | None] | None = None
    ) -> list[Rendering]:
        return [self(splats, camera) for splats, camera in jobs]


@dataclass(frozen=True, slots=True, eq=False)
class _Drawn:
    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    gradients: SplatGradients
    alpha: Tensor = field(default_factory=lambda: torch.empty(0, 0))

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> SplatGradients:
        return self.gradients


def _view(device: str) -> View:
    camera = Camera(torch.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 1)
    lr, hr = (Photo(c, torch.zeros(c.height, c.width, 3, device=device)) for c in (camera, camera.scaled(2)))
    return View("given", lr, hr)


def _parameters(n: int, device: str) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (3,),
        "quats": (4,),
        "scales": (3,),
        "opacities": (),
        "sh0": (1, 3),
        "shN": (_BANDS, 3),
        "detail": (3,),
    }
    return {name: torch.randn(n, *shape, generator=generator).to(device) for name, shape in shapes.items()}
