"""A run and the baseline beside it: what trains, what is resumed, and when there is none."""

from __future__ import annotations

import json
import logging
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hydra.core.hydra_config import HydraConfig

from clear_strategies.data.scene import Scene
from clear_strategies.errors import DataError
from clear_strategies.jobs import job, scene
from clear_strategies.outputs.score_table import OURS_MINUS_BASELINE
from clear_strategies.training import loop
from clear_strategies.training.signals import Interrupted
from tests.helpers import pictures
from tests.helpers.command_line import TINY
from tests.helpers.configs import composed

ITERATIONS = 12
SLOW = pytest.mark.slow
SMALL = [o for o in TINY if not o.startswith("fit.baseline")]
SMALL += ["fit.probe_every=0", "fit.checkpoint_every=0", "fit.threads=1", "prior=bicubic"]


@pytest.fixture(scope="module", autouse=True)
def short() -> Iterator[None]:
    """Reading the same scene again takes most of the time of a short run without pictures."""
    scenes: list[Scene] = []
    load = scene.load

    def load_once(*settings: Any) -> Scene:
        if not scenes:
            scenes.append(load(*settings))
        return scenes[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "load", load_once)
        with pictures.not_drawn():
            yield


@pytest.fixture(autouse=True)
def logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)


def train(
    folder: Path, *overrides: str, strategy: str = "gco", watch: Callable[[], None] = lambda: None
) -> float | None:
    """Run a job; `watch` is called after each iteration."""
    chosen = [f"+strategy={strategy}", "fit.baseline=true", *SMALL, *overrides]

    def iterate(*arguments: Any, step: Callable[..., object] = loop.iterate) -> object:
        update = step(*arguments)
        watch()
        return update

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop, "iterate", iterate)
        return job.run(composed(*chosen), folder, chosen)


class Iterations:
    """Counts iterations, and stops a job after some."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.done, self.stop_after = 0, stop_after

    def __call__(self) -> None:
        self.done += 1
        if self.done == self.stop_after:
            signal.raise_signal(signal.SIGINT)


def stopped(folder: Path, after: int) -> Interrupted:
    with pytest.raises(Interrupted) as told:
        train(folder, watch=Iterations(after))
    return told.value


def field(folder: Path) -> bytes:
    return (folder / "point_cloud.ply").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with its baseline, undisturbed."""
    folder = tmp_path_factory.mktemp("whole")
    train(folder)
    return folder


@pytest.fixture(scope="module")
def cut(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int, Path], Interrupted]:
    """Copies the folder of a run that was stopped after some iterations, which is trained once, to another."""
    runs: dict[int, tuple[Path, Interrupted]] = {}

    def copy(after: int, to: Path) -> Interrupted:
        if after not in runs:
            folder = tmp_path_factory.mktemp("cut")
            runs[after] = folder, stopped(folder, after)
        folder, told = runs[after]
        shutil.copytree(folder, to)
        return told

    return copy


@pytest.mark.slow
def test_the_baseline_is_the_run_without_strategies_on_the_same_scene(whole, tmp_path, monkeypatch, caplog):
    loads = []
    prepare = scene.load
    monkeypatch.setattr(scene, "load", lambda *arguments: loads.append(arguments) or prepare(*arguments))
    watch = Iterations()
    psnr = train(tmp_path / "run", watch=watch)
    assert (len(loads), watch.done) == (1, 2 * ITERATIONS)
    train(tmp_path / "alone", strategy="baseline")
    baseline, alone = (json.loads((tmp_path / f / "metrics.json").read_text()) for f in ("run/baseline", "alone"))
    assert field(tmp_path / "run" / "baseline") == field(tmp_path / "alone") == field(whole / "baseline")
    assert baseline["config"] == alone["config"]
    assert (baseline["strategies"], baseline["baseline"]) == ([], None)
    ours = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert ours["test"]["mean"]["ours"]["psnr"] == psnr
    assert ours["baseline"]["test"] == baseline["test"]["mean"]["ours"]
    assert OURS_MINUS_BASELINE in caplog.text
    plan, first, done = (caplog.text.index(words) for words in ("initial points", "trains first", "done in"))
    assert plan < first < done


def test_a_run_is_the_same_with_and_without_its_baseline_which_has_its_other_overrides(whole, tmp_path):
    train(tmp_path, "fit.baseline=false")
    assert field(tmp_path) == field(whole)
    assert not (tmp_path / "baseline").exists()
    ours, beside = (json.loads((whole / f / "metrics.json").read_text())["overrides"] for f in (".", "baseline"))
    assert (ours[0], ours[1:]) == ("+strategy=gco", beside)


@pytest.mark.parametrize("after", [5, ITERATIONS + 5], ids=["in its baseline", "after its baseline"])
@pytest.mark.parametrize("leads_to", ["auto", *(pytest.param(s, marks=SLOW) for s in ("run", "folder", "checkpoint"))])
def test_a_run_that_was_stopped_goes_on_where_it_stopped(whole, cut, tmp_path, after, leads_to, caplog):
    told, run = cut(after, tmp_path / "cut"), tmp_path / "cut"
    assert told.exit_code == 128 + signal.SIGINT
    trained = list(run.rglob("metrics.json"))
    assert trained == ([run / "baseline" / "metrics.json"] if after > ITERATIONS else [])
    stopped_in = run if trained else run / "baseline"
    (saved,) = (stopped_in / "checkpoints").iterdir()
    assert re.search(rf"fit\.resume=\S*{saved.relative_to(run)}", str(told))
    paths = {"auto": "auto", "run": run, "folder": saved.parent if trained else stopped_in, "checkpoint": saved}
    folder, watch = tmp_path / ("cut" if leads_to == "auto" else "resumed"), Iterations()
    train(folder, f"fit.resume={paths[leads_to]}", watch=watch)
    assert watch.done == 2 * ITERATIONS - after
    assert trained or "5 iterations are done" in caplog.text
    assert field(folder / "baseline") == field(whole / "baseline")
    assert field(folder) == field(whole)


def test_a_run_without_a_baseline_that_is_resumed_with_one_trains_it(whole, tmp_path):
    with pytest.raises(Interrupted):
        train(tmp_path, "fit.baseline=false", watch=Iterations(5))
    watch = Iterations()
    train(tmp_path, "fit.resume=auto", watch=watch)
    assert watch.done == ITERATIONS + ITERATIONS - 5
    assert field(tmp_path) == field(whole)


@pytest.mark.parametrize(("where", "problem"), [("nowhere", "no checkpoint is here"), ("other", "tolerance")])
def test_what_cannot_be_resumed_is_refused_before_the_baseline_trains(tmp_path, where, problem):
    if where == "other":
        train(tmp_path / "other", "fit.baseline=false", "strategies.gco.tolerance=0.1")
    watch = Iterations()
    with pytest.raises(DataError, match=problem):
        train(tmp_path / "run", f"fit.resume={tmp_path / where}", watch=watch)
    assert watch.done == 0


def test_the_metrics_of_an_earlier_run_go_before_the_baseline_trains(tmp_path, caplog):
    (tmp_path / "metrics.json").write_text("{}")
    stopped(tmp_path, 5)
    assert not (tmp_path / "metrics.json").exists()
    assert "of an earlier run" in caplog.text


def test_a_run_that_starts_anew_removes_the_baseline_of_an_earlier_one(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    train(tmp_path / "run", "fit.baseline=false", "fit.iterations=3")
    assert not (tmp_path / "run" / "baseline" / "metrics.json").exists()
    assert not (tmp_path / "run" / "baseline" / "renders").exists()


@pytest.mark.parametrize(
    ("overrides", "why"),
    [(["+method=srgs"], "since +method=srgs is one itself"), (["~strategies.gco"], "since it has no strategy")],
)
def test_what_is_a_baseline_itself_trains_none(tmp_path, overrides, why, caplog):
    train(tmp_path, *overrides)
    assert why in caplog.text
    assert not (tmp_path / "baseline").exists()


def test_the_jobs_of_a_sweep_train_none(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    HydraConfig.instance().set_config(composed("hydra.mode=MULTIRUN", "hydra.job.num=0", hydra=True))
    with caplog.at_level("DEBUG"):
        train(tmp_path)
    assert "since it is a job of a sweep" in caplog.text
    assert not (tmp_path / "baseline").exists()


def test_the_demo_trains_it_and_other_data_do_not():
    trained = {data: composed(f"data={data}").fit.baseline for data in ("demo", "llff", "colmap", "photos")}
    assert trained == {"demo": True, "llff": False, "colmap": False, "photos": False}


def test_a_setting_of_density_has_no_effect_beside_a_strategy_that_densifies(tmp_path, caplog):
    unscaled = ["fit.scale_schedule=false", "fit.baseline=false", "density.every=50"]
    train(tmp_path / "mcmc", *unscaled, strategy="mcmc")
    assert caplog.text.count("density.every=50 has no effect: MCMC densifies in place of it.") == 1
    train(tmp_path / "gco", *unscaled)
    assert caplog.text.count("has no effect: MCMC") == 1
