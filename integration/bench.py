"""What the strategies cost in another trainer: `python -m clear_strategies.bench host`.

A gsplat-style loop on the demo's photos, enlarged, alone and with a conductor attached; on CUDA with LR drawn by gsplat and by
this package. The Gaussians are the demo's points with noise, as many as asked for. The loops take turns, step by step, so that
other work on the machine slows all of them alike.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import pandas as pd
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils._python_dispatch import TorchDispatchMode
from tqdm import tqdm

from clear_strategies.bench.rasterizers import relative, require_device
from clear_strategies.bench.results import Results
from clear_strategies.compose import conductor
from clear_strategies.core.deferred import Number
from clear_strategies.data.priors import Bicubic
from clear_strategies.geometry import stereo
from integration.examples.demo import load_demo, splats_with_optimizers
from integration.gsplat import attach
from integration.views import view
from rasterizers import native

ALONE: Final = "alone"
_OURS: Final = ", ours"
"""What a loop's name ends with whose LR is drawn by this package, where gsplat draws that of the others."""
_ITERATIONS: Final = 1_000  # of the run that the loops are a part of
_FROM: Final = 301  # the measured steps begin here: HR takes part, at half its size where skips.coarse_until says so
_WARM_UPS: Final = 6
_COUNTED: Final = 6  # steps whose operations are counted: pseudo views come at every second
_IN_FLOAT64: Final = 2_000  # Gaussians of the loop whose merged gradient is compared


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
        demo, noise = load_demo(), torch.Generator().manual_seed(0)
        scale = width / demo.images.shape[2]
        photos = F.interpolate(demo.images.movedim(-1, 1), scale_factor=scale, mode="bilinear" if scale > 1 else "area")
        photos = photos.movedim(1, -1).clamp(0, 1).contiguous()
        Ks = demo.Ks * torch.tensor([[scale], [scale], [1.0]])
        cloud = stereo(demo.images, demo.viewmats, demo.Ks)
        rows = torch.randint(len(cloud.means), (n,), generator=noise)
        means = cloud.means[rows] + 0.02 * torch.randn(n, 3, generator=noise)
        splats, _ = splats_with_optimizers(means, cloud.colors[rows])
        for name in ("scales", "quats"):  # round Gaussians would have no gradient of their rotation
            splats[name].data += 0.3 * torch.randn(splats[name].shape, generator=noise)
        self.splats = {name: torch.nn.Parameter(p.detach().to(device, dtype)) for name, p in splats.items()}
        self.optimizers = {name: torch.optim.Adam([p], lr=1e-9, eps=1e-15) for name, p in self.splats.items()}
        self.photos, self.viewmats, self.Ks = (x.to(device, dtype) for x in (photos, demo.viewmats, Ks))
        self.draw, self.merge, self.t = _rasterization(device, ours=ours), None, 0
        if strategies is not None:
            name, *overrides = strategies.split()
            chosen = conductor(name, *overrides, iterations=_ITERATIONS)
            sr = chosen.prior(Bicubic())
            views = [view(*x, sr=sr) for x in zip(demo.names, self.photos, self.viewmats, self.Ks, strict=True)]
            attached = attach(self.splats, self.optimizers, views, chosen)
            self.draw, self.merge = attached.wrap(self.draw), _TimedMerge(attached.attachment._merging._merge_in_place)
            attached.attachment.t, attached.attachment._merging._merge_in_place = _FROM, self.merge

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


class _TimedMerge:
    """The merge, and the seconds that it has taken: of the processor, on a device by the wall clock."""

    def __init__(self, merge: Callable[..., Mapping[str, Number]]) -> None:
        self._merge, self.seconds = merge, 0.0

    def __call__(self, params: Mapping[str, Tensor], *arguments: Any, **keywords: Any) -> Mapping[str, Number]:
        device = params["means"].device
        clock = time.perf_counter if device.type == "cuda" else time.process_time
        began = clock()
        result = self._merge(params, *arguments, **keywords)
        _wait(device)
        self.seconds += clock() - began
        return result


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
        turns = _timed(loops, repeats, device)
        rows, means = [], turns.groupby("loop").mean()
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
        f"{gaussians:,} Gaussians, {images}, {threads} thread(s) of torch and of the kernels; means of {repeats} steps."
    )


def _timed(loops: Mapping[str, Loop], repeats: int, device: str) -> pd.DataFrame:
    """Milliseconds of every step, wall clock and processor, and of its merge, on a CPU in processor time. The number of steps is
    even, since pseudo views come at every second.
    """
    rows = []
    for turn in tqdm(range(-_WARM_UPS, repeats + repeats % 2), desc="steps", unit="turn", leave=False):
        for name, loop in loops.items():
            before = 0.0 if loop.merge is None else loop.merge.seconds
            _wait(torch.device(device))
            began, began_processor = time.perf_counter(), time.process_time()
            loop.step()
            _wait(torch.device(device))
            ms, processor_ms = (
                1e3 * (a - b) for a, b in ((time.perf_counter(), began), (time.process_time(), began_processor))
            )
            merging = 0.0 if loop.merge is None else loop.merge.seconds - before
            rows.append({"turn": turn, "loop": name, "ms": ms, "processor_ms": processor_ms, "merge_ms": 1e3 * merging})
    return pd.DataFrame(rows).query("turn >= 0").drop(columns=["turn"])


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
    gradients = []
    for dtype in (torch.float32, torch.float64):
        loop = Loop(strategies, _IN_FLOAT64, 64, "cpu", dtype)
        loop.backward()
        gradients.append({name: p.grad.double() for name, p in loop.splats.items() if p.grad is not None})
    pairs: list[tuple[str, Tensor, Tensor]] = [
        (name, gradients[0][name], exact) for name, exact in gradients[1].items()
    ]
    return {"loop": strategies} | {name: relative(g, exact) for name, g, exact in pairs if exact.any()}


def _rasterization(device: str, *, ours: bool) -> Callable[..., Any]:
    if device == "cuda" and not ours:
        from gsplat import rasterization as cuda_rasterization

        return cuda_rasterization  # type: ignore[no-any-return]
    from rasterizers.as_gsplat import rasterization

    return rasterization


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
