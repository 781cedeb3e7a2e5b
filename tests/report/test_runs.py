"""Finished runs are found, named and read; others are left out with a warning."""

from __future__ import annotations

from pathlib import Path

import pytest

from clear_strategies import files, report
from clear_strategies.errors import DataError
from tests.helpers.finished_run import make_run, rows_of, scores


def test_a_run_is_named_by_its_strategies_as_given_on_the_command_line(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=baseline", strategies=[])
    make_run(tmp_path / "1", "+strategy=[gco,p2g]", strategies=["gco", "p2g"])
    make_run(tmp_path / "2", "+strategy=clear_paper", strategies=["gco", "p2g", "svs"])
    bare = make_run(tmp_path / "3", strategies=["mine", "svs"])
    (bare / ".hydra" / "overrides.yaml").unlink()
    assert {"baseline", "gco + p2g", "clear_paper", "mine + svs"} <= set(rows_of(tmp_path))


def test_a_method_replaces_the_strategies_before_it(tmp_path: Path) -> None:
    run = report.Run.read(make_run(tmp_path / "run", "+strategy=clear", "+method=srgs"))
    assert run.name == "srgs"


def test_runs_of_a_sweep_are_in_the_order_of_their_jobs(tmp_path: Path) -> None:
    for number, name in ((2, "a_clear"), (10, "b_more"), (0, "z_baseline")):
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}")
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["baseline", "clear", "more"]


def test_damaged_and_unfinished_runs_are_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    make_run(tmp_path / "good", "+strategy=gco")
    (make_run(tmp_path / "truncated") / "metrics.json").write_text('{"scene": "de')
    (make_run(tmp_path / "list") / "metrics.json").write_text("[]")
    make_run(tmp_path / "no_scores", test={"mean": {"prior": scores(3.0)}})
    make_run(tmp_path / "wrong_type", gaussians="many")
    (make_run(tmp_path / "bad_yaml") / ".hydra" / "overrides.yaml").write_text("- [a\n")
    (tmp_path / "unfinished" / ".hydra").mkdir(parents=True)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["good"]
    for name in ("truncated", "list", "no_scores", "wrong_type", "bad_yaml", "unfinished"):
        (message,) = (r.getMessage() for r in caplog.records if str(tmp_path / name) in r.getMessage())
        assert "left out" in message
        assert "\n" not in message


def test_a_run_given_twice_counts_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    assert len(report.collect([tmp_path, tmp_path / "0", tmp_path / "0" / ".." / "0"])) == 1


def test_a_folder_without_runs_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])
