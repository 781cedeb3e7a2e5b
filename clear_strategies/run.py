"""`python -m clear_strategies.run +strategy=clear`: the door to a whole run, and the only one that knows Hydra.

Composes the configuration, prints the plan, trains, and leaves in Hydra's run folder: metrics.json, history.csv,
conflict.csv, timing.csv, renders/, views/, maps/, contact_sheet.png, curves.png, point_cloud.ply and checkpoints/. Exit
codes: 0, 2 for input that cannot be used, 3 where the disk is full or read-only, 130 and 143 when stopped by a signal
(after saving).
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from clear_strategies.errors import ClearError, DataError

_log = logging.getLogger(__name__)

_PACKAGE: Final = Path(__file__).resolve().parent
# In a wheel conf/ lies inside the package, in a checkout beside it.
CONF: Final = _PACKAGE / "conf" if (_PACKAGE / "conf").is_dir() else _PACKAGE.parent / "conf"

# What may differ between a run and the one it resumes.
_NOT_COMPARED: Final = {
    "fit.resume",
    "fit.threads",
    "fit.keep",
    "fit.checkpoint_every",
    "fit.probe_every",
    "fit.probe_views",
    "fit.map_views",
}

_SHEET_VIEWS: Final = 4  # test views on the contact sheet, and left as pictures

_failed_jobs: list[str] = []


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="config")
def main(config: DictConfig) -> float | None:
    """One job: returns the mean PSNR of the test views, which a sweeper may optimize."""
    from clear_strategies.fit import Interrupted
    from rasterizers.interface import BackendUnavailable

    try:
        return run(config, Path(HydraConfig.get().runtime.output_dir))
    except Interrupted as stopped:
        _log.error("%s", stopped)
        sys.exit(stopped.exit_code)
    except OSError as error:  # a full or read-only disk; unusable input is a DataError
        _log.error("%s: %s. Earlier checkpoints are untouched.", error.filename or "output", error.strerror or error)
        sys.exit(3)
    except (ClearError, BackendUnavailable, OmegaConfBaseException, InstantiationException, ValueError) as error:
        if isinstance(error, ValueError) and not isinstance(error, ClearError) and not _is_ours(error):
            raise
        message = _one_line(error)
        _log.error("%s", message)
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            _failed_jobs.append(message)  # the other jobs go on
            return None
        sys.exit(2)


def run(config: DictConfig, folder: Path) -> float | None:
    """Everything a job does, into `folder`."""
    import torch

    from clear_strategies.conductor import Conductor
    from clear_strategies.data.scene import save_lr
    from clear_strategies.fit import FitSettings, TrainState, fit
    from clear_strategies.schedules import scaled

    if config.fit.threads is not None:
        torch.set_num_threads(int(config.fit.threads))
    if config.fit.map_views < 0:
        raise DataError(
            "config", "fit.map_views", f"must be at least 0, got {config.fit.map_views}", "0 leaves no maps"
        )
    known = FitSettings.__dataclass_fields__
    settings = FitSettings(**{k: v for k, v in _plain(config.fit).items() if k in known})
    strategies = [scaled(s, settings.stretch) for s in _instantiate_strategies(config)]
    objective = scaled(_instantiate(config.objective, "objective"), settings.stretch)
    density = scaled(_instantiate(config.density, "density"), settings.stretch)
    rates = scaled(_instantiate(config.optim, "optim"), settings.stretch)
    mip = scaled(_mip(config), settings.stretch)
    conductor = Conductor(
        *strategies, objective=objective, statistics_from=round(config.statistics_from * settings.stretch)
    )
    scene = _scene(config, settings.seed)
    if config.data.save_lr is not None:
        save_lr(scene, Path(config.data.save_lr))
        return None
    rasterizer, backend = _rasterizer(config, scene.background)

    state = TrainState.start(
        scene, conductor, settings=scaled(settings, settings.stretch), density=density, rates=rates, mip=mip
    )
    compared = _comparable(config)
    if config.fit.resume is not None:
        _resume(state, Path(config.fit.resume), compared)
    _print_plan(config, scene, state, backend)
    began = time.perf_counter()
    with _progress(state) as progress:
        fit(state, scene, rasterizer, checkpoints=folder / "checkpoints", config=compared, progress=progress)
    seconds = time.perf_counter() - began
    return _leave_results(config, folder, scene, state, rasterizer, backend, seconds)


def _scene(config: DictConfig, seed: int) -> Any:
    from clear_strategies.data.scene import prepare
    from clear_strategies.data.upscale import Bicubic, Cached, Network

    if OmegaConf.is_missing(config.data, "path"):
        raise DataError("config", "data.path", "is needed by this data set and missing", "add data.path=FOLDER")
    capture = _instantiate(config.data.reader, "data.reader")
    views = _instantiate(config.data.views, "data.views")
    cloud = _instantiate(config.data.cloud, "data.cloud")
    if config.data.save_lr is not None:
        prior = Bicubic()  # the images that the real prior reads may not exist yet
    elif config.prior.get("_target_") is None:  # prior=auto
        name = "demo" if capture.name == "demo" else "bicubic"
        chosen = OmegaConf.load(CONF / "prior" / f"{name}.yaml")
        prior = _prior(chosen, capture)
        _log.info("prior: auto chose %s.", prior.label)
    else:
        prior = _prior(config.prior, capture)
    return prepare(capture, views, Cached(prior) if isinstance(prior, Network) else prior, cloud, seed=seed)


def _prior(config: Any, capture: Any) -> Any:
    if str(config._target_).endswith("DemoPrior"):
        return _instantiate(config, "prior", truth={f.name: f.load for f in capture.frames})
    return _instantiate(config, "prior")


def _rasterizer(config: DictConfig, background: tuple[float, float, float]) -> tuple[Any, str]:
    import rasterizers

    settings = {k: v for k, v in _plain(config.rasterizer).items() if v is not None and k != "name"}
    settings.setdefault("background", background)
    settings["background"] = tuple(settings["background"])
    name = str(config.rasterizer.name)
    if name == "auto":
        name = rasterizers.fastest()
        for other, why_not in rasterizers.available().items():
            if why_not is not None:
                _log.info("rasterizer %s is not available: %s", other, why_not)
    return rasterizers.load(name, **settings), name


def _resume(state: Any, source: Path, config: Mapping[str, Any]) -> None:
    from clear_strategies import checkpoint

    saved = checkpoint.load(source)
    differences = [
        f"{key}: {saved.config.get(key)!r} then, {config.get(key)!r} now"
        for key in sorted({*saved.config, *config})
        if saved.config.get(key) != config.get(key)
    ]
    if differences:
        raise DataError(
            source, "config", "this is not the configuration that wrote it: " + "; ".join(differences[:5]),
            "resume with the same overrides, or start anew",
        )  # fmt: skip
    state.restore(saved, source)
    _log.info("resumed from %s: %d iterations are done.", source, saved.t - 1)


def _print_plan(config: DictConfig, scene: Any, state: Any, backend: str) -> None:
    from clear_strategies.schedules import milestones
    from rasterizers import native

    settings, conductor = state.settings, state.conductor
    strategies = ", ".join(
        f"{name} ({type(s).__name__})" for name, s in zip(config.strategies, conductor.strategies, strict=True)
    )
    lines = {
        **scene.notes,
        "strategies": strategies or "none (the paper's baseline)",
        "rasterizer": f"{backend}, kernel {config.rasterizer.kernel} px², {native.threads()} threads",
        "per-Gaussian pass": "readable" if state.fused is None else "compiled",
        "iterations": f"{settings.iterations}, seed {settings.seed}",
        "milestones": ", ".join(f"{name} {t}" for name, t in _marks(state).items()),
    }
    for s in conductor.strategies:
        if found := milestones(s):
            lines[f"milestones of {type(s).__name__}"] = ", ".join(f"{name} {t}" for name, t in found.items())
    skipped = []
    if conductor.objective.lambda_hf == 0:
        skipped.append("high-frequency loss (lambda_hf = 0)")
    hr = conductor.objective.lambda_hr
    if hr.peak == hr.final == 0:
        skipped.append("HR scale throughout (lambda_HR = 0)")
        if idle := [name for name in config.strategies if name in ("gco", "p2g")]:
            _log.warning("lambda_HR is 0 throughout: %s has no effect.", " and ".join(idle))
    elif hr.start > 0:
        skipped.append(f"HR scale until iteration {hr.start} (lambda_HR = 0)")
    if state.mip.variance == 0:
        skipped.append("3D filter (variance 0)")
    lines["skipped"] = "; ".join(skipped) or "nothing"
    width = max(map(len, lines))
    _log.info("\n".join(f"  {label:<{width}}  {text}" for label, text in lines.items()))


def _marks(state: Any) -> dict[str, int]:
    """The milestones worth a mark on a curve."""
    hr, density = state.conductor.objective.lambda_hr, state.density.settings
    marks = {"HR from": hr.start, "HR full": hr.full, "densify until": density.stop}
    if hr.final != hr.peak:
        marks["HR decays"] = hr.decay_from
    if 0 < density.reset_every < density.stop:
        marks["opacity reset"] = density.reset_every
    for s in state.conductor.strategies:
        if hasattr(s, "anchor_start"):
            marks["anchor"] = s.anchor_start
    return marks


@contextmanager
def _progress(state: Any) -> Iterator[Callable[[Any], None]]:
    """A bar with loss, PSNR, Gaussians, conflict ratio and the time that is left."""
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    shown: dict[str, str] = {}
    every = 0.5 if sys.stderr.isatty() else 15  # seconds; a log file needs no animation
    total, done = state.settings.iterations, state.t - 1
    with (
        logging_redirect_tqdm(),
        tqdm(total=total, initial=done, unit="it", dynamic_ncols=True, mininterval=every) as bar,
    ):

        def update(state: Any) -> None:
            row = state.history[-1]
            shown["loss"] = f"{row['loss_lr'] + row['lambda_hr'] * row.get('loss_base', 0.0):.4f}"
            shown["N"] = f"{int(row['n_gaussians']):,}"
            if not math.isnan(row.get("conflict", math.nan)):
                shown["conflict"] = f"{row['conflict']:.2f}"
            if "psnr_test" in row:
                shown["psnr"] = f"{row['psnr_test']:.2f} dB"
            bar.set_postfix(shown, refresh=False)
            bar.update(1)

        yield update


def _leave_results(
    config: DictConfig, folder: Path, scene: Any, state: Any, rasterizer: Any, backend: str, seconds: float
) -> float | None:
    from clear_strategies import diagnosis, files, metrics, pictures
    from clear_strategies.data.photo_files import write_png
    from clear_strategies.export import export_ply
    from clear_strategies.provenance import provenance

    field, ledger = state.field, state.conductor.ledger
    with ledger.stage("evaluate"):
        down = config.data.views.downsample
        evaluation = metrics.evaluate(scene, lambda camera: field.render(rasterizer, camera), down=down)
    with ledger.stage("maps"):
        mapped = _spread(scene.train, int(config.fit.map_views))
        if mapped:
            diagnosis.leave(folder / "maps", mapped, field, state.conductor, rasterizer, down=down)
    export_ply(folder / "point_cloud.ply", field)
    for name, image in evaluation.renders.items():
        write_png(folder / "renders" / f"{Path(name).stem}.png", image)
    for view in _spread(scene.test, _SHEET_VIEWS):
        for kind, image in {"lr": view.lr.image, "prior": view.hr.image, "truth": view.truth}.items():
            if image is not None:
                write_png(folder / "views" / f"{Path(view.name).stem}_{kind}.png", image)
    names = [str(name) for name in config.strategies]
    length = f"{state.settings.iterations} iterations · seed {state.settings.seed}"
    title = f"{scene.name} · {' + '.join(names) or 'baseline'} · {length}"
    if scene.synthetic_prior:
        title += " · SYNTHETIC prior"
    pictures.contact_sheet(folder / "contact_sheet.png", _sheet(scene, evaluation), title)
    pictures.curves(folder / "curves.png", state.history, _marks(state), title)

    columns = list(dict.fromkeys(key for row in state.history for key in row))
    files.write_csv(folder / "history.csv", state.history, columns)
    shares = [
        "conflict",
        *(c for c in columns if c.startswith("conflict_")),
        *(c for c in columns if c.startswith("corrected")),
    ]
    readings = [c for c in ("mean_q", "mean_w", "mean_omega") if c in columns]
    compared = [row for row in state.history if "conflict" in row]
    files.write_csv(folder / "conflict.csv", compared, ["t", *dict.fromkeys(shares), *readings])
    files.write_csv(
        folder / "timing.csv", ledger.rows(), ["stage", "runs", "ms_each", "seconds", "skipped", "seconds_saved", "why"]
    )
    mean = evaluation.mean("test") or evaluation.mean("train")
    files.write_json(
        folder / "metrics.json",
        metrics.to_json(
            evaluation,
            scene=scene.name,
            strategies=names,
            seed=state.settings.seed,
            iterations=state.settings.iterations,
            gaussians=len(field),
            seconds=seconds,
            conflict=_mean_conflict(compared),
            synthetic_prior=scene.synthetic_prior,
            provenance=provenance(seed=state.settings.seed, backend=backend, plan=scene.notes),
        ),
    )
    _say_results(folder, evaluation, seconds)
    return None if mean is None else mean.psnr


def _sheet(scene: Any, evaluation: Any) -> list[Any]:
    from clear_strategies import images, pictures

    rows = []
    for view in _spread(scene.test, _SHEET_VIEWS):
        scores = evaluation.test[view.name]["ours"]
        shown = {
            "LR, enlarged": images.upsample(view.lr.image, view.factor, "nearest"),
            "SR prior": view.hr.image,
            "ours": evaluation.renders[view.name],
        }
        rows.append(pictures.SheetRow(view.name, shown, view.truth, f"{scores.psnr:.2f} dB, SSIM {scores.ssim:.3f}"))
    return rows


def _spread(views: Sequence[Any], count: int) -> Sequence[Any]:
    """At most so many of the views, evenly."""
    return views[:: max(1, math.ceil(len(views) / count))] if count else ()


def _mean_conflict(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean over the iterations with λ_HR > 0, by group and for the Gaussian as a whole."""
    means = {}
    for key in dict.fromkeys(k for row in rows for k in row if k == "conflict" or k.startswith("conflict_")):
        values = [row[key] for row in rows if key in row and not math.isnan(row[key])]
        if values:
            means[key.removeprefix("conflict_").replace("conflict", "gaussian")] = sum(values) / len(values)
    return means


def _say_results(folder: Path, evaluation: Any, seconds: float) -> None:
    lines = [f"done in {seconds:.0f} s: {folder}"]
    for part in ("test", "train"):
        for method in ("ours", "bicubic", "prior"):
            if (m := evaluation.mean(part, method)) is not None:
                lines.append(
                    f"  {part:<5} {method:<8} PSNR {m.psnr:6.2f} dB   SSIM {m.ssim:.4f}   GMSD {m.gmsd:.4f}   blur {m.blur:+.4f}"
                )
    _log.info("\n".join(lines))


def _instantiate(config: Any, key: str, **extra: Any) -> Any:
    """Build what a config node names, with errors that name the node."""
    try:
        return hydra.utils.instantiate(config, _convert_="object", **extra)
    except InstantiationException as error:
        cause = error.__cause__
        if isinstance(cause, ClearError):
            raise cause from None
        raise DataError("config", key, _one_line(cause or error), "see the field's comment in conf/") from cause


def _instantiate_strategies(config: DictConfig) -> Iterator[Any]:
    from clear_strategies.strategy import Strategy

    for name, node in config.strategies.items():
        strategy = _instantiate(node, f"strategies.{name}")
        if not isinstance(strategy, Strategy):
            raise DataError(
                "config", f"strategies.{name}", f"is a {type(strategy).__name__}, not a Strategy",
                "derive the class from clear_strategies.Strategy",
            )  # fmt: skip
        yield strategy


def _mip(config: DictConfig) -> Any:
    from clear_strategies.mip import MipFilter

    return MipFilter(**_plain(config.mip))


def _plain(node: Any) -> dict[str, Any]:
    plain = OmegaConf.to_container(node, resolve=True)
    return {str(k): v for k, v in plain.items()} if isinstance(plain, dict) else {}


def _comparable(config: DictConfig) -> dict[str, Any]:
    """The configuration, flat and JSON-ready, without what a resumed run may change."""

    def flatten(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
        if isinstance(value, dict):
            for key, item in value.items():
                yield from flatten(f"{prefix}.{key}" if prefix else str(key), item)
        else:
            yield prefix, value

    return {key: value for key, value in flatten("", _plain(config)) if key not in _NOT_COMPARED}


def _is_ours(error: BaseException) -> bool:
    """Whether a ValueError was raised by this package's own checks, whose messages are written for users."""
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    module = traceback.tb_frame.f_globals.get("__name__", "") if traceback is not None else ""
    return module.startswith(("clear_strategies", "rasterizers"))


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())


if __name__ == "__main__":
    main()
    if _failed_jobs:
        _log.error("%d job(s) failed: %s", len(_failed_jobs), " | ".join(_failed_jobs))
        sys.exit(2)
