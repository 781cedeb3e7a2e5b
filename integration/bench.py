"""The cost of the strategies in another trainer: `python -m clear_strategies.bench host`.

A gsplat-style loop on the demo's photos, enlarged, alone and with a conductor attached; on CUDA with LR drawn by gsplat and by
this package. The Gaussians are the demo's points with noise, as many as asked for. The loops take turns, step by step, so that
other work on the machine slows all of them alike.
"""

from __future__ import annotations

import importlib
import time
from collections import Counter
from collections.abc import Sequence
from functools import cache
from typing import Any, Final

import pandas as pd
import torch
from torch.nn import functional as F

from clear_strategies.bench.rasterizers import relative, require_device
from clear_strategies.bench.results import Results, interleaved
from clear_strategies.compose import conductor
from clear_strategies.data.priors import Bicubic
from clear_strategies.errors import counted
from clear_strategies.geometry import Stereo, stereo
from integration.examples.demo import Demo, load_demo, splats_with_optimizers
from integration.gsplat import attach
from integration.host_merge import HostMerge
from integration.views import view
from rasterizers import native
from rasterizers.torch_internals import TorchDispatchMode

ALONE: Final = "alone"
_OURS: Final = ", ours"
"""What a loop's name ends with whose LR is drawn by this package, where gsplat draws that of the others."""
_ITERATIONS: Final = 1_000  # of the run that the loops are a part of
_FROM: Final = 301  # the measured steps begin here: HR takes part, at half its size where skips.coarse_until says so
_WARM_UPS: Final = 5  # before those of `interleaved`
_COUNTED: Final = 6  # steps whose operations are counted: pseudo views come at every second
_IN_FLOAT64: Final = 2_000  # Gaussians of the loop whose merged gradient is compared


@cache
def _scene() -> tuple[Demo, Stereo]:
    demo = load_demo()
    return demo, stereo(demo.images, demo.viewmats, demo.Ks)


class Loop:
    """A gsplat-style loop: it renders, `backward()`, and steps an Adam for each parameter.

    Args:
        strategies: as in `conductor`, with overrides after it, "clear skips=none"; None: the loop alone.
        width: of the LR photos, px; SR images have four times as many.
        ours: this package draws LR on CUDA, too; on a CPU it always does.
    """

    def __init__(
        self, strategies: str | None, n: int, width: int, device: str, dtype: torch.dtype = torch.float32, *, ours: bool = False
    ) -> None:  # fmt: skip
        (demo, cloud), noise = _scene(), torch.Generator().manual_seed(0)
        scale = width / demo.images.shape[2]
        photos = F.interpolate(demo.images.movedim(-1, 1), scale_factor=scale, mode="bilinear" if scale > 1 else "area")
        photos = photos.movedim(1, -1).clamp(0, 1).contiguous()
        Ks = demo.Ks * torch.tensor([[scale], [scale], [1.0]])
        rows = torch.randint(len(cloud.means), (n,), generator=noise)
        means = cloud.means[rows] + 0.02 * torch.randn(n, 3, generator=noise)
        splats, _ = splats_with_optimizers(means, cloud.colors[rows])
        for name in ("scales", "quats"):  # round Gaussians would have no gradient of their rotation
            splats[name].data += 0.3 * torch.randn(splats[name].shape, generator=noise)
        self.splats = {name: torch.nn.Parameter(p.detach().to(device, dtype)) for name, p in splats.items()}
        self.optimizers = {name: torch.optim.Adam([p], lr=1e-9, eps=1e-15) for name, p in self.splats.items()}
        self.photos, self.viewmats, self.Ks = (x.to(device, dtype) for x in (photos, demo.viewmats, Ks))
        function = importlib.import_module("gsplat" if device == "cuda" and not ours else "rasterizers.as_gsplat")
        self.draw, self.merging, self.t = function.rasterization, 0.0, 0  # merging: seconds of all merges
        if strategies is not None:
            name, *overrides = strategies.split()
            chosen = conductor(name, *overrides, iterations=_ITERATIONS)
            sr = chosen.prior(Bicubic())
            views = [view(*x, sr=sr) for x in zip(demo.names, self.photos, self.viewmats, self.Ks, strict=True)]
            attached = attach(self.splats, self.optimizers, views, chosen)
            self.draw, attached.attachment.t = attached.wrap(self.draw), _FROM
            self._time(attached.attachment._merging)

    def backward(self) -> None:
        """Render the next photo and take the gradients."""
        i, p = self.t % len(self.photos), self.splats
        self.t += 1
        height, width = self.photos.shape[1:3]
        image = self.draw(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat([p["sh0"], p["shN"]], 1),
            viewmats=self.viewmats[i : i + 1], Ks=self.Ks[i : i + 1], width=width, height=height, sh_degree=3,
            rasterize_mode="antialiased",
        )[0][0]  # fmt: skip
        (image - self.photos[i]).abs().mean().backward()

    def step(self) -> None:
        self.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
            optimizer.zero_grad()

    def __call__(self) -> dict[str, float]:
        """Milliseconds of a step by the wall clock and of the processor, and of its merge, on a CPU of the processor."""
        _wait(self.photos.device)
        before = time.perf_counter(), time.process_time(), self.merging
        self.step()
        _wait(self.photos.device)
        after = time.perf_counter(), time.process_time(), self.merging
        times = zip(("ms", "processor_ms", "merge_ms"), before, after, strict=True)
        return {name: 1e3 * (b - a) for name, a, b in times}

    def _time(self, host_merge: HostMerge) -> None:
        """Sum up the seconds of its merges: of the processor, on a device by the wall clock."""
        device, merge = self.photos.device, host_merge._merge
        clock = time.perf_counter if device.type == "cuda" else time.process_time

        def timed(*arguments: Any) -> None:
            began = clock()
            merge(*arguments)
            _wait(device)
            self.merging += clock() - began

        host_merge._merge = timed  # type: ignore[method-assign, assignment]


def measure(
    results: Results, *, strategies: Sequence[str], gaussians: int, width: int, repeats: int, device: str
) -> None:
    """Time the loops, count their operations, and compare the merged gradient with that in float64.

    Raises:
        DataError: there is no such device.
        SettingError: strategies that are none.
    """
    require_device(device)
    names = [f"{name}{who}" for who in ("", _OURS)[: 1 + (device == "cuda")] for name in (ALONE, *strategies)]
    with native.kernel_threads(torch.get_num_threads()):
        loops = {}
        for name in names:
            chosen = name.removesuffix(_OURS)
            loops[name] = Loop(None if chosen == ALONE else chosen, gaussians, width, device, ours=chosen != name)
        for loop in [*loops.values()] * _WARM_UPS:
            loop.step()
        # An even number of steps, since pseudo views come at every second.
        turns = interleaved(loops, repeats + repeats % 2, device=device, label="steps")
        rows, means = [], turns.pivot_table("ms", "contender", "stage", sort=False)
        # Of all loops together.
        memory = {"peak_mib": torch.cuda.max_memory_allocated() / 2**20} if device == "cuda" else {}
        for name, loop in loops.items():
            mean, alone = means.loc[name], means.loc[ALONE]
            clock = "ms" if device == "cuda" else "processor_ms"
            rows.append({"loop": name, **mean, "times_alone": mean[clock] / alone[clock], **_counts(loop), **memory})
        results.tables["host"] = pd.DataFrame(rows)
        if device == "cpu":
            results.tables["host_error"] = pd.DataFrame([_error(name) for name in strategies])
    threads, images = torch.get_num_threads(), f"LR {width} px wide, HR {4 * width}"
    results.note(
        f"{gaussians:,} Gaussians, {images}, {counted(threads, 'thread')} of torch and of the kernels; means of {repeats} steps."
    )


class _Operations(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Torch's operations that are no views; on a GPU each is a launch, or more."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, operation: Any, types: Any, arguments: Any = (), keywords: Any = None) -> Any:
        if not operation.is_view:
            self.found[operation.overloadpacket.__name__] += 1
        return operation(*arguments, **(keywords or {}))


def _counts(loop: Loop) -> dict[str, float]:
    """Operations a step, and those of them that read a scalar."""
    with _Operations() as operations:
        for _ in range(_COUNTED):
            loop.step()
    reads = operations.found["_local_scalar_dense"]
    return {"operations": operations.found.total() / _COUNTED, "reads": reads / _COUNTED}


def _error(strategies: str) -> dict[str, Any]:
    """The relative L2 error of the merged gradient of the first step against the same loop in float64, by attribute."""
    loops = [Loop(strategies, _IN_FLOAT64, 64, "cpu", dtype) for dtype in (torch.float32, torch.float64)]
    for loop in loops:
        loop.backward()
    found, exact = ({name: p.grad.double() for name, p in x.splats.items() if p.grad is not None} for x in loops)
    return {"loop": strategies} | {name: relative(found[name], g) for name, g in exact.items() if g.any()}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
