"""The files of a finished run. metrics.json is written last: if it exists, the run is finished."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import torch
from torch import Tensor

from clear_strategies import files
from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.core.progress import told
from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.ply import GaussianPly, write_gaussians
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_names import file_stems
from clear_strategies.errors import DataError, SettingError, counted, one_line
from clear_strategies.outputs import metrics
from clear_strategies.outputs.figures import SheetRow, spaced, write_contact_sheet, write_curves
from clear_strategies.outputs.image_scores import Metric
from clear_strategies.outputs.maps import MAPS, write_maps
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.plan import Chosen
from clear_strategies.outputs.provenance import provenance
from clear_strategies.training import memory
from clear_strategies.training.field import GaussianField
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import cameras
from clear_strategies.viewing.look import Painter, write_video
from rasterizers.geometry import SH_C0
from rasterizers.interface import Camera
from rasterizers.native import kernel_threads, threads

if TYPE_CHECKING:
    import pandas as pd

_log = logging.getLogger(__name__)

_OF_RUN: Final = (
    "contact_sheet.jpg", "curves.png", "history.csv", "conflict.csv", "timing.csv", "point_cloud.ply", "path.mp4",
    cameras.FILE, "maps/maps.json",
)  # fmt: skip
_OF_VIEW: Final = (
    "renders/{}.png", *(f"views/{{}}_{k}.png" for k in ("lr", "prior", "truth")),
    *(f"maps/{{}}/{name}.png" for name in MAPS), "maps/{}/maps.jpg",
)  # fmt: skip
_LONGEST: Final = 640  # px, of the video: `clear-strategies render` makes larger ones
_SHEET_VIEWS: Final = 4  # test views on the contact sheet and in views/, at most
_OWN_PHOTO: Final = (
    "LR, SR prior (and bicubic in the tables) show the test view's own photo, which training never sees."
)
_TRAINED_ON: Final = (
    "These are training views, since there are no test views: the run has seen their photos and SR images."
)


def write_results(
    folder: Path, scene: Scene, state: TrainState, painter: Painter, chosen: Chosen, *, backend: str, down: DownKernel,
    seconds: float, config: Mapping[str, Any], antialiased: bool, own: Mapping[str, Metric] | None = None,
) -> Evaluation:  # fmt: skip
    """Evaluate a finished run and write its files; returns its scores.

    Args:
        scene: on the CPU, also if the field is on CUDA.
        painter: of the state's field.
        down: D, by which the LR images were made.
        antialiased: the rasterizer compensates opacities, see `RasterSettings`.
        own: metrics, see `image_scores.Truth`.
    """
    import pandas as pd  # here, so that a job whose settings are refused does not wait for it

    field, work_log, settings = state.field, state.conductor.work_log, state.settings
    stems = file_stems(view.name for view in (*scene.train, *scene.test))
    history = pd.DataFrame(list(state.history_as_floats()))
    synthetic = " · SYNTHETIC prior" * scene.synthetic_prior
    title = f"{scene.name} · {chosen.title} · {counted(state.t - 1, 'iteration')} · seed {settings.seed}{synthetic}"
    rendered: dict[str, Tensor] = {}

    def render(view: View) -> Tensor:
        known = rendered.pop(view.name, None)
        return field.render(painter.rasterizer, view.hr.camera).cpu() if known is None else known

    with kernel_threads(threads()), files.Beside() as beside:
        with work_log.stage("maps"):
            if mapped := spaced(state.views, settings.map_views):
                try:
                    rendered |= write_maps(
                        folder / "maps", stems, mapped, painter, state.conductor, state.t - 1, beside
                    )
                except Exception as error:  # of a user's strategy; the run must not fail by it
                    _log.warning("maps: left out, %s: %s", type(error).__name__, one_line(error))
        memory.release()  # of the maps' gradients, several times the size of the field
        with work_log.stage("evaluate"):
            evaluation = metrics.evaluate(scene, render, down=down, own=own)
        for name, image in evaluation.renders.items():
            beside(write_png, folder / "renders" / f"{stems[name]}.png", image)
        beside(_write_sheet, folder, scene, stems, evaluation, title)
        beside(write_curves, folder / "curves.png", {chosen.title: history}, title)
        with work_log.stage("video"):
            _write_video(folder / "path.mp4", [view.hr.camera for view in scene.train], painter, settings.video)
        export_ply(folder / "point_cloud.ply", field, antialiased=antialiased)
        with work_log.stage("pictures"):  # waits for those that are not yet drawn
            beside.finish()
    stages = pd.DataFrame([*scene.work_log.rows(), *_two_stages(state, history), *work_log.rows()])
    _write_tables(folder, history, stages)
    metrics.write(
        folder / files.FINISHED, evaluation, scene=scene.name, **asdict(chosen), seed=settings.seed, iterations=state.t - 1,
        gaussians=len(field), seconds=seconds, conflict=_mean_conflict(history), synthetic_prior=scene.synthetic_prior,
        config=config, provenance=provenance(threads=threads(), seed=settings.seed, backend=backend, plan=scene.notes),
    )  # fmt: skip
    return evaluation


def export_ply(path: Path, field: GaussianField, *, antialiased: bool = True, degree: int = 3) -> None:
    """Write the field, atomically; f_det is folded into the colour, the 3D filter into scales and opacities.

    Args:
        antialiased: the field was trained with opacity compensation. The header then says `SplatRenderMode: mip`, and a viewer
            that honours this draws the file in the same way.
        degree: of view-dependent colour that is kept, at most that of the field.
    """
    splats = field.baked()
    tiny = torch.finfo(torch.float32).eps
    higher = torch.zeros_like(field.shN.data)
    higher[:, : splats.shN.shape[1]] = splats.shN  # bands above the active degree were never rendered
    gaussians = GaussianPly(
        means=splats.means,
        sh0=splats.sh0 + field.detail.data[:, None] / SH_C0,
        shN=higher[:, : (degree + 1) ** 2 - 1],
        opacities=torch.logit(splats.opacities.clamp(tiny, 1 - tiny)),
        scales=splats.scales.log(),
        quats=torch.nn.functional.normalize(splats.quats, dim=-1),
        antialiased=antialiased,
    )
    write_gaussians(path, gaussians)


def remove_earlier(folder: Path, *, all_files: bool) -> None:
    """Remove metrics.json of an earlier run, because it marks a run as finished.

    Args:
        all_files: also remove the other files of that run, which could be mistaken for those of the new run. They are found by
            the views in its metrics.json and cameras.json; all other files stay.
    """
    path = folder / files.FINISHED
    if not path.exists():
        return
    _log.warning("%s: of an earlier run; removed%s.", path, ", and the pictures and tables of that run" * all_files)
    stems: set[str] = set()
    with suppress(DataError):  # damaged, or of another program
        content = metrics.read(path, "")
        stems |= {*file_stems(name for part in (content.test, content.train) for name in part.views).values()}
        stems |= {*file_stems(saved.name for saved in cameras.read_cameras(folder / cameras.FILE)).values()}
    path.unlink()
    if not (all_files and stems):
        return
    for name in (*_OF_RUN, *(name.format(stem) for stem in stems for name in _OF_VIEW)):
        (folder / name).unlink(missing_ok=True)
        for emptied in list(Path(name).parents)[:-1]:
            with suppress(OSError):  # files of others are in it
                (folder / emptied).rmdir()


def _write_video(path: Path, train: Sequence[Camera], painter: Painter, frames: int) -> None:
    """Write a loop through the training cameras. Without imageio-ffmpeg, log a message instead."""
    if not frames:
        return
    along = told(cameras.through(train, frames), "video", "frames", frames)
    try:
        write_video(path, (images.to_bytes(painter.color(cameras.at_most(camera, _LONGEST))) for camera in along))
    except SettingError as missing:
        _log.info("no video of the camera path is written: %s", missing)


def _write_sheet(folder: Path, scene: Scene, stems: Mapping[str, str], evaluation: Evaluation, title: str) -> None:
    """Draw the LR photo, the SR image and the render of a few views, with the truth and the error if it is known."""
    rows: list[SheetRow] = []
    scored = evaluation.shown.views
    rendered = [view for view in (*scene.test, *scene.train) if view.name in evaluation.renders]
    for view in (*scene.train, *scene.test):  # the viewer shows them beside the rendering
        write_png(folder / "views" / f"{stems[view.name]}_lr.png", view.lr.image)
    for view in spaced(rendered, _SHEET_VIEWS):
        for kind, shown in {"prior": view.hr.image, "truth": view.true_hr}.items():
            if shown is not None:
                write_png(folder / "views" / f"{stems[view.name]}_{kind}.png", shown)
        columns: dict[str, Tensor] = {}
        if not view.hr_is_photo:
            columns["LR, enlarged"] = images.upsample(view.lr.image, view.factor, "nearest")
            columns["SR prior"] = view.hr.image
        columns["ours"] = evaluation.renders[view.name].clamp(0, 1)
        if (truth := view.true_hr) is not None:
            columns |= {"ground truth": truth, "error of ours": (columns["ours"] - truth).abs().mean(-1)}
        score = scored[view.name]["ours"]
        captions = {"ours": f"{score.psnr:.2f} dB, SSIM {score.ssim:.3f}"}
        pixels = {name: image.numpy() for name, image in columns.items()}
        pictures = [name for name, image in pixels.items() if image.ndim == 3]
        given = [name for name in pictures if name != "ours"]  # these differ most where there is most detail
        rows.append(SheetRow(view.name, pixels, captions, given if len(given) > 1 else pictures))
    note = _TRAINED_ON
    if scene.test:
        note = "" if scene.test[0].hr_is_photo else _OWN_PHOTO
    write_contact_sheet(folder / "contact_sheet.jpg", rows, title, note)


def _write_tables(folder: Path, history: pd.DataFrame, stages: pd.DataFrame) -> None:
    shares = [name for prefix in ("conflict", "corrected") for name in history if name.startswith(prefix)]
    means = [name for name in ("mean_q", "mean_w", "mean_omega") if name in history]
    compared = history[history["conflict"].notna()] if "conflict" in history else history[:0]
    conflict = compared.reindex(columns=["t", *dict.fromkeys(["conflict", *shares, *means])])
    for name, table in {"history": history, "conflict": conflict, "timing": stages}.items():
        files.write_text(folder / f"{name}.csv", table.to_csv(index=False))


def _two_stages(state: TrainState, history: pd.DataFrame) -> list[dict[str, str | int | float]]:
    """Iterations and seconds of both stages of a two-stage method; empty for others."""
    if (begins := state.density.second_stage) is None or history.empty:
        return []
    whole = history["seconds"].iloc[-1]
    first = history.loc[history["t"] < begins, "seconds"].max() if begins > history["t"].iloc[0] else 0.0
    rows = ("first stage", begins - 1, first), ("second stage", state.t - begins, whole - first)
    return [{"stage": name, "runs": runs, "seconds": round(float(s), 3)} for name, runs, s in rows]


def _mean_conflict(history: pd.DataFrame) -> dict[str, float]:
    """Mean conflict ratios over the iterations that compared gradients, by group, and as "gaussian" for whole Gaussians."""
    means = history.filter(regex="^conflict").mean().dropna()
    return {name.removeprefix("conflict").removeprefix("_") or "gaussian": float(mean) for name, mean in means.items()}
