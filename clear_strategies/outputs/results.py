"""The files of a finished run. metrics.json is written last: where it exists, the run is finished."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from torch import Tensor

from clear_strategies import files, viewing
from clear_strategies.core import images
from clear_strategies.core.images import DownKernel
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_names import file_stem
from clear_strategies.density.shuffle import SECOND_STAGE
from clear_strategies.errors import DataError
from clear_strategies.outputs import metrics
from clear_strategies.outputs.contact_sheet import OWN_PHOTO, TRAINED_ON, SheetRow, write_contact_sheet
from clear_strategies.outputs.coverage import write_coverage
from clear_strategies.outputs.curves import write_curves
from clear_strategies.outputs.export import export_ply
from clear_strategies.outputs.figures import column_means, spaced
from clear_strategies.outputs.maps import MAPS, write_maps
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.plan import Chosen
from clear_strategies.outputs.provenance import provenance
from clear_strategies.training import memory
from clear_strategies.training.state import TrainState
from clear_strategies.viewing import cameras, paths, video
from clear_strategies.viewing import page as splat_page
from clear_strategies.viewing.look import Painter
from rasterizers.interface import Camera, Color, Rasterizer

_log = logging.getLogger(__name__)

_METRICS: Final = "metrics.json"
_COVERAGE: Final = "maps/coverage.png"
_OF_RUN: Final = (
    "contact_sheet.png", "curves.png", "history.csv", "conflict.csv", "timing.csv", "point_cloud.ply", "path.mp4",
    splat_page.FILE, cameras.FILE, "maps/maps.json", _COVERAGE,
)  # fmt: skip
_OF_VIEW: Final = (
    "renders/{}.png", *(f"views/{{}}_{k}.png" for k in ("lr", "prior", "truth")),
    *(f"maps/{{}}/{name}.png" for name in (*MAPS, "maps")),
)  # fmt: skip
_LONGEST: Final = 960  # px, of the video: a frame takes a fraction of a second, and the file a few MB
_SHEET_VIEWS: Final = 4  # test views on the contact sheet and in views/, at most


@dataclass(frozen=True, slots=True)
class Pictures:
    """The pictures of a run, besides the renders of its test views.

    Args:
        map_views: how many training views get maps, at most; 0: there is no map of what the photos see either.
        video_frames: of the loop through the training cameras; 0: none.
        page_gaussians: a field of more gets no page; 0: none does.
    """

    map_views: int
    video_frames: int
    page_gaussians: int


def write_results(
    folder: Path,
    scene: Scene,
    state: TrainState,
    rasterizer: Rasterizer,
    chosen: Chosen,
    *,
    backend: str,
    down: DownKernel,
    painter: Painter,
    pictures: Pictures,
    seconds: float,
    config: Mapping[str, Any],
    antialiased: bool,
) -> Evaluation:
    """Evaluate a finished run and write its files; returns its scores.

    Args:
        scene: on the CPU, wherever the field is.
        down: D, by which the LR images were made.
        painter: of the state's field, for depth and video.
        antialiased: the rasterizer compensates opacities, see `RasterSettings`.
    """
    field, work_log, history = state.field, state.conductor.work_log, state.history_as_floats()
    with work_log.stage("evaluate"):
        evaluation = metrics.evaluate(scene, lambda camera: field.render(rasterizer, camera).cpu(), down=down)
    for name, image in evaluation.renders.items():
        write_png(folder / "renders" / f"{file_stem(name)}.png", image)
    export_ply(folder / "point_cloud.ply", field, antialiased=antialiased)
    synthetic = " · SYNTHETIC prior" * scene.synthetic_prior
    title = f"{scene.name} · {chosen.title} · {state.t - 1} iterations · seed {state.settings.seed}{synthetic}"
    with work_log.stage("maps"):
        if mapped := spaced(state.views, pictures.map_views):
            write_maps(folder / "maps", mapped, painter, state.conductor, rasterizer, state.t - 1)
            write_coverage(folder / _COVERAGE, scene, painter, title)
    memory.release()  # the gradients that the maps are made of: several times the field
    with work_log.stage("contact sheet and curves"):
        _write_sheet(folder, scene, evaluation, title)
        write_curves(folder / "curves.png", {chosen.title: history}, title)
    train = [view.hr.camera for view in scene.train]
    with work_log.stage("video"):
        _write_video(folder / "path.mp4", train, painter, pictures.video_frames)
    with work_log.stage("page"):
        _write_page(folder / splat_page.FILE, train, painter, pictures.page_gaussians, title, scene.background)
    _write_tables(folder, history, [*scene.work_log.rows(), *_two_stages(state, history), *work_log.rows()])
    files.write_json(
        folder / _METRICS,
        metrics.to_json(
            evaluation, scene=scene.name, **asdict(chosen), seed=state.settings.seed, iterations=state.t - 1,
            gaussians=len(field), seconds=seconds, conflict=_mean_conflict(history), synthetic_prior=scene.synthetic_prior,
            config=config, provenance=provenance(seed=state.settings.seed, backend=backend, plan=scene.notes),
        ),
    )  # fmt: skip
    return evaluation


def remove_earlier(folder: Path, *, all_files: bool) -> None:
    """Remove metrics.json of an earlier run, because its presence says that a run is finished.

    Args:
        all_files: also the other files of that run, which would be taken for those of the new run. The views in its
            metrics.json name them; all other files stay.
    """
    path = folder / _METRICS
    if not path.exists():
        return
    _log.warning("%s: of an earlier run; removed%s.", path, ", and the pictures and tables of that run" * all_files)
    stems: set[str] = set()
    with suppress(DataError):  # damaged, or of another program
        content = metrics.read(path, "")
        stems = {file_stem(name) for part in (content.test, content.train) for name in part.views}
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
    if (missing := video.missing()) is not None:
        _log.info("no video of the camera path is written: %s.", missing)
        return
    along = [cameras.at_most(camera, _LONGEST) for camera in paths.through(train, frames)]
    video.write_video(path, (images.to_bytes(painter.color(camera)) for camera in along), fps=viewing.FPS)


def _write_page(
    path: Path, train: Sequence[Camera], painter: Painter, most: int, title: str, background: Color
) -> None:
    """Write splat.html. Where the field has more Gaussians than `most`, or the page cannot be made, log why instead."""
    count = len(painter.field)
    if most == 0:
        return
    if (missing := viewing.missing()) is not None:
        _log.info("no %s is written: %s.", path.name, missing)
        return
    if count > most:
        _log.info("no %s is written: there are %s Gaussians, fit.page is %s.", path.name, f"{count:,}", f"{most:,}")
        return
    try:
        splat_page.write_page(path, painter.field.baked(), train, title, background)
    except OSError as error:  # the other files of a run are worth more than its page
        _log.warning("%s could not be written: %s.", path.name, error)


def _write_sheet(folder: Path, scene: Scene, evaluation: Evaluation, title: str) -> None:
    rows, part = [], evaluation.test or evaluation.train
    rendered = [view for view in (*scene.test, *scene.train) if view.name in evaluation.renders]
    for view in spaced(rendered, _SHEET_VIEWS):
        for kind, shown in {"lr": view.lr.image, "prior": view.hr.image, "truth": view.truth}.items():
            if shown is not None:
                write_png(folder / "views" / f"{file_stem(view.name)}_{kind}.png", shown)
        columns: dict[str, Tensor] = {}
        if not view.hr_is_photo:
            columns["LR, enlarged"] = images.upsample(view.lr.image, view.factor, "nearest")
            columns["SR prior"] = view.hr.image
        columns["ours"], score = evaluation.renders[view.name], part[view.name]["ours"]
        captions = {"ours": f"{score.psnr:.2f} dB, SSIM {score.ssim:.3f}"}
        rows.append(SheetRow(view.name, columns, view.truth, captions))
    note = TRAINED_ON if not scene.test else "" if scene.test[0].hr_is_photo else OWN_PHOTO
    write_contact_sheet(folder / "contact_sheet.png", rows, title, note)


def _write_tables(
    folder: Path, history: Sequence[Mapping[str, float]], stages: Sequence[Mapping[str, str | int | float]]
) -> None:
    columns = list(dict.fromkeys(key for row in history for key in row))
    files.write_csv(folder / "history.csv", history, columns)
    shares = [c for prefix in ("conflict_", "corrected") for c in columns if c.startswith(prefix)]
    means = [c for c in ("mean_q", "mean_w", "mean_omega") if c in columns]
    compared = [row for row in history if "conflict" in row]
    files.write_csv(folder / "conflict.csv", compared, ["t", "conflict", *shares, *means])
    files.write_csv(
        folder / "timing.csv", stages, ["stage", "runs", "ms_each", "seconds", "skipped", "seconds_saved", "why"]
    )


def _two_stages(state: TrainState, history: Sequence[Mapping[str, float]]) -> list[dict[str, str | int | float]]:
    """Iterations and seconds of each stage of a method of two stages; the rows after them say what the seconds went to."""
    begins = state.density.marks.get(SECOND_STAGE)
    if begins is None or not history:
        return []
    first, whole = max((row["seconds"] for row in history if row["t"] < begins), default=0.0), history[-1]["seconds"]
    rows = ("first stage", begins - 1, first), (SECOND_STAGE, state.t - begins, whole - first)
    return [{"stage": name, "runs": runs, "seconds": round(seconds, 3)} for name, runs, seconds in rows]


def _mean_conflict(history: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Mean over the iterations that compared gradients, by group and, as "gaussian", for the Gaussian as a whole."""
    means = {"conflict_gaussian" if name == "conflict" else name: mean for name, mean in column_means(history).items()}
    prefix = "conflict_"
    return {name.removeprefix(prefix): mean for name, mean in means.items() if name.startswith(prefix)}
