"""A file is data: whatever the files of a run or of a capture name, nothing of it is imported, called or looked up."""

import contextlib
import json
import math
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import safetensors.torch
import torch
from omegaconf import OmegaConf
from safetensors import safe_open

import clear_strategies
from clear_strategies import report
from clear_strategies.commands import export, render
from clear_strategies.compose import tree
from clear_strategies.data.ply import read_points
from clear_strategies.data.readers import blender, nerfstudio
from clear_strategies.errors import ClearError, DataError, SettingError
from clear_strategies.jobs import job, resume
from clear_strategies.jobs.saved import open_splat
from clear_strategies.notebook import Run
from clear_strategies.outputs import metrics
from clear_strategies.outputs.results import export_ply
from clear_strategies.settings import flat
from clear_strategies.training import checkpoint
from clear_strategies.viewing.cameras import read_cameras, write_cameras
from rasterizers.reference import ReferenceRasterizer
from tests.helpers import captures, finished_run, forked
from tests.helpers.command_line import TINY
from tests.helpers.configs import composed
from tests.helpers.short_run import SCENE, start


class Theirs(ReferenceRasterizer):
    """Another package's rasterizer."""


THEIRS = f"{__name__}.Theirs"


@dataclass(frozen=True)
class Trap:
    """What a file names, and the folder in which each of it leaves a file if it is called, imported or resolved."""

    sprung: Path

    @property
    def call(self) -> dict[str, str]:
        return {"_target_": "os.system", "command": f"touch {self.sprung}/called"}

    imported = "a_trap.Rasterizer"
    resolved = "${a_trap:}"


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Trap]:
    sprung, modules = tmp_path / "sprung", tmp_path / "modules"
    sprung.mkdir()
    modules.mkdir()
    code = f"from pathlib import Path\nPath({str(sprung)!r}, 'imported').touch()\nclass Rasterizer: ...\n"
    (modules / "a_trap.py").write_text(code)
    monkeypatch.syspath_prepend(modules)
    monkeypatch.delitem(sys.modules, "a_trap", raising=False)
    OmegaConf.register_new_resolver("a_trap", (sprung / "resolved").touch)
    yield Trap(sprung)
    OmegaConf.clear_resolver("a_trap")


def poisons(trap: Trap) -> dict[str, Any]:
    """What a configuration of dotted keys may hold of the trap, one at a time."""
    return {
        "rasterizer.kernel": trap.call,
        "rasterizer": trap.call,
        "rasterizer.background": [trap.call],
        "rasterizer._target_": trap.imported,
        "strategies.gco._target_": trap.imported,
        "rasterizer.preset": trap.resolved,
        "rasterizer.name": trap.resolved,
        "fit.resume": [[trap.call, trap.resolved]],
    }


Poisoned = Callable[[Path, Trap], Iterator[None]]
"""Writes a file anew for each thing that it may name, and yields after each."""


def in_checkpoint(folder: Path, trap: Trap) -> Iterator[None]:
    saved = checkpoint.load(folder)
    for key, value in poisons(trap).items():
        checkpoint.save(folder / "checkpoints", replace(saved, config={"rasterizer.name": "torch", key: value}))
        yield


def in_metadata(folder: Path, trap: Trap) -> Iterator[None]:
    (path,) = (folder / "checkpoints").iterdir()
    tensors, metadata = safetensors.torch.load_file(path), safe_open(path, "pt").metadata()
    for value in (json.dumps(trap.call), trap.imported, trap.resolved):
        for key in ("_target_", *metadata):
            path.write_bytes(safetensors.torch.save(tensors, {**metadata, key: value}))
            yield


def in_metrics(folder: Path, trap: Trap) -> Iterator[None]:
    for key, value in poisons(trap).items():
        said = {"config": {key: value}, "provenance": {"date": trap.call}, "scene": trap.resolved}
        finished_run.make_run(folder, f"+rasterizer={trap.resolved}", **said)
        (folder / ".hydra" / "config.yaml").write_text(OmegaConf.to_yaml({"rasterizer": trap.call}))
        (folder / ".hydra" / "hydra.yaml").write_text(OmegaConf.to_yaml({"hydra": {"job": trap.call}}))
        yield


def in_json(name: str) -> Poisoned:
    """Each value of the file and of its first entry, and a key besides."""

    def table_of(content: Any, *, of_entry: bool) -> dict[str, Any]:
        entries = content if isinstance(content, list) else content["frames"]
        return entries[0] if of_entry or isinstance(content, list) else content

    def poison(folder: Path, trap: Trap) -> Iterator[None]:
        text = (folder / name).read_text()
        for of_entry in (False, True):
            for key in (*table_of(json.loads(text), of_entry=of_entry), "_target_"):
                for value in (trap.call, trap.imported, trap.resolved):
                    content = json.loads(text)
                    table_of(content, of_entry=of_entry)[key] = value
                    (folder / name).write_text(json.dumps(content))
                    yield

    return poison


def in_ply(folder: Path, trap: Trap) -> Iterator[None]:
    data = (folder / "point_cloud.ply").read_bytes()
    for text in (json.dumps(trap.call), trap.imported, trap.resolved):
        for old, new in ((b"ply\n", f"ply\ncomment {text}\n"), (b"property float x", f"property {text} x")):
            (folder / "point_cloud.ply").write_bytes(data.replace(old, new.encode(), 1))
            yield


def in_history(folder: Path, trap: Trap) -> Iterator[None]:
    pd.DataFrame([{"t": json.dumps(trap.call), "loss": trap.resolved}]).to_csv(folder / "history.csv")
    yield


def resumed(folder: Path) -> None:
    saved = checkpoint.load(folder)
    resume.restore(start(()), SCENE, saved, folder)


def finished(folder: Path) -> None:
    assert resume.finished(folder, metrics.read(folder / "metrics.json", "").config, lambda: SCENE)


READERS: dict[str, tuple[Poisoned, Callable[[Path], object]]] = {
    "checkpoint, opened": (in_checkpoint, open_splat),
    "checkpoint, rendered": (in_checkpoint, lambda run: render.main([str(run), "--path", "train", "--width", "8"])),
    "checkpoint, exported": (in_checkpoint, lambda run: export.main([str(run)])),
    "checkpoint, resumed": (in_checkpoint, resumed),
    "metadata": (in_metadata, open_splat),
    "metrics, reported": (in_metrics, finished_run.table_of),
    "metrics, resumed": (in_metrics, finished),
    "metrics, in Python": (in_metrics, lambda run: Run(run).metrics),
    "cameras.json": (in_json("cameras.json"), lambda run: read_cameras(run / "cameras.json")),
    "transforms.json": (in_json("transforms.json"), lambda run: nerfstudio.read(str(run))),
    "transforms_train.json": (in_json("transforms_train.json"), lambda run: blender.read(str(run))),
    "PLY, opened": (in_ply, lambda run: open_splat(run / "point_cloud.ply")),
    "PLY, points": (in_ply, lambda run: read_points(run / "point_cloud.ply")),
    "history.csv": (in_history, report.runs.history),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    """A finished run and a capture, in one folder, with all files that a reader may find there."""
    folder = tmp_path_factory.mktemp("files") / "run"
    state = start(())
    checkpoint.save(folder / "checkpoints", state.checkpoint({"rasterizer.name": "torch"}))
    export_ply(folder / "point_cloud.ply", state.field)
    write_cameras(folder, SCENE)
    finished_run.make_run(folder)
    shutil.copytree(captures.demo_on_disk(folder.parent / "photos"), folder, dirs_exist_ok=True)
    captured = json.loads((folder / "transforms.json").read_text())
    angle = 2 * math.atan(captured["w"] / 2 / captured["fl_x"])
    of_blender = {"camera_angle_x": angle, "frames": captured["frames"]}
    for split in ("train", "test"):
        (folder / f"transforms_{split}.json").write_text(json.dumps(of_blender))
    return folder


@pytest.mark.parametrize("reader", READERS)
def test_no_reader_of_files_calls_imports_or_resolves_what_they_name(reader, files, trap, tmp_path) -> None:
    folder, (poison, read) = shutil.copytree(files, tmp_path / "run"), READERS[reader]
    read(folder)  # as it is, it can be read
    for _ in poison(folder, trap):
        with contextlib.suppress(ClearError):
            read(folder)
        assert list(trap.sprung.iterdir()) == []


def test_the_trap_works(trap) -> None:
    """What the readers must not do leaves a file."""
    clear_strategies.settings.build(trap.call)
    __import__("a_trap")
    OmegaConf.to_container(OmegaConf.create({"a": trap.resolved}), resolve=True)
    assert sorted(path.name for path in trap.sprung.iterdir()) == ["called", "imported", "resolved"]


@pytest.mark.parametrize("value", [{"_target_": "os.system"}, [{"a": 1}], [[0, [{}]]]])
def test_a_table_in_the_configuration_of_a_file_is_refused_by_its_key(value, saved_run, tmp_path) -> None:
    saved = replace(checkpoint.load(saved_run[0]), config={"fit.seed": 1, "rasterizer.kernel": value})
    path, rule = checkpoint.save(tmp_path, saved), r": config\.rasterizer\.kernel: must be a number, text, true, false"
    with pytest.raises(DataError, match=f"{path}{rule}"):
        checkpoint.load(path)
    run = finished_run.make_run(tmp_path / "run", config={"rasterizer.kernel": value})
    with pytest.raises(DataError, match=f"metrics.json{rule}"):
        metrics.read(run / "metrics.json", "")


def test_a_configuration_of_tables_in_lists_is_saved_without_tables() -> None:
    config = {"a": {"b": [1, "two"], "c": [{"_target_": "x.Y", "d": [3]}, [4, 5]]}}
    assert flat(config) == {"a.b": [1, "two"], "a.c.0._target_": "x.Y", "a.c.0.d": [3], "a.c.1": [4, 5]}


def drawn_by(folder: Path, rasterizer: str | None = None) -> type:
    return type(open_splat(folder, rasterizer).painter.rasterizer)


def test_the_class_of_a_file_draws_if_an_installed_package_or_the_command_names_it(
    saved_run, tmp_path, monkeypatch, caplog
) -> None:
    saved = checkpoint.load(saved_run[0])
    config = {"rasterizer._target_": THEIRS, "rasterizer.kernel": 0.25, "rasterizer.lanes": 4096}
    checkpoint.save(tmp_path / "checkpoints", replace(saved, config=config))
    shared = open_splat(tmp_path).painter.rasterizer
    assert (type(shared) is Theirs, shared.kernel) == (False, 0.25)
    assert f"--rasterizer {THEIRS} draws with it" in caplog.text
    named = open_splat(tmp_path, THEIRS).painter.rasterizer
    assert (type(named), named.kernel, named.lanes) == (Theirs, 0.25, 4096)
    monkeypatch.setattr("clear_strategies.jobs.saved.options", lambda group: {"theirs": {"_target_": THEIRS}})
    assert drawn_by(tmp_path) is Theirs
    assert drawn_by(tmp_path, "torch") is ReferenceRasterizer
    with pytest.raises(SettingError, match=r"rasterizer: nowhere\.Mine cannot be imported"):
        open_splat(tmp_path, "nowhere.Mine")


def test_a_run_with_classes_that_the_users_command_names_is_resumed(tmp_path, caplog) -> None:
    caplog.set_level("INFO")
    words = [*TINY, "prior=bicubic", "fit.threads=1", "fit.iterations=4", f"rasterizer._target_={THEIRS}"]
    with forked.not_drawn():
        job.run(composed(*words), tmp_path, words)
        (tmp_path / "metrics.json").unlink()
        job.run(composed(*words, "fit.resume=auto"), tmp_path, words)
    assert "resumed from" in caplog.text
    assert drawn_by(tmp_path, THEIRS) is Theirs
    assert torch.is_tensor(Run(tmp_path, THEIRS).render())
    other = resume.comparable(tree(composed(*words[:-1])))
    with pytest.raises(DataError, match=r"rasterizer\._target_: "):
        resume.found(str(tmp_path), tmp_path, other)
