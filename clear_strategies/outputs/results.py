"""Floor 5: what a run leaves: scores, curves, pictures, maps and a PLY; metrics.json last, for it says "finished"."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.scene import Scene
from clear_strategies.outputs import maps, metrics, pictures
from clear_strategies.outputs.export import export_ply
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.plan import Chosen, marks
from clear_strategies.outputs.provenance import provenance
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rasterizer

_log = logging.getLogger(__name__)

_SHEET_VIEWS: Final = 4  # test views on the contact sheet, and left as pictures


def leave(
    folder: Path,
    scene: Scene,
    state: TrainState,
    rasterizer: Rasterizer,
    chosen: Chosen,
    *,
    backend: str,
    down: DownKernel,
    map_views: int,
    seconds: float,
    config: Mapping[str, Any],
) -> float | None:
    """Evaluate, write everything, say the scores; returns the mean PSNR of the test views.

    Args:
        scene: on the CPU, wherever the field is. down: D, which made the LR images.
        map_views: training views of which maps are left, at most.
        seconds: of training. config: kept in metrics.json, for whoever finds the finished run.
    """
    field, work_log, history = state.field, state.conductor.work_log, state.history_as_floats()
    with work_log.stage("evaluate"):
        evaluation = metrics.evaluate(scene, lambda camera: field.render(rasterizer, camera).cpu(), down=down)
    with work_log.stage("maps"):
        mapped = pictures.evenly(state.views, map_views)
        if mapped:
            maps.leave(folder / "maps", mapped, field, state.conductor, rasterizer, down=down)
    export_ply(folder / "point_cloud.ply", field)
    for name, image in evaluation.renders.items():
        write_png(folder / "renders" / f"{Path(name).stem}.png", image)
    for view in pictures.evenly(scene.test, _SHEET_VIEWS):
        for kind, shown in {"lr": view.lr.image, "prior": view.hr.image, "truth": view.truth}.items():
            if shown is not None:
                write_png(folder / "views" / f"{Path(view.name).stem}_{kind}.png", shown)
    length = f"{state.t - 1} iterations · seed {state.settings.seed}"
    title = f"{scene.name} · {chosen.title} · {length}"
    if scene.synthetic_prior:
        title += " · SYNTHETIC prior"
    pictures.contact_sheet(folder / "contact_sheet.png", _sheet(scene, evaluation), title)
    pictures.curves(folder / "curves.png", history, marks(state), title)

    columns = list(dict.fromkeys(key for row in history for key in row))
    files.write_csv(folder / "history.csv", history, columns)
    shares = [
        "conflict",
        *(c for c in columns if c.startswith("conflict_")),
        *(c for c in columns if c.startswith("corrected")),
    ]
    readings = [c for c in ("mean_q", "mean_w", "mean_omega") if c in columns]
    compared = [row for row in history if "conflict" in row]
    files.write_csv(folder / "conflict.csv", compared, ["t", *dict.fromkeys(shares), *readings])
    files.write_csv(
        folder / "timing.csv",
        work_log.rows(),
        ["stage", "runs", "ms_each", "seconds", "skipped", "seconds_saved", "why"],
    )
    mean = evaluation.mean("test") or evaluation.mean("train")
    files.write_json(
        folder / "metrics.json",
        metrics.to_json(
            evaluation,
            scene=scene.name,
            method=chosen.method,
            strategies=list(chosen.strategies),
            seed=state.settings.seed,
            iterations=state.t - 1,
            gaussians=len(field),
            seconds=seconds,
            conflict=_mean_conflict(compared),
            synthetic_prior=scene.synthetic_prior,
            config=config,
            provenance=provenance(seed=state.settings.seed, backend=backend, plan=scene.notes),
        ),
    )
    _say(folder, evaluation, seconds)
    return None if mean is None else mean.psnr


def _sheet(scene: Scene, evaluation: Evaluation) -> list[pictures.SheetRow]:
    rows = []
    for view in pictures.evenly(scene.test, _SHEET_VIEWS):
        scores = evaluation.test[view.name]["ours"]
        shown = {
            "LR, enlarged": images.upsample(view.lr.image, view.factor, "nearest"),
            "SR prior": view.hr.image,
            "ours": evaluation.renders[view.name],
        }
        rows.append(pictures.SheetRow(view.name, shown, view.truth, f"{scores.psnr:.2f} dB, SSIM {scores.ssim:.3f}"))
    return rows


def _mean_conflict(rows: list[dict[str, float]]) -> dict[str, float]:
    """Mean over the iterations with λ_HR > 0, by group and for the Gaussian as a whole."""
    means = {}
    for key in dict.fromkeys(k for row in rows for k in row if k == "conflict" or k.startswith("conflict_")):
        values = [row[key] for row in rows if key in row and not math.isnan(row[key])]
        if values:
            means[key.removeprefix("conflict_").replace("conflict", "gaussian")] = sum(values) / len(values)
    return means


def _say(folder: Path, evaluation: Evaluation, seconds: float) -> None:
    lines = [f"done in {seconds:.0f} s: {folder}"]
    for part in ("test", "train"):
        for method in ("ours", "bicubic", "prior"):
            if (m := evaluation.mean(part, method)) is not None:
                lines.append(
                    f"  {part:<5} {method:<8} PSNR {m.psnr:6.2f} dB   SSIM {m.ssim:.4f}   GMSD {m.gmsd:.4f}   blur {m.blur:+.4f}"
                )
    _log.info("\n".join(lines))
