"""Seconds until a variant is as good as the reference at its end: what is trained, and what is compared."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pandas as pd
import pytest

from clear_strategies.bench import seconds
from clear_strategies.bench.__main__ import main
from clear_strategies.bench.results import Results
from clear_strategies.errors import DataError

QUICK = "optim.scales=0.01"


def write_run(folder: Path, *probes: tuple[int, float, float]) -> None:
    """The files of a run that the benchmark reads; of each probe the iteration, the seconds until then and the PSNR."""
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps({"scene": "toy", "gaussians": 7}))
    (folder / "command.json").write_text(json.dumps({"seconds": 20.0, "processor_seconds": 40.0}))
    columns = "t,seconds,processor_seconds,probe_seconds,probe_processor_seconds,psnr_test"
    rows = [f"{t},{s},{2 * s},1,2,{psnr}" for t, s, psnr in probes]
    (folder / "history.csv").write_text("\n".join((columns, "1,0.5,1,,,", *rows)) + "\n")


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Trainings end at once: the reference with 20 dB after 10 s, the variant has it after 6 s and ends with 21."""
    found: list[str] = []

    def train(folder: Path, overrides: list[str]) -> str | None:
        if "optim.no=1" in overrides:
            return "no such key"
        found.append(overrides[-1] if QUICK in overrides else "reference")
        probes = ((50, 6.0, 20.5), (100, 12.0, 21.0)) if QUICK in overrides else ((50, 5.0, 19.0), (100, 10.0, 20.0))
        write_run(folder, *probes)
        return None

    monkeypatch.setattr(seconds, "train", train)
    return found


def measured(out: Path, *variants: tuple[str, ...]) -> Results:
    results = Results(lambda line: None, out)
    seconds.measure(results, overrides=(), variants=variants, scene=("toy",), seeds=(0,), probes=2)
    return results


def test_the_first_evaluation_that_has_the_target_counts(tmp_path, trained):
    results = measured(tmp_path, (), (QUICK,))
    turns, table = results.tables["seconds_turns"], results.tables["seconds"].set_index("variant")
    assert list(turns["reached"]) == [100, 50]
    assert list(turns["reached_training_s"]) == [10.0, 6.0]
    assert table.loc[QUICK, ["training", "of_run", "psnr_over"]].to_list() == pytest.approx([0.6, 0.6, 1.0])
    assert table.loc[seconds.DEFAULTS, "training"] == 1.0
    assert list(results.tables["seconds_probes"]["psnr"]) == [19.0, 20.0, 20.5, 21.0]
    (axis,) = results.figures["time_against_quality"].axes
    assert [list(line.get_xdata()) for line in axis.get_lines()[:2]] == [[5.0, 10.0], [6.0, 12.0]]
    assert [text.get_text() for text in axis.texts] == ["", "0", "", "0"]


def test_the_command_pays_for_all_but_the_evaluations_on_the_way(tmp_path):
    write_run(tmp_path / "run", (5, 2.0, 20.0), (9, 3.0, 19.0))
    row, _ = seconds.read(tmp_path / "run", 20.0)
    assert (row["reached"], row["command_s"], row["command_processor_s"]) == (5, 18.0, 36.0)
    assert (row["reached_command_s"], row["reached_command_processor_s"]) == (17.0, 34.0)
    never, _ = seconds.read(tmp_path / "run", 20.1)
    assert math.isnan(never["reached"])
    assert math.isnan(never["reached_command_s"])
    assert never["psnr"] == 19.0


def test_a_seed_that_never_has_the_target_is_counted(tmp_path):
    rows = []
    for variant, seed, s, psnr in (("a", 0, 10, 20.0), ("a", 1, 10, 20.0), ("b", 0, 5, 20.0), ("b", 1, 5, 19.0)):
        write_run(tmp_path / f"{variant}{seed}", (9, s, psnr))
        rows.append(seconds.read(tmp_path / f"{variant}{seed}", 20.0, variant=variant, seed=seed)[0])
    table = seconds.summary(pd.DataFrame(rows)).set_index("variant")
    assert list(table["seeds"]) == [2, 2]
    assert list(table["seeds_reached"]) == [2, 1]
    assert table.loc["b", "training"] == 0.5
    assert (table.loc["b", "psnr_over_low"], table.loc["b", "psnr_over_high"]) == (-1.0, 0.0)


def test_finished_trainings_are_kept_and_a_variant_that_fails_leaves_the_others(tmp_path, trained):
    measured(tmp_path, (), (QUICK,))
    results = measured(tmp_path, (), ("optim.no=1",), (QUICK,))
    assert trained == ["reference", QUICK]
    assert "no such key" in results.notes[0]
    assert len(results.tables["seconds"]) == 2
    with pytest.raises(DataError, match="no reference finished"):
        measured(tmp_path, ("optim.no=1",), ())


@pytest.mark.slow
def test_the_command_trains_a_tiny_demo_and_writes_its_tables(tmp_path, caplog, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "out"
    tiny = ["data.reader.width=64", "data.reader.height=48", "data.cloud.init=random", "fit.iterations=12"]
    asked = ["seconds", *tiny, "--variant", "--variant", "fit.iterations=6", "--seeds", "0", "--probes", "4"]
    assert main([*asked, "--out", str(out), "--threads", "1"]) == 0, caplog.text
    turns = pd.read_csv(out / "seconds_turns.csv").set_index("variant")
    assert dict(turns["iterations"]) == {"defaults": 12, "fit.iterations=6": 6}
    assert (turns["command_s"] > turns["training_s"]).all()
    assert turns.loc["defaults", "reached"] <= 12
    assert str(tmp_path) not in (out / "seconds.json").read_text()
    assert (out / "time_against_quality.png").stat().st_size > 10_000
