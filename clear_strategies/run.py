"""`python -m clear_strategies.run +strategy=clear`: the door to a whole run.

Composes the configuration, prints the plan, trains, and leaves in Hydra's run folder: history.csv, conflict.csv,
timing.csv, renders/, views/, maps/, contact_sheet.png, curves.png, point_cloud.ply, checkpoints/ and, last, so that its
presence says that the run is finished, metrics.json. Exit codes: 0, 2 for input that cannot be used or a sweep with a
failed job, 3 where the disk is full or read-only, 130 and 143 when stopped by a signal (after saving).
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from clear_strategies.compose import CONF, build_conductor, instantiate, one_line, plain
from clear_strategies.errors import ClearError, DataError
from clear_strategies.jobs import sweep
from clear_strategies.jobs.lock import HeldError, hold
from clear_strategies.jobs.sweep import Sweep

_log = logging.getLogger(__name__)

# What may differ between a run and the one it resumes.
_NOT_COMPARED: Final = {
    "fit.resume",
    "fit.device",
    "fit.threads",
    "fit.keep",
    "fit.checkpoint_every",
    "fit.probe_every",
    "fit.probe_views",
    "fit.map_views",
}

# What `fit.resume` says besides a path.
_AUTO: Final = "auto"


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> float | None:
    """One job: returns the mean PSNR of the test views, which a sweeper may optimize."""
    from clear_strategies.training.signals import Interrupted
    from rasterizers.interface import BackendUnavailable

    job, ours = HydraConfig.get(), _sweep()
    if ours is not None and _launcher(job) == "joblib" and not ours.begun_here:
        # A terminal sends Ctrl-C to joblib's workers too; one stop is enough, and it comes from the sweep.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if ours is not None and ours.stopped_by is not None:
        _log.warning("job %s is not started: the sweep was stopped.", job.job.num)
        return None
    try:
        return run(config, Path(job.runtime.output_dir))
    except Interrupted as stopped:
        _log.error("%s", stopped)
        if ours is not None and _launcher(job) == "joblib":
            ours.stop(stopped.signum)  # ending a worker would have joblib kill the others before they have saved
            return None
        if stopped.signum not in (signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(stopped.signum)  # all is saved: now whoever launched the job may hand it in again
        sys.exit(stopped.exit_code)
    except OSError as error:  # a full or read-only disk; unusable input is a DataError
        message = f"{error.filename or 'output'}: {error.strerror or error}. Earlier checkpoints are untouched."
        _log.error("%s", message)
        if ours is None or _launcher(job) == "basic":
            sys.exit(3)
        ours.note_failure(job.job.num, message)  # jobs elsewhere may have another disk
        return None
    except (ClearError, BackendUnavailable, OmegaConfBaseException, InstantiationException, ValueError) as error:
        if isinstance(error, ValueError) and not isinstance(error, ClearError) and not _is_ours(error):
            raise
        message = one_line(error)
        if ours is None:
            _log.error("%s", message)
            sys.exit(2)
        if isinstance(error, HeldError) and config.fit.resume == _AUTO:
            _log.warning("left to the other process: %s", message)
            ours.note_left(job.job.num, message)
        else:
            _log.error("%s", message)
            ours.note_failure(job.job.num, message)  # the other jobs go on
        return None


class SweepCallback(Callback):
    """A sweep's beginning and end, in the process that was started; `main` is called in between, maybe in others.

    Hydra pickles it for them, so it remembers nothing.
    """

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        ours = Sweep.begin(Path(config.hydra.sweep.dir))
        if _launcher(config.hydra) == "joblib":
            sweep.stop_on_signals(ours)

    def on_multirun_end(self, config: DictConfig, **_: Any) -> None:
        ours = Sweep.current()
        if ours is None:
            return
        _report(Path(config.hydra.sweep.dir))
        stopped, failed, left = ours.stopped_by, ours.failures, ours.left
        if left:
            _log.warning("%d job(s) were left to other processes: %s", len(left), " | ".join(left))
        if failed:
            _log.error("%d job(s) failed: %s", len(failed), " | ".join(failed))
        if stopped is not None:
            _log.error("stopped by %s. With fit.resume=auto the same command goes on.", signal.Signals(stopped).name)
            sys.exit(128 + stopped)
        if failed:
            sys.exit(2)


def _report(folder: Path) -> None:
    """The table and the page of what a sweep has finished so far."""
    from clear_strategies import report

    try:
        _log.info("%s", report.write(report.collect([folder]), folder))
    except ClearError as error:  # nothing is finished yet, or a run's files are damaged; the jobs themselves are not
        _log.warning("there is no report: %s", error)


def _sweep() -> Sweep | None:
    """The one that this job is of. A single run is of none, whatever the environment says that it was started in."""
    return Sweep.current() if HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN else None


def _launcher(job: Any) -> str:
    """basic, joblib or submitit: the module of the launcher in Hydra's own configuration."""
    target = str(job.launcher._target_)
    return next((name for name in ("joblib", "submitit") if name in target), "basic")


def run(config: DictConfig, folder: Path) -> float | None:
    """Everything a job does, into `folder`, which is its own while it does.

    Raises:
        DataError: unusable input; or another job is at work in the folder, or left another configuration there.
    """
    with hold(folder):
        return _run(config, folder)


def _run(config: DictConfig, folder: Path) -> float | None:
    import torch

    from clear_strategies.data.prepare import save_lr
    from clear_strategies.outputs import plan, results
    from clear_strategies.outputs.progress import progress_bar
    from clear_strategies.schedules import scaled
    from clear_strategies.training.loop import fit
    from clear_strategies.training.settings import FitSettings
    from clear_strategies.training.state import TrainState

    if missing := [f"data.{key}" for key in config.data if OmegaConf.is_missing(config.data, key)]:
        raise DataError("config", missing[0], "is needed by this data set and missing", f"add {missing[0]}=…")
    compared = _comparable(config)
    if config.fit.resume == _AUTO and (finished := _finished(folder, compared)) is not None:
        return finished[0]
    threads, why = _threads(config)
    torch.set_num_threads(threads)
    if config.fit.map_views < 0:
        raise DataError(
            "config", "fit.map_views", f"must be at least 0, got {config.fit.map_views}", "0 leaves no maps"
        )
    known = FitSettings.__dataclass_fields__
    settings = FitSettings(**{k: v for k, v in plain(config.fit).items() if k in known})
    density = scaled(instantiate(config.density, "density"), settings.stretch)
    rates = scaled(instantiate(config.optim, "optim"), settings.stretch)
    mip = scaled(_mip(config), settings.stretch)
    skips = scaled(instantiate(config.skips, "skips"), settings.stretch)
    conductor = build_conductor(config, settings.stretch)
    scene = _scene(config, settings.seed)
    if config.data.save_lr is not None:
        save_lr(scene, Path(config.data.save_lr))
        return None
    rasterizer, backend, device = _rasterizer(config, scene.background)

    there = scene.to(device)
    state = TrainState.start(
        there,
        conductor,
        settings=scaled(settings, settings.stretch),
        density=density,
        rates=rates,
        mip=mip,
        skips=skips,
    )
    if config.fit.resume == _AUTO:
        _resume_newest(state, folder / "checkpoints", compared)
    elif config.fit.resume is not None:
        _resume(state, Path(config.fit.resume), compared)
    chosen = plan.Chosen(config.method, [str(name) for name in config.strategies])
    drawn = f"{backend}, kernel {config.rasterizer.kernel} px²"
    _log.info("%s", plan.describe(scene, state, chosen, rasterizer=drawn, threads=f"{threads} ({why})"))
    if (folder / "metrics.json").exists():
        _log.warning("%s: of an earlier run; removed, for it says that a run is finished.", folder / "metrics.json")
        (folder / "metrics.json").unlink()
    # What a run that is resumed took before counts too.
    began = time.perf_counter() - state.seconds
    with progress_bar(state, _watch()) as progress:
        fit(state, there, rasterizer, checkpoints=folder / "checkpoints", config=compared, progress=progress)
    seconds = time.perf_counter() - began
    return results.write_results(
        folder,
        scene,
        state,
        rasterizer,
        chosen,
        backend=backend,
        down=config.data.views.downsample,
        map_views=int(config.fit.map_views),
        seconds=seconds,
        config=compared,
    )


def _scene(config: DictConfig, seed: int) -> Any:
    from clear_strategies.data.prepare import prepare
    from clear_strategies.data.priors import Bicubic, Prior, cached

    capture = instantiate(config.data.reader, "data.reader")
    views = instantiate(config.data.views, "data.views")
    cloud = instantiate(config.data.cloud, "data.cloud")
    if config.data.save_lr is not None:
        prior: Prior = Bicubic()  # the images that the real prior reads may not exist yet
    elif config.prior.get("_target_") is None:  # prior=auto
        name = "demo" if capture.name == "demo" else "bicubic"
        chosen = OmegaConf.load(CONF / "prior" / f"{name}.yaml")
        prior = _prior(chosen, capture)
        _log.info("prior: auto chose %s.", prior.label)
        if name == "bicubic":
            _log.warning(
                "A bicubic prior shows nothing that LR does not. For SR images: prior=images prior.path=FOLDER."
            )
    else:
        prior = _prior(config.prior, capture)
    return prepare(capture, views, cached(prior), cloud, seed=seed)


def _prior(config: Any, capture: Any) -> Any:
    if str(config._target_).endswith("DemoPrior"):
        return instantiate(config, "prior", truth={f.name: f.load for f in capture.frames})
    return instantiate(config, "prior")


def _rasterizer(config: DictConfig, background: tuple[float, float, float]) -> tuple[Any, str, str]:
    """The rasterizer, what it is called, and the device that it draws on and the field lies on."""
    import rasterizers

    device = _device(config.fit.device)
    settings = {k: v for k, v in plain(config.rasterizer).items() if v is not None and k != "name"}
    settings.setdefault("background", background)
    settings["background"] = tuple(settings["background"])
    name = str(config.rasterizer.name)
    if name == "auto":
        name = rasterizers.fastest(device)
        for other, why_not in rasterizers.available().items():
            if why_not is not None:
                _log.info("rasterizer %s is not available: %s", other, why_not)
    elif device is not None and "device" in config.rasterizer:  # one that draws where it is told
        settings.setdefault("device", device)
    rasterizer = rasterizers.load(name, **settings)
    there = _drawn_on(rasterizer.traits.devices, name, device)
    return rasterizer, name if there == "cpu" else f"{name} on {there}", there


def _device(asked: str | None) -> str | None:
    """What `fit.device` says, if it can be had."""
    import torch

    if asked not in (None, "cpu", "cuda"):
        raise DataError("config", "fit.device", f"must be cpu, cuda or null, got {asked!r}", "null takes the best")
    if asked == "cuda" and not torch.cuda.is_available():
        raise DataError(
            "config", "fit.device", "is cuda, and torch finds no CUDA device",
            "install NVIDIA's driver and a torch built for CUDA, or take fit.device=cpu",
        )  # fmt: skip
    return asked


def _drawn_on(devices: frozenset[str], name: str, asked: str | None) -> str:
    """The device that was asked for, or else the best that this rasterizer draws on."""
    import torch

    if asked is None:
        return "cuda" if "cuda" in devices and torch.cuda.is_available() else "cpu"
    if asked not in devices:
        raise DataError(
            "config", "fit.device", f"is {asked}, and the rasterizer {name} draws on {' or '.join(sorted(devices))} alone",
            "choose another of the two, or leave fit.device=null",
        )  # fmt: skip
    return asked


def _threads(config: DictConfig) -> tuple[int, str]:
    """How many a job has, and why."""
    if config.fit.threads is not None:
        return int(config.fit.threads), "fit.threads"
    launcher = HydraConfig.get().launcher if HydraConfig.initialized() else None
    jobs = int(launcher.n_jobs) if launcher is not None and "n_jobs" in launcher else 1
    here = f"of {sweep.cores()} here"
    return sweep.threads(jobs), here if jobs == 1 else f"{here}, hydra.launcher.n_jobs={jobs}"


def _finished(folder: Path, config: Mapping[str, Any]) -> tuple[float | None] | None:
    """What the finished run in this folder returned; None where there is none.

    Raises:
        DataError: it was another configuration's, or its metrics.json is damaged.
    """
    from clear_strategies.data.strict_json import read_object

    path = folder / "metrics.json"
    if not path.exists():
        return None
    metrics = read_object(path)
    try:
        _require_same(path, metrics["config"], config)
        means = metrics["test"]["mean"] or metrics["train"]["mean"]
        psnr = means["ours"]["psnr"] if means else None
        date = metrics["provenance"]["date"]
    except (KeyError, TypeError) as error:
        raise DataError(path, str(error), "is missing", "remove the file: the run is then trained again") from error
    said = "no PSNR" if psnr is None else f"PSNR {psnr:.2f} dB"
    _log.info("%s: this run finished on %s (%s); nothing is trained.", folder, date, said)
    return (psnr,)


def _resume_newest(state: Any, folder: Path, config: Mapping[str, Any]) -> None:
    """Go on from the newest checkpoint that is whole; start anew where there is none."""
    from clear_strategies.training import checkpoint

    found = checkpoint.saved(folder)
    for source in reversed(found):
        try:
            saved = checkpoint.load(source)
        except DataError as error:
            _log.warning("%s; trying an earlier one.", error)
            continue
        _restore(state, saved, source, config)
        return
    if found:
        _log.warning("%s: no checkpoint is whole; starting anew.", folder)


def _resume(state: Any, source: Path, config: Mapping[str, Any]) -> None:
    from clear_strategies.training import checkpoint

    _restore(state, checkpoint.load(source), source, config)


def _restore(state: Any, saved: Any, source: Path, config: Mapping[str, Any]) -> None:
    _require_same(source, saved.config, config)
    state.restore(saved, source)
    _log.info("resumed from %s: %d iterations are done.", source, saved.t - 1)
    if saved.device != state.device.type:
        _log.warning(
            "until now this run trained on %s, from here on %s: what follows is not bit for bit what would have followed.",
            saved.device, state.device.type,
        )  # fmt: skip


def _require_same(source: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    differences = [
        f"{key}: {then.get(key)!r} then, {now.get(key)!r} now"
        for key in sorted({*then, *now})
        if then.get(key) != now.get(key)
    ]
    if differences:
        raise DataError(
            source, "config", "this is not the configuration that wrote it: " + "; ".join(differences[:5]),
            "resume with the same overrides, or start anew",
        )  # fmt: skip


def _watch() -> Callable[[], None] | None:
    """For joblib's jobs: looks whether the sweep was stopped, from whichever process."""
    ours = _sweep()
    return sweep.Watch(ours) if ours is not None and _launcher(HydraConfig.get()) == "joblib" else None


def _mip(config: DictConfig) -> Any:
    from clear_strategies.training.mip import MipFilter

    return MipFilter(**plain(config.mip))


def _comparable(config: DictConfig) -> dict[str, Any]:
    """The configuration, flat and JSON-ready, without what a resumed run may change."""

    def flatten(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
        if isinstance(value, dict):
            for key, item in value.items():
                yield from flatten(f"{prefix}.{key}" if prefix else str(key), item)
        else:
            yield prefix, value

    flat = {key: value for key, value in flatten("", plain(config)) if key not in _NOT_COMPARED}
    return dict(json.loads(json.dumps(flat)))  # as it comes back from a file


def _is_ours(error: BaseException) -> bool:
    """Whether a ValueError was raised by this package's own checks, whose messages are written for users."""
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    module = traceback.tb_frame.f_globals.get("__name__", "") if traceback is not None else ""
    return module.startswith(("clear_strategies", "rasterizers"))


if __name__ == "__main__":
    from clear_strategies.run import main as main_of_the_package

    main_of_the_package()  # not that of `__main__`, which another process could not import
