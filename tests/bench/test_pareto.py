"""Seconds against quality of whole trainings: what is trained, what is compared, and what is kept."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from hydra import compose, initialize_config_dir

from clear_strategies.bench import pareto, plots
from clear_strategies.bench.__main__ import main
from clear_strategies.bench.device import TINY
from clear_strategies.bench.pareto import BASE, VARIANTS
from clear_strategies.bench.results import Results
from clear_strategies.compose import CONF
from clear_strategies.errors import DataError

BY_NAME = {variant.name: variant for variant in VARIANTS}
REQUEST = pareto.Request((), (0, 1), 100, Path("out"), tuple(BY_NAME))


def write_run(folder: Path, *, psnr: float, seed: int, seconds: float) -> None:
    """The files of a run that the benchmark reads."""
    scores = {"psnr": psnr, "ssim": 0.5, "gmsd": 0.1, "blur": 0.0}
    part = {"against": "HR photos", "views": {}, "mean": {"ours": scores}}
    content = {
        "scene": "toy", "strategies": ["gco"], "seed": seed, "iterations": 3, "gaussians": 7, "seconds": seconds + 9,
        "conflict": {}, "synthetic_prior": False, "test": part, "train": part, "provenance": {"git": "abc"},
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(content))
    (folder / "history.csv").write_text(f"t,seconds\n1,{seconds / 2}\n3,{seconds}\n")


def trainings(**results: list[tuple[float, float]]) -> pd.DataFrame:
    """(seconds, PSNR) of the seeds 0, 1, … by variant."""
    rows = [
        {"variant": name, "kind": "skips", "scene": "toy", "seed": seed, "iterations": 9, "gaussians": 7.0,
         "seconds": seconds, "psnr": psnr, "ssim": 0.5}
        for name, of_variant in results.items() for seed, (seconds, psnr) in enumerate(of_variant)
    ]  # fmt: skip
    return pd.DataFrame(rows)


# --- what is compared -------------------------------------------------------------------------------------------------


def test_the_front_holds_what_nothing_beats_in_time_and_psnr():
    table = pareto.summary(
        trainings(
            e=[(40, 22.0), (44, 22.4)], d=[(10, 19.0)], c=[(30, 21.9)], b=[(20, 22.0)], a=[(10, 20.0)],
            lost=[(5, math.nan)],
        )
    )  # fmt: skip
    assert list(table["variant"]) == ["lost", "a", "d", "b", "c", "e"]
    assert list(table[table["front"]]["variant"]) == ["a", "b", "e"]


def test_variants_are_compared_with_clear_seed_by_seed():
    """10 to 20 s and 20 to 30 s: 0.6; +1 and +2 dB: +1.5, although the third seed of clear is bad."""
    table = pareto.summary(
        trainings(clear=[(20, 20.0), (30, 21.0), (99, 9.0)], quick=[(10, 21.0), (20, 23.0)])
    ).set_index("variant")
    assert table.loc["quick", "time_over_clear"] == pytest.approx(0.6)
    assert table.loc["quick", "psnr_over_clear"] == pytest.approx(1.5)
    assert dict(table["seeds"]) == {"quick": 2, "clear": 3}
    without = pareto.summary(trainings(quick=[(10, 21.0)]))
    assert math.isnan(without.loc[0, "psnr_over_clear"])


@pytest.mark.parametrize("slowest", [20.0, 900.0])
def test_the_figure_has_a_marker_per_variant(slowest):
    table = pareto.summary(trainings(clear=[(10, 20.0), (11, 20.2)], quick=[(slowest, 19.0)], lost=[(5, math.nan)]))
    figure = plots.time_against_quality(table, "toy")
    (legend,) = figure.legends
    assert {text.get_text() for text in legend.get_texts()} == {"front", "clear", "quick", "lost"}


# --- what is trained --------------------------------------------------------------------------------------------------


def test_every_variant_composes():
    assert len(BY_NAME) == len(VARIANTS)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for variant in VARIANTS:
            _, overrides = pareto.folder_of(REQUEST, variant, 3)
            config = compose("config", overrides)
            assert (config.fit.seed, config.fit.iterations) == (3, round(100 * variant.length)), variant.name
            skips = config.skips.coarse_until > 0 or config.skips.hr_every > 1 or config.skips.plateau_gain > 0
            assert skips == (variant.kind == pareto.SKIPS), variant.name
            assert config.rasterizer.preset == ("accurate" if variant.name == "accurate" else "fast")


def test_a_folder_belongs_to_its_overrides():
    def folder(**changes: object) -> Path:
        return pareto.folder_of(replace(REQUEST, **changes), BASE, 0)[0]

    assert folder() == folder(seeds=(5,), variants=("clear",))
    assert len({folder(), folder(iterations=200), folder(overrides=("+scene=fern",))}) == 3
    assert folder().name.startswith("clear_seed0_")


class Trainer:
    """Writes runs at once and records them; "no plateau" fails."""

    def __init__(self) -> None:
        self.trained: list[tuple[str, int]] = []

    def __call__(self, folder: Path, overrides: list[str]) -> str | None:
        name, _, seed = folder.name.rsplit("_", 1)[0].rpartition("_seed")
        self.trained.append((name, int(seed)))
        if name == "no_plateau":
            return f"{folder}: no such scene"
        write_run(folder, psnr=20.0 + int(seed), seed=int(seed), seconds=5.0 if name == "coarse_first" else 10.0)
        return None


def test_seeds_are_the_outer_loop_and_a_failed_variant_is_not_tried_again(tmp_path):
    trainer, results = Trainer(), Results("pareto", lambda line: None)
    request = replace(REQUEST, out=tmp_path, variants=("clear", "no plateau", "coarse first"))
    pareto.measure(results, request, trainer)
    assert trainer.trained == [
        ("clear", 0), ("no_plateau", 0), ("coarse_first", 0), ("clear", 1), ("coarse_first", 1),
    ]  # fmt: skip
    assert results.notes[0].startswith("no plateau, seed 0: no_plateau_seed0_")
    assert str(tmp_path) not in results.text()
    table = results.tables["pareto"]
    assert list(table["variant"]) == ["coarse first", "clear"]
    assert list(table["time_over_clear"]) == [0.5, 1.0]
    assert list(table["seconds"]) == [5.0, 10.0]
    assert list(table["psnr"]) == [20.5, 20.5]
    assert list(table["front"]) == [True, False]


def test_finished_trainings_are_kept(tmp_path):
    trainer, request = Trainer(), replace(REQUEST, out=tmp_path, variants=("clear",), seeds=(0,))
    for asked in (request, replace(request, seeds=(0, 1))):
        pareto.measure(Results("pareto", lambda line: None), asked, trainer)
    assert trainer.trained == [("clear", 0), ("clear", 1)]
    pareto.measure(Results("pareto", lambda line: None), replace(request, iterations=50), trainer)
    assert len(trainer.trained) == 3


def test_a_damaged_run_is_named_with_its_remedy(tmp_path):
    request, results = replace(REQUEST, out=tmp_path, variants=("clear",), seeds=(0,)), Results("pareto", print)
    folder, _ = pareto.folder_of(request, BASE, 0)
    write_run(folder, psnr=20.0, seed=0, seconds=9.0)
    (folder / "history.csv").write_text("nothing,of\nuse,here\n")
    with pytest.raises(DataError, match="none finished"):
        pareto.measure(results, request, Trainer())
    assert "history.csv" in results.notes[0]


@pytest.mark.parametrize("override", ["+strategy=gco", "skips=none", "fit.seed=3", "hydra.run.dir=x"])
def test_settings_of_the_benchmark_are_refused(override, tmp_path):
    with pytest.raises(DataError, match="is set by the benchmark"):
        pareto.measure(Results("pareto", print), replace(REQUEST, overrides=(override,), out=tmp_path), Trainer())


def test_published_notes_name_no_folders(tmp_path):
    results, overrides = Results("pareto", lambda line: None), ("+scene=fern", "data.root=/home/me", "prior=onnx")
    pareto.measure(results, replace(REQUEST, overrides=overrides, out=tmp_path, variants=("clear",)), Trainer())
    assert "+scene=fern prior=onnx" in results.notes[-1]
    assert "/home/me" not in results.notes[-1]


@pytest.mark.slow
def test_the_command_trains_and_writes_table_and_figure(tmp_path, caplog, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    out, scene = tmp_path / "it's [a=b]", [override for override in TINY if not override.startswith("fit.iterations")]
    asked = ["pareto", *scene, "--seeds", "0", "--iterations", "24", "--variants", "clear", "1/2 as long"]
    assert main([*asked, "--out", str(out), "--threads", "1"]) == 0, caplog.text
    table = pd.read_csv(out / "pareto.csv").set_index("variant")
    assert dict(table["iterations"]) == {"clear": 24, "1/2 as long": 12}
    assert (out / "time_against_quality.png").stat().st_size > 10_000
    assert str(tmp_path) not in (out / "pareto.json").read_text()
