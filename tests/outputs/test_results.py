"""A finished run writes the files that docs/reference/files.md lists, metrics.json last; a file is whole or as it was before."""

import csv
import json
import math
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest

from clear_strategies import GCO, P2G, Objective, View, files
from clear_strategies.data.ply import read_gaussians
from clear_strategies.data.scene import Scene
from clear_strategies.outputs import results
from clear_strategies.outputs.figures import magnification, write_contact_sheet
from clear_strategies.outputs.metrics import Evaluation
from clear_strategies.outputs.plan import Chosen
from clear_strategies.outputs.results import write_results
from clear_strategies.schedules import WarmupDecay
from clear_strategies.training.loop import iterate
from clear_strategies.training.state import TrainState
from clear_strategies.viewing.cameras import write_cameras
from clear_strategies.viewing.look import Painter
from tests.helpers import toy
from tests.helpers.image_files import holds, read

OBJECTIVE = Objective(lambda_hr=WarmupDecay(start=0, full=1), kernels="torch")
SCENE = toy.scene()


@pytest.fixture(scope="module")
def state() -> TrainState:
    state = toy.started(GCO(), P2G(), objective=OBJECTIVE, iterations=3)
    for _ in range(3):
        iterate(state, toy.RASTERIZER)
    return state


def write(folder: Path, state: TrainState, *, scene: Scene = SCENE, map_views: int = 0, video: int = 0) -> Evaluation:
    state = replace(state, settings=replace(state.settings, map_views=map_views, video=video))
    return write_results(
        folder, scene, state, Painter(state.field, lambda **_: toy.RASTERIZER), Chosen(None, ["gco", "p2g"]),
        backend="torch", down="bicubic", seconds=1.5, config={"fit.seed": 0}, antialiased=False,
    )  # fmt: skip


def names(folder: Path) -> set[str]:
    return {path.name + "/" * path.is_dir() for path in folder.iterdir()}


def test_conflict_csv_holds_columns_of_history_csv_and_the_ply_says_how_it_was_drawn(tmp_path, state) -> None:
    evaluation = write(tmp_path, state)
    history, conflict = (
        list(csv.DictReader((tmp_path / f"{name}.csv").open(newline=""))) for name in ("history", "conflict")
    )
    assert conflict == [{column: row[column] for column in conflict[0]} for row in history]
    assert {"t", "conflict", "conflict_means", "corrected", "mean_q", "mean_w"} <= set(conflict[0])
    mean = sum(float(row["conflict"]) for row in conflict) / len(conflict)
    content = json.loads((tmp_path / "metrics.json").read_text())
    assert content["conflict"]["gaussian"] == pytest.approx(mean)
    assert content["test"]["mean"]["ours"] == msgspec.to_builtins(evaluation.test.mean["ours"])
    assert (content["scene"], content["config"]) == ("toy", {"fit.seed": 0})
    assert not read_gaussians(tmp_path / "point_cloud.ply").antialiased


def test_without_test_views_training_views_are_shown_and_what_cannot_be_written_is_missing(
    tmp_path, state, monkeypatch, caplog
):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    scene = replace(SCENE, test=(), train=SCENE.train * 2)
    without_loss = lambda path, *of: write_contact_sheet(path.with_suffix(".png"), *of)  # noqa: E731
    monkeypatch.setattr(results, "write_contact_sheet", without_loss)
    with caplog.at_level("DEBUG"):
        write(tmp_path, state, scene=scene, video=2)
    assert names(tmp_path / "renders") == {f"{view.name}.png" for view in SCENE.train}
    times = round(magnification(*SCENE.train[0].hr.image.shape[:2]))
    sheet, image = read(tmp_path / "contact_sheet.png"), SCENE.train[0].hr.image.numpy()
    corners = image[:16, :24], image[-16:, -24:]
    assert any(holds(sheet, corner, times=times) for corner in corners)  # an outline crosses one at most
    assert "pip install imageio-ffmpeg" in caplog.text
    assert not names(tmp_path) & {"maps/", "path.mp4"}


def test_a_strategy_that_fails_in_the_maps_loses_them_and_nothing_else(tmp_path, state, monkeypatch, caplog):
    def fails(*_: object) -> None:
        raise ZeroDivisionError("of a\nstrategy")

    monkeypatch.setattr(results, "write_maps", fails)
    write(tmp_path, state, map_views=1)
    assert {"metrics.json", "point_cloud.ply", "contact_sheet.jpg"} <= names(tmp_path)
    assert "maps: left out, ZeroDivisionError: of a strategy" in caplog.text


TWINS = {
    ("left/0000.png", "right/0000.png"): {"left_0000", "right_0000"},
    ("0000.jpg", "0000.png"): {"0000.jpg", "0000.png"},
    ("A.jpg", "a.jpg"): {"A.jpg", "a.jpg_"},  # on a disk that ignores case
    ("a/0.jpg", "a_0.jpg"): {"a_0.jpg", "a_0.jpg_"},
}


@pytest.mark.parametrize("rig", TWINS)
def test_photos_with_similar_names_have_files_of_their_own_that_go_together(rig, tmp_path, state, monkeypatch):
    for name in ("write_curves", "write_contact_sheet"):
        monkeypatch.setattr(results, name, lambda *_: None)
    views = tuple(replace(view, name=name) for view, name in zip(SCENE.train, rig, strict=False))
    scene = replace(SCENE, train=views, test=views)
    monkeypatch.setattr(state, "views", views)
    write(tmp_path, state, scene=scene, map_views=2)
    write_cameras(tmp_path, scene)
    stems = TWINS[rig]
    assert names(tmp_path / "renders") == {f"{stem}.png" for stem in stems}
    assert {name.rpartition("_")[0] for name in names(tmp_path / "views")} == stems
    assert names(tmp_path / "maps") == {"maps.json", *(f"{stem}/" for stem in stems)}
    results.remove_earlier(tmp_path, all_files=True)
    assert names(tmp_path) == set()


def test_an_earlier_run_goes_with_all_of_its_files_and_no_other(tmp_path: Path, state: TrainState) -> None:
    write(tmp_path, state, map_views=1)
    write_cameras(tmp_path, SCENE)
    kept = {tmp_path / "notes.txt", tmp_path / "renders" / "measured.png", tmp_path / "checkpoints" / "step_0000004"}
    for path in kept:
        files.write_text(path, "mine")
    results.remove_earlier(tmp_path, all_files=True)
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == kept
    assert names(tmp_path) == {"notes.txt", "renders/", "checkpoints/"}
    for name in ("metrics.json", "curves.png"):  # of another program
        files.write_text(tmp_path / "other" / name, "{}")
    results.remove_earlier(tmp_path / "other", all_files=True)
    assert names(tmp_path / "other") == {"curves.png"}


def test_the_sheet_of_photos_at_hr_shows_no_sr(tmp_path, state, monkeypatch):
    def photos(view: View) -> View:
        return replace(view, hr=replace(view.hr, image=view.truth), truth=None, hr_is_photo=True)

    sheets: list[Any] = []
    monkeypatch.setattr(results, "write_curves", lambda *_: None)
    monkeypatch.setattr(results, "write_contact_sheet", lambda path, rows, title, note: sheets.append((rows, note)))
    scene = replace(SCENE, train=tuple(map(photos, SCENE.train)), test=tuple(map(photos, SCENE.test)))
    write(tmp_path, state, scene=scene)
    (((row,), note),) = sheets
    assert list(row.images) == ["ours", "ground truth", "error of ours"]
    assert note == ""


def test_metrics_json_is_missing_where_another_file_could_not_be_written(tmp_path, state, monkeypatch):
    def full(*arguments: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "write_curves", full)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path, state)
    assert not (tmp_path / "metrics.json").exists()


# ---- a file is whole or as it was before; numbers that JSON does not have become null
def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    target = tmp_path / "results.json"
    files.write_text(target, "old")

    def interrupted(descriptor: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        files.write_text(target, "new")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_processes_of_one_number_folders_and_long_names_are_no_error(tmp_path: Path) -> None:
    with files.replacing(tmp_path / "sr.png") as first, files.replacing(tmp_path / "sr.png") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "sr.png").read_text() == "first"  # the context that ends last
    assert list(tmp_path.iterdir()) == [tmp_path / "sr.png"]
    target = tmp_path / "a" / "b" / f"{'ω' * 125}.txt"  # the longest that a disk takes
    files.write_text(target, "1")
    files.write_text(target, "ω̃ = 2")
    assert target.read_text(encoding="utf-8") == "ω̃ = 2"
    assert list(target.parent.iterdir()) == [target]
    with pytest.raises(OSError, match="No such file") as failed, files.replacing(target) as partial:
        partial.read_bytes()
    assert failed.value.filename == str(target)  # not the part, which is gone


@pytest.mark.parametrize("held_for", [0.1, 30])
@pytest.mark.parametrize("system", ["win32", "linux"])
def test_a_file_that_a_virus_scanner_holds_is_replaced_as_soon_as_it_lets_go(held_for, system, tmp_path, monkeypatch):
    target, replace_file = tmp_path / "a.json", Path.replace
    freed = time.monotonic() + held_for

    def held(self: Path, to: Path) -> Path:
        if time.monotonic() < freed:
            raise PermissionError(13, "Access is denied", str(self))
        return replace_file(self, to)

    files.write_text(target, "old")
    monkeypatch.setattr(files.Path, "replace", held)
    monkeypatch.setattr(files.sys, "platform", system)
    waits = system == "win32" and held_for < 1
    with nullcontext() if waits else pytest.raises(PermissionError, match=r"a\.json"):
        files.write_text(target, "new")
    assert target.read_text() == ("new" if waits else "old")
    assert names(tmp_path) == {"a.json"}


def test_json_has_null_where_a_number_is_not_finite(tmp_path: Path) -> None:
    value = {"a": [math.nan, 1.5, (math.inf,)], "b": {"c": -math.inf, 3: "λ"}}
    files.write_json(tmp_path / "v.json", value)
    assert json.loads((tmp_path / "v.json").read_text(encoding="utf-8")) == {
        "a": [None, 1.5, [None]],
        "b": {"c": None, "3": "λ"},
    }
