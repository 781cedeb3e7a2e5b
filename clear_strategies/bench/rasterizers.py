"""Which rasterizer, at which cut-offs, takes how long, and how far off is it?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import rasterizers
from clear_strategies.bench import memory, scenes
from clear_strategies.bench.accuracy import (
    ATTRIBUTES,
    NO_CUT_OFFS,
    Errors,
    Picture,
    compare,
    draw,
    oracle,
    oracle_backend,
)
from clear_strategies.bench.output import UNKNOWN, Findings, Section, number, small, times
from clear_strategies.bench.prototype import Prototype, started
from clear_strategies.bench.rounds import Contender, Milliseconds, bar, interleaved, medians, milliseconds, timed
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.errors import DataError
from clear_strategies.ledger import Ledger
from rasterizers.interface import PRESETS, Rasterizer, RasterSettings

SCENES: Final = ("small", "s100k", "s100k-lr", "garden", "s500k")
COTANGENTS: Final = 3
DEMAND: Final = 0.25  # share of the tiles that are asked for
PEER: Final = "prototype"

FORWARD, TILES, SHARED, SEPARATE = "forward", "tiles 25 %", "LR+HR shared", "LR+HR separate"
BACKWARD: Final = tuple(f"backward K={k}" for k in range(1, COTANGENTS + 1))

Say = Callable[[str], None]


@dataclass(slots=True, eq=False)
class Row:
    """A backend at a preset on a scene.

    Args:
        ms: stage -> every repeat. same, none: errors against float64 at the same cut-offs, and without any.
        peak: MiB that forward and backward (K = 2) add.
        against: stage -> the prototype's median over this one's, both at these cut-offs and in this run.
    """

    scene: str
    backend: str
    preset: str
    ms: Mapping[str, Sequence[float]]
    same: Errors | None = None
    none: Errors | None = None
    peak: float | None = None
    against: Mapping[str, float] = field(default_factory=dict)

    @property
    def median(self) -> dict[str, float]:
        return medians(self.ms)


@dataclass(frozen=True, slots=True)
class Request:
    """What was asked for on the command line."""

    scenes: Sequence[str]
    backends: Sequence[str] | None
    presets: Sequence[str]
    repeats: int
    limit: float
    device: str = "cpu"
    data: Path | None = None
    prototype: Path | None = None
    memory: bool = True


def measure(request: Request, say: Say) -> tuple[Findings, list[Row]]:
    """Every scene in turn.

    Args:
        say: told at once what is skipped, and why.

    Raises:
        DataError: nothing that was asked for can be measured, or a name is unknown.
    """
    findings = Findings("rasterizers", torch.get_num_threads())

    def skip(line: str) -> None:
        say(line)
        findings.skipped.append(line)

    if request.device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device", "cuda", "torch sees no such device here", "use --device cpu")
    backends = usable(request.backends, request.device, skip)
    for preset in request.presets:
        if preset not in PRESETS:
            raise DataError("--preset", preset, "is no preset", f"choose of {', '.join(PRESETS)}")
    rows: list[Row] = []
    truth = oracle_backend(request.device)
    if truth is None:
        skip("errors: no backend here computes in float64.")
    workloads = [(name, scenes.load(name, request.data)) for name in request.scenes]
    with _peer(request, findings.threads) as peer:
        if isinstance(peer, str):
            skip(f"prototype: {peer}.")
        calibration = Calibration()
        for name, workload in workloads:
            if isinstance(workload, str):
                skip(f"{name}: {workload}.")
                continue
            say(workload.says())
            one = OnScene(
                name, workload.to(request.device), request, None if isinstance(peer, str) else peer, calibration, skip
            )
            rows += one.measure(backends, truth)
    for scene in dict.fromkeys(row.scene for row in rows):
        findings.sections += _sections(rows, scene, truth, explained=bool(findings.sections))
    cuts = {name: dict(PRESETS[name]) for name in request.presets}
    findings.raw = {"settings": SETTINGS, "presets": cuts, "oracle": truth, "device": request.device}
    findings.raw["rows"] = [asdict(row) for row in rows]
    if not rows:
        raise DataError("bench", "rasterizers", "nothing could be measured", "see the lines above")
    return findings, rows


def _peer(request: Request, threads: int) -> AbstractContextManager[Prototype | str]:
    if request.device == "cpu":
        return started(request.prototype, threads)
    return nullcontext(f"it knows no {request.device}")


def usable(asked: Sequence[str] | None, device: str, skip: Say) -> list[str]:
    """The backends that run here, of those asked for.

    Raises:
        DataError: a name is unknown, or none runs.
    """
    reasons = rasterizers.available()
    if "auto" in (asked or ()):
        asked = [rasterizers.fastest() if name == "auto" else name for name in asked or ()]
    for name in asked or ():
        if name not in reasons:
            raise DataError("--backend", name, "is no backend", f"choose of auto, {', '.join(reasons)}")
    found = []
    for name in dict.fromkeys(asked or reasons):
        why_not = reasons[name]
        if why_not is None and device not in rasterizers.load(name).traits.devices:
            why_not = f"it does not run on {device}; see --device"
        if why_not is None:
            found.append(name)
        else:
            skip(f"{name}: {why_not}")
    if not found:
        raise DataError("--backend", ", ".join(asked or ()), "cannot run here", "see the line above")
    return found


class Turn:
    """One backend at one preset: everything that is timed, once."""

    def __init__(self, rasterizer: Rasterizer, workload: Workload, cotangents: Float[Tensor, "K H W 3"]) -> None:
        self.rasterizer, self.workload, self.cotangents = rasterizer, workload, cotangents
        self.mask = demand(rasterizer, workload)
        self.lr = workload.camera.scaled(1 / workload.lr_factor) if workload.lr_factor else None

    def __call__(self) -> Milliseconds:
        draw_it, splats, camera, ledger = self.rasterizer, self.workload.splats, self.workload.camera, Ledger()
        device = splats.means.device.type
        with timed(ledger, FORWARD, device):
            rendering = draw_it(splats, camera)
        for k, stage in enumerate(BACKWARD, 1):
            with timed(ledger, stage, device):
                rendering.vjp(self.cotangents[:k])
        del rendering
        with timed(ledger, TILES, device):
            draw_it(splats, camera, tiles=self.mask).vjp(self.cotangents[:1])
        if self.lr is not None:
            with timed(ledger, SHARED, device):
                draw_it.render_scales([(splats, self.lr), (splats, camera)])
            with timed(ledger, SEPARATE, device):
                draw_it(splats, self.lr)
                draw_it(splats, camera)
        return milliseconds(ledger)


class PeerTurn:
    """The same of the prototype, as far as it goes."""

    def __init__(self, prototype: Prototype, cuts: Mapping[str, float]) -> None:
        self.prototype, self.cuts = prototype, cuts

    def __call__(self) -> Milliseconds:
        return {
            FORWARD: self.prototype.forward(self.cuts),
            **{stage: self.prototype.backward(k) for k, stage in enumerate(BACKWARD, 1)},
        }


class Calibration:
    """Predicts how long a scene takes from how long the small one took, by the pixels that Gaussians cover."""

    def __init__(self) -> None:
        self._small: Workload | None = None
        self._seconds: dict[tuple[str, str], float] = {}

    def predict(self, key: tuple[str, str], turn_on: Callable[[Workload], Contender], workload: Workload) -> float:
        """Seconds of one turn on `workload`; `turn_on` makes it for a scene."""
        small_scene = self._workload(workload.splats.means.device.type)
        if key not in self._seconds:
            turn = turn_on(small_scene)
            turn()  # libraries are loaded and caches filled by the first
            self._seconds[key] = min(sum(turn().values()) for _ in range(2)) / 1e3
        return self._seconds[key] * workload.work() / small_scene.work()

    def _workload(self, device: str) -> Workload:
        if self._small is None:
            found = scenes.load("small")
            if isinstance(found, str):
                raise DataError("bench", "small", found, "report this")
            self._small = found.to(device)
        return self._small


@dataclass(slots=True, eq=False)
class OnScene:
    """One scene: who takes part, their turns, their errors, their memory.

    Args:
        name: as it was asked for; a path where `workload` has a name of its own.
    """

    name: str
    workload: Workload
    request: Request
    peer: Prototype | None
    calibration: Calibration
    skip: Say

    def measure(self, backends: Sequence[str], truth: str | None) -> list[Row]:
        cotangents = noise(self.workload)
        drawn: dict[tuple[str, str], Rasterizer] = {}
        for backend in backends:
            for preset in self.request.presets:
                rasterizer = rasterizers.load(backend, preset=preset, **SETTINGS)
                if self._affordable(backend, preset, rasterizer):
                    drawn[backend, preset] = rasterizer
        turns: dict[str, Contender] = {}
        for (backend, preset), rasterizer in drawn.items():
            turns[f"{backend} {preset}"] = Turn(rasterizer, self.workload, cotangents)
        if self.peer is not None:
            self.peer.scene(self.workload, cotangents)
            turns |= {f"{PEER} {preset}": PeerTurn(self.peer, PRESETS[preset]) for preset in self.request.presets}
        with bar(len(turns) * (self.request.repeats + 1), self.workload.name) as progress:
            ms = interleaved(turns, self.request.repeats, progress=progress)
        rows = [Row(self.workload.name, *_split(turn), found) for turn, found in ms.items()]
        self._add_errors(rows, drawn, cotangents[0], truth)
        self._add_memory(rows, list(dict.fromkeys(backend for backend, _ in drawn)))
        _add_ratios(rows)
        return rows

    def _affordable(self, backend: str, preset: str, rasterizer: Rasterizer) -> bool:
        if self.name in ("tiny", "small"):
            return True
        seconds = self.calibration.predict(
            (backend, preset), lambda scene: Turn(rasterizer, scene, noise(scene)), self.workload
        ) * (self.request.repeats + 1)
        if seconds > self.request.limit:
            self.skip(
                f"{backend} {preset} on {self.workload.name}: predicted to take {seconds:.0f} s, "
                f"more than --limit {self.request.limit:g}."
            )
        return seconds <= self.request.limit

    def _add_errors(
        self, rows: Sequence[Row], drawn: Mapping[tuple[str, str], Rasterizer], cotangent: Tensor, truth: str | None
    ) -> None:
        if truth is None or not rows:
            return
        workload, presets = self.workload, self.request.presets

        def answer(cuts: Mapping[str, float], scene: Workload = workload, v: Tensor = cotangent) -> Picture:
            return oracle(truth, scene.splats, scene.camera, v, cuts)

        if self.name not in ("tiny", "small"):

            def turn_on(scene: Workload) -> Contender:
                def turn() -> Milliseconds:
                    ledger = Ledger()
                    with timed(ledger, "oracle", self.request.device):
                        answer(NO_CUT_OFFS, scene, noise(scene)[0])
                    return milliseconds(ledger)

                return turn

            seconds = self.calibration.predict((truth, "float64"), turn_on, workload) * (len(presets) + 1)
            if seconds > self.request.limit:
                self.skip(
                    f"errors on {self.workload.name}: float64 of {truth} is predicted to take {seconds:.0f} s, "
                    f"more than --limit {self.request.limit:g}."
                )
                return
        with bar(len(presets) + 1, f"{self.workload.name}, float64") as progress:
            none = answer(NO_CUT_OFFS)
            progress()
            for preset in presets:
                same = answer(PRESETS[preset])
                for row in (row for row in rows if row.preset == preset):
                    if row.backend == PEER and self.peer is not None:
                        found = self.peer.picture(PRESETS[preset])
                    else:
                        found = draw(drawn[row.backend, preset], workload.splats, workload.camera, cotangent)
                    row.same, row.none = compare(found, same), compare(found, none)
                progress()

    def _add_memory(self, rows: Sequence[Row], backends: Sequence[str]) -> None:
        if not self.request.memory:
            self.skip(f"memory on {self.workload.name}: not asked for.")
            return
        for backend in backends:
            mine = [row for row in rows if row.backend == backend]
            found = memory.peaks(
                self.name, self.request.data, backend, [row.preset for row in mine], torch.get_num_threads(),
                device=self.request.device, seconds=60 + self.request.limit,
            )  # fmt: skip
            if isinstance(found, str):
                self.skip(f"memory of {backend} on {self.workload.name}: {found}")
                continue
            for row in mine:
                row.peak = found[row.preset]


def noise(workload: Workload) -> Float[Tensor, "K H W 3"]:
    """Cotangents: the standard normal distribution, the same for all."""
    camera, generator = workload.camera, torch.Generator().manual_seed(0)
    drawn = torch.randn(COTANGENTS, camera.height, camera.width, 3, generator=generator)
    return drawn.to(workload.splats.means.device)


def demand(rasterizer: Rasterizer, workload: Workload) -> Bool[Tensor, "th tw"]:
    """A quarter of the tiles, at random: the worst case for whoever hopes that they lie together."""
    tile = int(getattr(rasterizer, "tile", RasterSettings().tile))
    rows, columns = -(-workload.camera.height // tile), -(-workload.camera.width // tile)
    order = torch.randperm(rows * columns, generator=torch.Generator().manual_seed(0))
    return (order < round(DEMAND * rows * columns)).view(rows, columns).to(workload.splats.means.device)


def _split(turn: str) -> tuple[str, str]:
    backend, _, preset = turn.rpartition(" ")
    return backend, preset


def _add_ratios(rows: Sequence[Row]) -> None:
    for row in rows:
        peer = next((r for r in rows if r.backend == PEER and r.preset == row.preset), None)
        if peer is None or peer is row:
            continue
        ours, theirs = row.median, peer.median
        row.against = {
            stage: (theirs[FORWARD] + theirs[stage]) / (ours[FORWARD] + ours[stage]) for stage in BACKWARD
        } | {FORWARD: theirs[FORWARD] / ours[FORWARD]}


def _sections(rows: Sequence[Row], scene: str, truth: str | None, *, explained: bool) -> list[Section]:
    """Its tables; what their columns mean is said once, with the first scene's."""
    rows = [row for row in rows if row.scene == scene]
    head = {"backend": [row.backend for row in rows], "cut-offs": [row.preset for row in rows]}
    median = [row.median for row in rows]

    def beside(stage: str, base: Callable[[Mapping[str, float]], float]) -> list[str]:
        """Milliseconds, and in brackets what that is of something else."""
        return [f"{number(m[stage])} ({times(m[stage] / base(m))})" if stage in m else UNKNOWN for m in median]

    time_columns = {
        **head,
        FORWARD: [number(m.get(FORWARD)) for m in median],
        BACKWARD[0]: [number(m.get(BACKWARD[0])) for m in median],
        **{stage: beside(stage, lambda m: m[BACKWARD[0]]) for stage in BACKWARD[1:]},
        TILES: beside(TILES, lambda m: m[FORWARD] + m[BACKWARD[0]]),
        SHARED: beside(SHARED, lambda m: m[SEPARATE]),
        "peak MiB": [number(row.peak) for row in rows],
        f"{PEER}/this, K=1": [times(row.against.get(BACKWARD[0])) for row in rows],
        "K=2": [times(row.against.get(BACKWARD[1])) for row in rows],
    }
    notes = (
        "Milliseconds, medians of turns taken alternately. In brackets: K=2 and K=3 over K=1, a quarter of the tiles "
        "over all, LR and HR together over one by one."
        + (f" {PEER}/this: its forward + backward over ours, above 1 we are faster." if _has_peer(rows) else ""),
    )
    sections = [Section(f"{scene}: time", time_columns, () if explained else notes)]
    measured = [(row, row.same, row.none) for row in rows if row.same is not None and row.none is not None]
    if measured:
        lines = [(row, "the same", same) for row, same, _ in measured]
        lines += [(row, "none", none) for row, _, none in measured]
        sections.append(_error_section(scene, lines, None if explained else truth))
    return sections


def _error_section(scene: str, lines: Sequence[tuple[Row, str, Errors]], truth: str | None) -> Section:
    columns = {
        "backend": [row.backend for row, _, _ in lines],
        "cut-offs": [row.preset for row, _, _ in lines],
        "truth's cut-offs": [against for _, against, _ in lines],
        **{f"image {key}": [small(e.image[key]) for _, _, e in lines] for key in ("max", "p99.99", "mean")},
        **{name: [f"{small(e.relative[name])} / {small(e.median[name])}" for _, _, e in lines] for name in ATTRIBUTES},
    }
    note = f"Gradients: relative L2 over all Gaussians / median per Gaussian. The truth is float64 of {truth}."
    return Section(f"{scene}: error", columns, () if truth is None else (note,))


def _has_peer(rows: Sequence[Row]) -> bool:
    return any(row.backend == PEER for row in rows)
