"""Time, memory and error of every rasterizer at every preset of cut-offs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor

import rasterizers
from clear_strategies.bench import accuracy, peers, plots, scenes
from clear_strategies.bench.accuracy import NO_CUT_OFFS, Drawn, affordable
from clear_strategies.bench.peers import Peer
from clear_strategies.bench.results import Results
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.bench.timing import interleaved, medians, milliseconds
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import DataError
from rasterizers.interface import PRESETS

SCENES: Final = ("small", "s100k", "s100k-lr", "s500k")
COTANGENTS: Final = 3
FORWARD, TOGETHER, SEPARATE = "forward", "lr_hr_together", "lr_hr_separate"
BACKWARD: Final = tuple(f"backward_k{k}" for k in range(1, COTANGENTS + 1))
SAME, NONE = "same cut-offs", "no cut-offs"

CPP: Final = "cpp"


@dataclass(frozen=True, slots=True, eq=False)
class Contestant:
    """A backend, or a peer, at a preset on a scene.

    Args:
        module: the instruction set of its kernels, where it has such.
        render: draws the scene.
        stages: times more stages than forward and backward.
        rules: settings that differ from `SETTINGS`.
    """

    backend: str
    module: str
    preset: str
    render: Callable[[], Any]
    stages: Callable[[WorkLog], None] = lambda work_log: None
    rules: Mapping[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return " ".join(filter(None, (self.backend, self.module, self.preset)))

    def names(self, workload: Workload) -> dict[str, Any]:
        """The columns that say what a row of a table measured."""
        return {"scene": workload.name, "backend": self.backend, "module": self.module, "preset": self.preset}


def measure(
    results: Results,
    *,
    scene: Sequence[str],
    backend: Sequence[str] | None = None,
    isa: Sequence[str] | None = None,
    preset: Sequence[str] = tuple(PRESETS),
    repeats: int,
    device: str = "cpu",
    data: Path | None = None,
) -> None:
    """Measure the scenes one after the other.

    Args:
        backend: None: all that run here.
        isa: instruction sets whose compiled modules are compared; None: the fastest of this processor.

    Raises:
        BackendUnavailable: this processor cannot run one of `isa`.
        DataError: a name is unknown, or nothing that was asked for runs here.
    """
    require_device(device)
    backends = usable(backend, device, results.note)
    truth = accuracy.truth_backend()
    workloads = [scenes.load(name, data).to(device) for name in scene]
    others = peers.found(results.note) if device == "cuda" and peers.PRESET in preset else []
    times: list[dict[str, Any]] = []
    found_errors: list[dict[str, Any]] = []
    turns: list[pd.DataFrame] = []
    for workload in workloads:
        results.log(f"{workload.name}: {len(workload.splats):,} Gaussians")
        contestants = [
            backend_on(workload, b, p, m)
            for b in backends
            if affordable(b, workload, b, results.note)
            for m in (isa if isa and b == CPP else [None])
            for p in preset
        ]
        contestants += [peer_on(workload, peer) for peer in others]
        if not contestants:
            continue
        cotangents = random_cotangents(workload)
        contenders = {c.label: partial(turn, c, cotangents) for c in contestants}
        ms = interleaved(contenders, repeats, device=device, label=workload.name)
        turns.append(ms.assign(scene=workload.name))
        times += _time_rows(workload, contestants, medians(ms))
        if affordable(truth, workload, "errors", results.note):
            found_errors += _error_rows(workload, contestants, truth)
    if not times:
        raise DataError("--backend", ", ".join(backends), "measures none of these scenes", "see the lines above")
    results.tables["rasterizers_time"] = pd.DataFrame(times)
    results.tables["rasterizers_turns"] = pd.concat(turns)
    if found_errors:
        time, error = results.tables["rasterizers_time"], pd.DataFrame(found_errors)
        results.tables["rasterizers_error"] = error
        results.figures["time_against_error"] = plots.time_against_error(time, error)
    results.notes += [f"{peer.name}: {peer.differences}" for peer in others]


def require_device(device: str) -> None:
    """Refuse a device that torch does not see."""
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device", "cuda", "torch sees no such device here", "use --device cpu")


def usable(asked: Sequence[str] | None, device: str, note: Callable[[str], None]) -> list[str]:
    """The backends that run here, of those asked for; a DataError where a name is unknown, or none runs."""
    reasons = rasterizers.available()
    for name in asked or ():
        if name not in reasons:
            raise DataError("--backend", name, "is no backend", f"choose from {', '.join(reasons)}")
    found = []
    for name in dict.fromkeys(asked or reasons):
        why_not = reasons[name]
        if why_not is None and name == "gsplat":
            why_not = "measured as a peer on CUDA"
        elif why_not is None and name == "warp" and device == "cpu" and not asked:
            why_not = "made for CUDA; name it with --backend to measure it on a CPU"
        elif why_not is None and device not in rasterizers.load(name).traits.devices:
            why_not = f"it does not run on {device}"
        if why_not is None:
            found.append(name)
        else:
            note(f"{name}: {why_not}")
    if not found:
        raise DataError("--backend", ", ".join(asked or ()), "cannot run here", "see the lines above")
    return found


def turn(contestant: Contestant, cotangents: Float[Tensor, "K H W 3"]) -> dict[str, float]:
    """The milliseconds of every stage of a contestant, once."""
    work_log = WorkLog(cotangents.device)
    with work_log.stage(FORWARD):
        rendering = contestant.render()
    for k, stage in enumerate(BACKWARD, 1):
        with work_log.stage(stage):
            rendering.vjp(cotangents[:k])
    del rendering
    contestant.stages(work_log)
    return milliseconds(work_log)


def random_cotangents(workload: Workload) -> Float[Tensor, "K H W 3"]:
    """Standard normal, the same for every contestant."""
    camera, generator = workload.camera, torch.Generator().manual_seed(0)
    values = torch.randn(COTANGENTS, camera.height, camera.width, 3, generator=generator)
    return values.to(workload.splats.means.device)


def backend_on(workload: Workload, backend: str, preset: str, isa: str | None = None) -> Contestant:
    """One of our backends, with the stages that peers lack: both scales together."""
    kernels = {"isa": isa} if isa else {}
    rasterizer = rasterizers.load(backend, preset=preset, **kernels, **SETTINGS)
    splats, camera = workload.splats, workload.camera
    lr = camera.scaled(1 / workload.lr_factor) if workload.lr_factor else None

    def stages(work_log: WorkLog) -> None:
        if lr is not None:
            with work_log.stage(TOGETHER):
                rasterizer.render_scales([(splats, lr), (splats, camera)])
            with work_log.stage(SEPARATE):
                rasterizer(splats, lr)
                rasterizer(splats, camera)

    module = getattr(rasterizer, "module", "")  # the compiled backend has one
    return Contestant(backend, module, preset, lambda: rasterizer(splats, camera), stages)


def peer_on(workload: Workload, peer: Peer) -> Contestant:
    return Contestant(peer.name, "", peers.PRESET, lambda: peer.render(workload), rules=peer.rules)


def peak_on_cuda(c: Contestant, cotangents: Float[Tensor, "K H W 3"]) -> float:
    """MiB that torch's allocator adds at the peak of a forward and a backward pass."""
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    c.render().vjp(cotangents)
    torch.cuda.synchronize()
    return float(torch.cuda.max_memory_allocated() - before) / 2**20


def _time_rows(workload: Workload, contestants: Sequence[Contestant], median: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Milliseconds, the ratios that say whether shared work pays, and on CUDA the peak of memory."""
    cotangents = random_cotangents(workload)
    for c in contestants:
        ms = median.loc[c.label].dropna().to_dict()
        row: dict[str, Any] = c.names(workload)
        row |= {f"{stage}_ms": value for stage, value in ms.items() if stage != SEPARATE}
        row |= {f"k{k}_over_k1": ms[BACKWARD[k - 1]] / ms[BACKWARD[0]] for k in range(2, COTANGENTS + 1)}
        if SEPARATE in ms:
            row["together_over_separate"] = ms[TOGETHER] / ms[SEPARATE]
        if cotangents.is_cuda:
            row["peak_mib"] = peak_on_cuda(c, cotangents[:2])
        yield row


def _error_rows(workload: Workload, contestants: Sequence[Contestant], backend: str) -> Iterator[dict[str, Any]]:
    """Two rows per contestant: against float64 at its own cut-offs, and without any."""
    cotangent = random_cotangents(workload)[0]
    truths: dict[tuple[Any, ...], Drawn] = {}
    for c in contestants:
        found = accuracy.draw(c.render, cotangent)
        for against, cut_offs in ((SAME, PRESETS[c.preset]), (NONE, NO_CUT_OFFS)):
            rules = {**c.rules, **cut_offs}
            key = tuple(sorted(rules.items()))
            if key not in truths:
                truths[key] = accuracy.truth(backend, workload, cotangent, rules)
            yield {**c.names(workload), "truth": against, **accuracy.errors(found, truths[key])}
