"""The settings of a run, `fit.*`: how long it is, what it evaluates and saves on the way, and where it computes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from clear_strategies.core.checks import refuse, require_whole
from clear_strategies.schedules import REFERENCE_ITERATIONS, milestone
from clear_strategies.training.compiled_step import FusedMode

Device = Literal["cpu", "cuda"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """Settings of a run. Milestones are iterations of a 10,000-iteration run.

    Args:
        iterations: optimizer steps, one view each.
        scale_schedule: stretch every milestone from 10,000 iterations to `iterations`.
        seed: seed of the run's random numbers, such as the order of views, dropout and splits; 64 bits with sign.
        max_degree: the highest degree of the spherical harmonics, 0 to 3.
        degree_every: iterations after which the next degree is trained, too.
        probe_every: iterations between evaluations of the test views; 0: never.
        probe_views: how many test views these evaluate.
        checkpoint_every: iterations between checkpoints; 0: only at the end, or when interrupted.
        keep: how many checkpoints stay, at least 1.
        memory: MiB that training may take, loading included; None: what is free on this machine. More is refused before the
            first iteration.
        fused: "auto": one compiled pass corrects, merges, anchors and applies Adam where it can, and leaves out Gaussians that
            would not change; "off": the same in torch operations, for reading.
        replay: record iterations and replay them, so that a GPU does not wait for Python; needs rasterizer=warp. The result is
            the same bit for bit. None: on CUDA.
        map_views: number of training views with maps of reliability and correction in maps/; 0: none.
        video: number of frames of path.mp4, a loop through the training cameras, 24 a second; 0: none.
        verbose: also show on the console the details that run.log holds; `-v` on the command line.
        viewer: open the viewer in the browser while the run trains; the address is logged. Needs the extra [view].
        resume: a run's folder or one of its checkpoints, from which the run continues bit for bit. With "auto", the run's own
            folder: if the run is finished, nothing is trained or written; if it has checkpoints, it continues from the newest
            one; else it starts from the beginning.
        overwrite: if there is a run in the folder already, remove its checkpoints and results, and train. If false, this is
            refused, unless `resume` is set. Cannot be combined with resume="auto", which experiments set.
        device: where field, views and optimizer are, cpu or cuda. None: cuda if torch finds it and the rasterizer draws there,
            else cpu. A run may be resumed on another device, but then gives other bits.
        threads: number of threads of torch and the kernels. None: all cores, divided by the jobs that run at once (joblib).
    """

    iterations: int = 10_000
    scale_schedule: bool = True
    seed: int = 0
    max_degree: int = 3
    degree_every: int = milestone(1_000)
    probe_every: int = milestone(1_000, least=1)
    probe_views: int = 3
    checkpoint_every: int = milestone(2_500, least=1)
    keep: int = 3
    memory: int | None = None
    fused: FusedMode = "auto"
    replay: bool | None = None
    map_views: int = 3
    video: int = 72
    verbose: bool = False
    viewer: bool = False
    resume: str | None = None
    overwrite: bool = False
    device: Device | None = None
    threads: int | None = None

    def __post_init__(self) -> None:
        require_whole("iterations", self.iterations, least=1)
        require_whole("seed", self.seed, least=-(1 << 63), most=(1 << 63) - 1)  # torch's
        require_whole("max_degree", self.max_degree, least=0, most=3)
        require_whole("keep", self.keep, least=1)
        for name in ("degree_every", "probe_every", "probe_views", "checkpoint_every", "map_views", "video"):
            require_whole(name, getattr(self, name), least=0)
        if self.threads is not None:
            require_whole("threads", self.threads, least=1)
        if self.memory is not None and self.memory < 1:
            refuse("memory", "must be at least 1 MiB", self.memory, "null takes what is free")
        if self.fused not in get_args(FusedMode):
            rule = f"must be one of {', '.join(get_args(FusedMode))}"
            refuse("fused", rule, self.fused, "in a YAML file, off is quoted")
        if self.overwrite and self.resume == "auto":
            refuse(
                "overwrite", "must be false where resume=auto goes on with the run", self.overwrite, "fit.resume=null"
            )

    @property
    def stretch(self) -> float:
        """The factor on milestones."""
        return self.iterations / REFERENCE_ITERATIONS if self.scale_schedule else 1.0
