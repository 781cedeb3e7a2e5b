"""Which rasterizer, at which cut-offs, takes how long, and how far off is it?"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

import rasterizers
from clear_strategies.bench import counting, memory, peers, scenes
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
from clear_strategies.bench.peaks import Peaks, attained
from clear_strategies.bench.peers import Peer
from clear_strategies.bench.prototype import Prototype, started
from clear_strategies.bench.rounds import WARM_UPS, Contender, Milliseconds, bar, interleaved, medians, milliseconds
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.core.work_log import WorkLog
from clear_strategies.errors import DataError
from rasterizers.interface import PRESETS, Rasterizer, RasterSettings

SCENES: Final = ("small", "s100k", "s100k-lr", "garden", "s500k")
COTANGENTS: Final = 3
DEMAND: Final = 0.25  # share of the tiles that are asked for
PROTOTYPE: Final = "prototype"

FORWARD, TILES, SHARED, SEPARATE = "forward", "tiles 25 %", "LR+HR shared", "LR+HR separate"
BACKWARD: Final = tuple(f"backward K={k}" for k in range(1, COTANGENTS + 1))

Say = Callable[[str], None]


@dataclass(slots=True, eq=False)
class Row:
    """A backend, or a peer, at a preset on a scene.

    Args:
        ms: stage -> every repeat. same, none: errors against float64 at the same cut-offs, and without any.
        peak: MiB that forward and backward (K = 2) add.
        against: of a peer: our backend -> stage -> its median, from the forward on, over ours at these cut-offs.
    """

    scene: str
    backend: str
    preset: str
    ms: Mapping[str, Sequence[float]]
    is_peer: bool = False
    same: Errors | None = None
    none: Errors | None = None
    peak: float | None = None
    against: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

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
    floors: bool = False


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

    require_device(request.device)
    backends = usable(request.backends, request.device, skip)
    for preset in request.presets:
        if preset not in PRESETS:
            raise DataError("--preset", preset, "is no preset", f"choose of {', '.join(PRESETS)}")
    rows: list[Row] = []
    loads: dict[str, counting.Load] = {}
    truth = oracle_backend()
    if truth is None:
        skip("errors: no backend here computes in float64.")
    peaks = Peaks.measured(request.device) if request.floors else None
    workloads = [(name, scenes.load(name, request.data)) for name in request.scenes]
    others = peers.found(skip) if request.device == "cuda" and peers.PRESET in request.presets else []
    with _prototype(request, findings.threads) as prototype:
        if isinstance(prototype, str):
            skip(f"{PROTOTYPE}: {prototype}.")
        calibration = Calibration()
        for name, workload in workloads:
            if isinstance(workload, str):
                skip(f"{name}: {workload}.")
                continue
            say(workload.says())
            one = OnScene(
                name, workload.to(request.device), request, None if isinstance(prototype, str) else prototype, others,
                calibration, skip,
            )  # fmt: skip
            rows += one.measure(backends, truth)
            if peaks is not None:
                loads[workload.name] = counting.load_of(one.workload, {**SETTINGS, **PRESETS[request.presets[0]]})
    for scene in dict.fromkeys(row.scene for row in rows):
        findings.sections += _sections(rows, scene, truth, others, explained=bool(findings.sections))
        if peaks is not None:
            findings.sections.append(_floor_section(rows, scene, request.presets[0], loads[scene], peaks))
    cuts = {name: dict(PRESETS[name]) for name in request.presets}
    findings.raw = {"settings": SETTINGS, "presets": cuts, "oracle": truth, "device": request.device}
    findings.raw["peers"] = {peer.name: {"says": peer.says, "differs": dict(peer.differs)} for peer in others}
    findings.raw["rows"] = [asdict(row) for row in rows]
    if peaks is not None:
        findings.raw |= {"peaks": asdict(peaks), "loads": {name: asdict(load) for name, load in loads.items()}}
    if not rows:
        raise DataError("bench", "rasterizers", "nothing could be measured", "see the lines above")
    return findings, rows


def require_device(device: str) -> None:
    """Raises:
    DataError: there is no such device here.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise DataError("--device", "cuda", "torch sees no such device here", "use --device cpu")


def _prototype(request: Request, threads: int) -> AbstractContextManager[Prototype | str]:
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
        if why_not is None and name == "gsplat":
            why_not = "no backend of ours; on CUDA it takes part as a peer"
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
        draw_it, splats, camera = self.rasterizer, self.workload.splats, self.workload.camera
        work_log = WorkLog(splats.means.device)
        with work_log.stage(FORWARD):
            rendering = draw_it(splats, camera)
        for k, stage in enumerate(BACKWARD, 1):
            with work_log.stage(stage):
                rendering.vjp(self.cotangents[:k])
        del rendering
        with work_log.stage(TILES):
            draw_it(splats, camera, tiles=self.mask).vjp(self.cotangents[:1])
        if self.lr is not None:
            with work_log.stage(SHARED):
                draw_it.render_scales([(splats, self.lr), (splats, camera)])
            with work_log.stage(SEPARATE):
                draw_it(splats, self.lr)
                draw_it(splats, camera)
        return milliseconds(work_log)


class PeerTurn:
    """The same of a peer, as far as it goes: K cotangents are K backward passes."""

    def __init__(self, peer: Peer, workload: Workload, cotangents: Float[Tensor, "K H W 3"]) -> None:
        self.peer, self.workload, self.cotangents = peer, workload, cotangents

    def __call__(self) -> Milliseconds:
        work_log = WorkLog(self.cotangents.device)
        with work_log.stage(FORWARD):
            drawing = self.peer.draw(self.workload)
        for k, stage in enumerate(BACKWARD, 1):
            with work_log.stage(stage):
                for cotangent in self.cotangents[:k]:
                    drawing.vjp(cotangent)
        return milliseconds(work_log)


class PrototypeTurn:
    """The same of the prototype."""

    def __init__(self, prototype: Prototype, cuts: Mapping[str, float]) -> None:
        self.prototype, self.cuts = prototype, cuts

    def __call__(self) -> Milliseconds:
        return {
            FORWARD: self.prototype.forward(self.cuts),
            **{stage: self.prototype.backward(k) for k, stage in enumerate(BACKWARD, 1)},
        }


@dataclass(frozen=True, slots=True, eq=False)
class Contestant:
    """Who takes part on a scene.

    Args:
        picture: for the first cotangent. differs: its rules where they are not `SETTINGS`.
    """

    backend: str
    preset: str
    turn: Contender
    picture: Callable[[], Picture]
    is_peer: bool = False
    differs: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))


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
    prototype: Prototype | None
    peers: Sequence[Peer]
    calibration: Calibration
    skip: Say

    def measure(self, backends: Sequence[str], truth: str | None) -> list[Row]:
        cotangents = noise(self.workload)
        contestants = [*self._ours(backends, cotangents), *self._peers(cotangents), *self._prototypes(cotangents)]
        turns = {f"{c.backend} {c.preset}": c.turn for c in contestants}
        warm_ups = WARM_UPS[self.request.device]
        with bar(len(turns) * (self.request.repeats + warm_ups), self.workload.name) as progress:
            ms = interleaved(turns, self.request.repeats, warm_ups=warm_ups, progress=progress)
        rows = [
            Row(self.workload.name, c.backend, c.preset, found, c.is_peer)
            for c, found in zip(contestants, ms.values(), strict=True)
        ]
        self._add_errors(rows, contestants, cotangents[0], truth)
        self._add_memory(rows)
        add_ratios(rows)
        return rows

    def _ours(self, backends: Sequence[str], cotangents: Float[Tensor, "K H W 3"]) -> list[Contestant]:
        ours = []
        for backend in backends:
            for preset in self.request.presets:
                rasterizer = rasterizers.load(backend, preset=preset, **SETTINGS)
                if self._affordable(backend, preset, rasterizer):
                    ours.append(self._one_of_ours(backend, preset, rasterizer, cotangents))
        return ours

    def _one_of_ours(self, backend: str, preset: str, rasterizer: Rasterizer, cotangents: Tensor) -> Contestant:
        workload = self.workload

        def picture() -> Picture:
            return draw(rasterizer, workload.splats, workload.camera, cotangents[0])

        return Contestant(backend, preset, Turn(rasterizer, workload, cotangents), picture)

    def _peers(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Contestant]:
        workload = self.workload

        def contestant(peer: Peer) -> Contestant:
            turn = PeerTurn(peer, workload, cotangents)
            picture = lambda: peer.picture(workload, cotangents[0])  # noqa: E731 - as short as it is
            return Contestant(peer.name, peers.PRESET, turn, picture, True, peer.differs)

        return [contestant(peer) for peer in self.peers]

    def _prototypes(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Contestant]:
        prototype = self.prototype
        if prototype is None:
            return []
        prototype.scene(self.workload, cotangents)

        def contestant(preset: str) -> Contestant:
            cuts = PRESETS[preset]
            return Contestant(PROTOTYPE, preset, PrototypeTurn(prototype, cuts), lambda: prototype.picture(cuts), True)

        return [contestant(preset) for preset in self.request.presets]

    def _affordable(self, backend: str, preset: str, rasterizer: Rasterizer) -> bool:
        if self.name in ("tiny", "small"):
            return True
        seconds = self.calibration.predict(
            (backend, preset), lambda scene: Turn(rasterizer, scene, noise(scene)), self.workload
        ) * (self.request.repeats + WARM_UPS[self.request.device])
        if seconds > self.request.limit:
            self.skip(
                f"{backend} {preset} on {self.workload.name}: predicted to take {seconds:.0f} s, "
                f"more than --limit {self.request.limit:g}."
            )
        return seconds <= self.request.limit

    def _add_errors(
        self, rows: Sequence[Row], contestants: Sequence[Contestant], cotangent: Tensor, truth: str | None
    ) -> None:
        if truth is None or not rows:
            return
        splats, camera = self.workload.splats, self.workload.camera
        if self.name not in ("tiny", "small"):

            def turn_on(scene: Workload) -> Contender:
                def turn() -> Milliseconds:
                    work_log = WorkLog()
                    with work_log.stage("oracle"):
                        oracle(truth, scene.splats, scene.camera, noise(scene)[0], NO_CUT_OFFS)
                    return milliseconds(work_log)

                return turn

            seconds = self.calibration.predict((truth, "float64"), turn_on, self.workload)
            seconds *= len(self.request.presets) + 1 + 2 * len({tuple(c.differs) for c in contestants if c.differs})
            if seconds > self.request.limit:
                self.skip(
                    f"errors on {self.workload.name}: float64 of {truth} is predicted to take {seconds:.0f} s, "
                    f"more than --limit {self.request.limit:g}."
                )
                return

        known: dict[tuple[Any, ...], Picture] = {}

        def answer(rules: Mapping[str, Any]) -> Picture:
            key = tuple(sorted(rules.items()))
            if key not in known:
                known[key] = oracle(truth, splats, camera, cotangent, rules)
            return known[key]

        with bar(len(rows), f"{self.workload.name}, float64") as progress:
            for row, c in zip(rows, contestants, strict=True):
                found = c.picture()
                row.same = compare(found, answer({**c.differs, **PRESETS[c.preset]}))
                row.none = compare(found, answer({**c.differs, **NO_CUT_OFFS}))
                progress()

    def _add_memory(self, rows: Sequence[Row]) -> None:
        if not self.request.memory:
            self.skip(f"memory on {self.workload.name}: not asked for.")
            return
        for backend in dict.fromkeys(row.backend for row in rows if row.backend != PROTOTYPE):
            mine = [row for row in rows if row.backend == backend]
            found = memory.peaks(
                self.name, self.request.data, backend, [row.preset for row in mine], torch.get_num_threads(),
                device=self.request.device, seconds=60 + self.request.limit, is_peer=mine[0].is_peer,
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


def add_ratios(rows: Sequence[Row]) -> None:
    """Each peer's time over ours, from this run alone."""
    for peer in (row for row in rows if row.is_peer):
        theirs = peer.median
        peer.against = {
            row.backend: {FORWARD: theirs[FORWARD] / ours[FORWARD]}
            | {stage: (theirs[FORWARD] + theirs[stage]) / (ours[FORWARD] + ours[stage]) for stage in BACKWARD}
            for row, ours in ((row, row.median) for row in rows if not row.is_peer and row.preset == peer.preset)
        }


def _sections(
    rows: Sequence[Row], scene: str, truth: str | None, others: Sequence[Peer], *, explained: bool
) -> list[Section]:
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
    }
    notes = (
        "Milliseconds, medians of turns taken alternately. In brackets: K=2 and K=3 over K=1, a quarter of the tiles "
        "over all, LR and HR together over one by one. Memory: what forward and backward of K=2 add at their peak.",
    )
    sections = [Section(f"{scene}: time", time_columns, () if explained else notes)]
    if any(row.against for row in rows):
        legend = "A peer's time over ours in the same run, forward and then with the backward; above 1 we are faster."
        about = [] if explained else [legend, *(f"{peer.name}: {peer.says}" for peer in others)]
        sections.append(_ratio_section(rows, scene, about))
    measured = [(row, row.same, row.none) for row in rows if row.same is not None and row.none is not None]
    if measured:
        lines = [(row, "the same", same) for row, same, _ in measured]
        lines += [(row, "none", none) for row, _, none in measured]
        sections.append(_error_section(scene, lines, None if explained else truth))
    return sections


def _ratio_section(rows: Sequence[Row], scene: str, notes: Sequence[str]) -> Section:
    lines = [(row, ours, ratio) for row in rows for ours, ratio in row.against.items()]
    columns = {
        "peer": [row.backend for row, _, _ in lines],
        "over": [f"{ours} {row.preset}" for row, ours, _ in lines],
        FORWARD: [times(ratio[FORWARD]) for *_, ratio in lines],
        **{f"+ {stage}": [times(ratio[stage]) for *_, ratio in lines] for stage in BACKWARD},
    }
    return Section(f"{scene}: peers over ours", columns, notes)


def _floor_section(rows: Sequence[Row], scene: str, preset: str, load: counting.Load, peaks: Peaks) -> Section:
    """How near our backends come to what the device could do."""
    costs = {FORWARD: counting.forward(load)}
    costs |= {stage: counting.backward(load, k) for k, stage in enumerate(BACKWARD, 1)}
    ours = [row for row in rows if row.scene == scene and row.preset == preset and not row.is_peer]
    timed = {(row.backend, stage): row.median[stage] for row in ours for stage in costs}
    return attained(
        f"{scene}: how near to the device's limits, {preset}", timed, costs, peaks,
        f"{load.visible:,} of {load.n:,} Gaussians visible, {load.contributions:,} contributions to {load.pixels:,} pixels.",
    )  # fmt: skip


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
