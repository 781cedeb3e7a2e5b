"""Finished runs are found, named and read; others are left out with a warning."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from clear_strategies import files, report
from clear_strategies.errors import DataError
from clear_strategies.outputs.baseline import overrides_of
from tests.helpers.finished_run import make_run, rows_of, scores


@pytest.mark.parametrize(
    ("overrides", "facts", "name"),
    [
        (["+strategy=baseline"], {}, "baseline"),
        (["+strategy=[gco,p2g]"], {}, "gco + p2g"),
        (["+strategy=clear_paper"], {"strategies": ["gco", "p2g", "svs"]}, "clear_paper"),
        ([], {"strategies": ["mine", "svs"]}, "mine + svs"),
        (["+strategy=clear", "+method=srgs"], {}, "srgs"),
    ],
    ids=["none", "list", "preset", "without overrides", "a method replaces"],
)
def test_a_run_is_named_by_its_strategies_as_given_on_the_command_line(tmp_path, overrides, facts, name):
    folder = make_run(tmp_path, *overrides, **facts, **({} if overrides else {"overrides": None}))
    run = report.Run.read(folder)
    assert (run.name, run.settings) == (name, ())


def test_runs_from_python_are_told_apart_as_those_of_the_command_line(tmp_path: Path) -> None:
    for iterations in (20, 60):
        chosen, folder = [f"fit.iterations={iterations}"], tmp_path / str(iterations)
        make_run(folder / "baseline", strategies=[], overrides=chosen, config={"of": chosen})
        make_run(folder, overrides=[*chosen, "+strategy=best"])
    for hydra in list(tmp_path.rglob(".hydra")):
        shutil.rmtree(hydra)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["baseline", "20", "baseline", "60"]
    assert [m for m in rows_of(tmp_path) if m.startswith("b") and "bicubic" not in m] == [
        "baseline, fit.iterations=20", "best, fit.iterations=20", "baseline, fit.iterations=60", "best, fit.iterations=60",
    ]  # fmt: skip


def test_runs_of_a_sweep_are_in_the_order_of_their_jobs(tmp_path: Path) -> None:
    for number, name in ((2, "a_clear"), (10, "b_more"), (0, "z_baseline")):
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}")
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["baseline", "clear", "more"]


def test_runs_that_are_linked_into_a_folder_belong_to_it_and_count_once(tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    ours = make_run(runs / "ours", "+strategy=gco")
    (runs / "latest").symlink_to(ours)
    (runs / "sweep").symlink_to(make_run(tmp_path / "disk" / "sweep" / "0", "+strategy=clear").parent)
    assert [run.name for run in report.collect([runs, ours, runs / ".." / "runs" / "ours"])] == ["gco", "clear"]


def test_damaged_and_unfinished_runs_are_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_run(tmp_path / "good", "+strategy=gco")
    (make_run(tmp_path / "truncated") / "metrics.json").write_text('{"scene": "de')
    (make_run(tmp_path / "list") / "metrics.json").write_text("[]")
    make_run(tmp_path / "no_scores", test={"mean": {"prior": scores(3.0)}})
    make_run(tmp_path / "wrong_type", gaussians="many")
    (tmp_path / "unfinished" / ".hydra").mkdir(parents=True)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["good"]
    for name in ("truncated", "list", "no_scores", "wrong_type", "unfinished"):
        (message,) = (r.getMessage() for r in caplog.records if str(tmp_path / name) in r.getMessage())
        assert "left out" in message
        assert "\n" not in message


def make_pair(folder: Path, *overrides: str, baseline: float = 20.0, seed: int = 0, **facts: Any) -> Path:
    """A run of clear with its baseline beside it."""
    config = {"fit.seed": seed, "of": str(overrides)}
    beside = make_run(
        folder / "baseline", *overrides_of(overrides), psnr=baseline, strategies=[], seed=seed, config=config
    )
    shutil.rmtree(beside / ".hydra")
    return make_run(folder, "+strategy=clear", *overrides, seed=seed, config={**config, "strategies": "clear"}, **facts)


def test_a_baseline_beside_a_run_is_a_row_of_its_own_before_it(tmp_path: Path) -> None:
    own = ("strategies.gco.tolerance=0.1", "~strategies.p2g", "fit.iterations=50", "fit.baseline=true")
    make_pair(tmp_path / "run", *own, psnr=20.5)
    baseline, ours = report.collect([tmp_path / "run"])
    assert (baseline.name, baseline.settings) == ("baseline", ("fit.iterations=50",))
    assert (ours.name, ours.settings) == ("clear", own[:-1])
    rows = report.compare([baseline, ours]).query("not baseline")
    assert list(rows["name"]) == ["baseline", "clear"]
    assert list(rows["psnr_delta"]) == [0.0, pytest.approx(0.5)]


def test_the_same_baseline_beside_several_runs_counts_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        make_pair(tmp_path / name, seed=seed)
    runs = report.collect([tmp_path])
    assert [(run.name, run.seed) for run in runs] == [
        ("baseline", 0), ("clear", 0), ("clear", 0), ("baseline", 1), ("clear", 1),
    ]  # fmt: skip
    assert (
        f"{tmp_path / 'b' / 'baseline'}: left out, it is the same training as {tmp_path / 'a' / 'baseline'}"
        in caplog.text
    )


def test_a_baseline_run_on_its_own_counts_instead_of_one_beside_a_run(tmp_path: Path) -> None:
    make_pair(tmp_path / "clear", baseline=20.0)
    make_run(tmp_path / "baseline", "+strategy=baseline", psnr=20.0, strategies=[], config={"fit.seed": 0, "of": "()"})
    runs = report.collect([tmp_path / "baseline", tmp_path / "clear"])
    assert [run.folder for run in runs] == [tmp_path / "baseline", tmp_path / "clear"]
    make_run(tmp_path / "baseline", "+strategy=baseline", strategies=[], config={"fit.seed": 0, "of": "another"})
    assert len(report.collect([tmp_path / "baseline", tmp_path / "clear"])) == 3


def test_a_finished_baseline_beside_an_unfinished_run_counts_and_without_any_the_folder_is_refused(tmp_path, caplog):
    (make_pair(tmp_path / "run") / "metrics.json").unlink()
    assert [run.name for run in report.collect([tmp_path])] == ["baseline"]
    assert f"{tmp_path / 'run'}: left out, it has no metrics.json" in caplog.text
    (tmp_path / "run" / "baseline" / "metrics.json").unlink()
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])
