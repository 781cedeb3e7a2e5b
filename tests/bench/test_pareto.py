"""Seconds against quality of whole trainings: what counts as a second, what lies on the front, and what is kept."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from clear_strategies.bench import pareto
from clear_strategies.bench.__main__ import main
from clear_strategies.bench.pareto import REFERENCE, VARIANTS, Row, Training
from clear_strategies.bench.plot import beside, time_against_quality
from clear_strategies.errors import DataError
from tests.test_run import TINY

BY_NAME = {variant.name: variant for variant in VARIANTS}
REQUEST = pareto.Request((), (0, 1), 100, Path("out"), ("torch",), tuple(BY_NAME))
SCENE = [override for override in TINY if not override.startswith(("fit.iterations", "skips"))]


def leave(folder: Path, *, psnr: float = 20.0, seed: int = 0, seconds: float = 10.0, look_ms: float = 500.0) -> None:
    """What a run of three iterations leaves that looked at the test views after each."""
    scores = {"psnr": psnr, "ssim": 0.5, "gmsd": 0.1, "blur": 0.0}
    part = {"against": "HR photos", "views": {}, "mean": {"ours": scores}}
    content = {
        "scene": "toy", "strategies": ["gco"], "seed": seed, "iterations": 3, "gaussians": 7, "seconds": seconds + 9,
        "conflict": {}, "synthetic_prior": False, "test": part, "train": part, "provenance": {"git": "abc"},
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "metrics.json").write_text(json.dumps(content))
    rows = [f"1,{seconds / 2},{psnr - 2}", f"2,{seconds - 1},{psnr - 1}", f"3,{seconds},{psnr}"]
    (folder / "history.csv").write_text("\n".join(("t,seconds,psnr_test", *rows, "")))
    (folder / "timing.csv").write_text(f"stage,ms_each\nrender LR,9000\nprobe test views,{look_ms}\nevaluate,4000\n")


def row(name: str, *results: tuple[float, float]) -> Row:
    """A variant's trainings of the seeds 0, 1, … with these (seconds, PSNR)."""
    trainings = [
        Training("toy", i, 9, 7.0, s, p, 0.5, ((s / 2, p - 1), (s, p)), "abc") for i, (s, p) in enumerate(results)
    ]
    return Row(replace(REFERENCE, name=name), tuple(trainings))


# --- what is measured -------------------------------------------------------------------------------------------------


def test_seconds_count_no_look_at_the_test_views(tmp_path):
    """A row's seconds end before its own look: two looks of half a second lie before the third row's."""
    leave(tmp_path / "run", psnr=20.0, seconds=10.0, look_ms=500.0)
    training = Training.read(tmp_path / "run")
    assert training.seconds == pytest.approx(9.0)
    assert [pytest.approx(point) for point in training.curve] == [(5.0, 18.0), (8.5, 19.0), (9.0, 20.0)]
    assert (training.psnr, training.ssim, training.seed, training.commit) == (20.0, 0.5, 0, "abc")


@pytest.mark.parametrize("name", ["history.csv", "timing.csv"])
def test_a_damaged_run_is_named_with_its_remedy(tmp_path, name):
    leave(tmp_path / "run")
    (tmp_path / "run" / name).write_text("nothing,of\nuse,here\n")
    with pytest.raises(DataError, match=rf"{name}.*trained again"):
        Training.read(tmp_path / "run")


def test_the_front_holds_what_nothing_beats_in_time_and_psnr():
    a, b, c = row("a", (10, 20.0)), row("b", (20, 22.0)), row("c", (30, 21.9))
    d, e = row("d", (10, 19.0)), row("e", (40, 22.0), (44, 22.4))
    assert pareto.front([e, d, c, b, a]) == [a, b, e]
    assert pareto.front([c]) == [c]
    assert pareto.front([a, row("lost", (5, math.nan))]) == [a]


def test_what_is_compared_is_paired_by_seed():
    """10 to 20 s and 20 to 30 s: 0.6x; +1 and +2 dB: +1.5, although the third seed of the reference is bad."""
    reference, ours = row("clear", (20, 20.0), (30, 21.0), (99, 9.0)), row("quick", (10, 21.0), (20, 23.0))
    assert pareto._ratio(ours, reference) == "0.600x"
    assert pareto._difference(ours, reference) == "+1.50"
    assert (pareto._ratio(ours, None), pareto._difference(ours, None)) == ("–", "–")


# --- what is trained --------------------------------------------------------------------------------------------------


def test_variants_have_names_of_their_own_and_known_kinds():
    assert len(BY_NAME) == len(VARIANTS)
    assert {variant.kind for variant in VARIANTS} <= set(pareto.KINDS)
    assert REFERENCE in VARIANTS


def test_every_variant_composes():
    from hydra import compose, initialize_config_dir

    from clear_strategies.run import CONF

    with initialize_config_dir(str(CONF), version_base="1.3"):
        for variant in VARIANTS:
            _, overrides = pareto.folder_of(REQUEST, variant, 3, 1)
            config = compose("config", overrides)
            assert (config.fit.seed, config.fit.iterations) == (3, round(100 * variant.length)), variant.name
            on = (
                config.skips.coarse_until > 0
                or config.skips.hr_every > 1
                or config.skips.flat + config.skips.plateau_gain > 0
            )
            assert on == (variant.kind == pareto.SKIPS), variant.name
            assert config.rasterizer.preset == ("accurate" if variant.name == "accurate" else "fast")


def test_a_folder_is_that_of_its_overrides():
    def folder(**changes: object) -> Path:
        return pareto.folder_of(replace(REQUEST, **changes), REFERENCE, 0, 1)[0]

    assert folder() == folder(seeds=(5,), variants=("clear",))
    assert len({folder(), folder(iterations=200), folder(overrides=("+scene=fern",))}) == 2 + 1
    assert folder().name.startswith("clear_seed0_")


@pytest.fixture
def trainings(monkeypatch) -> list[tuple[str, str]]:
    """Trainings take no time and are noted; "no plateau" fails."""
    noted: list[tuple[str, str]] = []

    def train(folder: Path, overrides: list[str]) -> str | None:
        seed = next(int(o.partition("=")[2]) for o in overrides if o.startswith("fit.seed="))
        leaps, coarse = ("skips.plateau_gain=0.01" in overrides, "skips.coarse_until=3000" in overrides)
        noted.append(("no plateau" if leaps else "coarse first" if coarse else "clear", str(seed)))
        if leaps:
            return f"{folder}: no such scene"
        leave(folder, psnr=20.0 + seed, seed=seed, seconds=6.0 if coarse else 11.0)
        return None

    monkeypatch.setattr(pareto, "_train", train)
    return noted


def test_seeds_are_outermost_and_what_failed_is_not_tried_again(tmp_path, trainings):
    said: list[str] = []
    request = replace(REQUEST, out=tmp_path, variants=("clear", "no plateau", "coarse first"))
    findings, rows = pareto.measure(request, said.append)
    assert trainings == [
        ("clear", "0"), ("no plateau", "0"), ("coarse first", "0"), ("clear", "1"), ("coarse first", "1"),
    ]  # fmt: skip
    assert [r.variant.name for r in rows] == ["coarse first", "clear"]
    assert len(findings.skipped) == 1
    assert findings.skipped[0].startswith("no plateau, seed 0 and later: no_plateau_seed0_")
    assert str(tmp_path) not in findings.skipped[0]
    columns = findings.sections[0].columns
    assert columns["of clear"] == ["0.500x", "1.00x"]
    assert columns["seconds"] == ["5.00 ± 0", "10.0 ± 0"]
    assert columns["PSNR (dB)"] == ["20.50 ± 0.71"] * 2
    assert columns["front"] == ["yes", ""]


def test_finished_trainings_are_kept(tmp_path, trainings):
    said: list[str] = []
    request = replace(REQUEST, out=tmp_path, variants=("clear",), seeds=(0,))
    pareto.measure(request, said.append)
    pareto.measure(replace(request, seeds=(0, 1)), said.append)
    assert trainings == [("clear", "0"), ("clear", "1")]
    assert [line.endswith(", kept") for line in said] == [False, True, False]
    pareto.measure(replace(request, iterations=50), said.append)
    assert len(trainings) == 3


def test_a_second_backend_trains_the_reference_alone(tmp_path):
    request = replace(REQUEST, backends=("torch", "torch"))
    assert [v.name for v in pareto._chosen(request, str)] == list(BY_NAME)
    other = pareto._on("torch", REFERENCE)
    assert other.overrides == ("rasterizer=torch", "objective.kernels=torch", "+strategy=clear")


@pytest.mark.parametrize("override", ["+strategy=gco", "skips=none", "fit.seed=3", "hydra.run.dir=x", "rasterizer=cpp"])
def test_what_the_benchmark_sets_is_refused(override, tmp_path):
    with pytest.raises(DataError, match="for the benchmark to set"):
        pareto.measure(replace(REQUEST, overrides=(override,), out=tmp_path), str)


def test_figures_name_no_folders():
    assert pareto._without_paths(["+scene=fern", "data.root=/home/me", "prior=onnx"]) == ["+scene=fern", "prior=onnx"]


def test_bad_arguments_are_one_line_and_exit_code_2(capsys, caplog, tmp_path):
    with pytest.raises(SystemExit) as stopped:
        main(["pareto", "--seeds", "one"])
    assert stopped.value.code == 2
    assert "whole numbers with commas" in capsys.readouterr().err
    assert main(["pareto", "--out", str(tmp_path), "--variants", "magic"]) == 2
    assert "magic: is no variant" in caplog.records[-1].getMessage()


# --- the picture ------------------------------------------------------------------------------------------------------


def test_labels_stand_on_no_label_and_no_marker():
    """Twelve markers in a row, 12 px apart, with labels of 60x12 px."""
    points = [(200.0 + 12 * i, 200.0) for i in range(12)]
    boxes = beside(points, [(60.0, 12.0)] * 12, (0, 0, 600, 400), [(0, 0, 150, 400)])
    for i, (left, bottom, right, top) in enumerate(boxes):
        assert (right - left, top - bottom) == pytest.approx((60, 12))
        assert left >= 150
        for x, y in points:
            assert not (left < x < right and bottom < y < top)
        for other in boxes[:i]:
            assert min(right, other[2]) <= max(left, other[0]) or min(top, other[3]) <= max(bottom, other[1])


def test_a_label_is_beside_its_marker_where_there_is_room():
    assert beside([(100.0, 100.0)], [(30.0, 10.0)], (0, 0, 200, 200)) == [(109.0, 95.0, 139.0, 105.0)]
    (near_the_edge,) = beside([(190.0, 100.0)], [(30.0, 10.0)], (0, 0, 200, 200))
    assert near_the_edge == (151.0, 95.0, 181.0, 105.0)


@pytest.mark.parametrize("slowest", [20.0, 900.0])
def test_the_picture_is_drawn_at_any_span(tmp_path, slowest):
    rows = [row("clear", (10, 20.0), (11, 20.2)), row("quick", (slowest, 19.0)), row("lost", (5, math.nan))]
    time_against_quality(tmp_path / "p.png", rows, "toy")
    with Image.open(tmp_path / "p.png") as picture:
        assert picture.size[0] > 600
    with pytest.raises(DataError, match="no training has a finite PSNR"):
        time_against_quality(tmp_path / "p.png", rows[2:], "toy")


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_trains_and_leaves_table_json_and_picture(tmp_path, capsys, caplog, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:pareto -->\n<!-- /bench:pareto -->\n")
    asked = ["pareto", *SCENE, "--seeds", "0", "--iterations", "24", "--variants", "clear", "1/2 as long"]
    asked += ["--out", str(tmp_path / "it's [a=b]"), "--threads", "1", "--docs", str(page)]
    files = {name: tmp_path / f"out.{name}" for name in ("json", "picture")}
    caplog.set_level("INFO")
    assert main([*asked, *(word for name, path in files.items() for word in (f"--{name}", str(path)))]) == 0, (
        caplog.text
    )
    rows = {r["name"]: r for r in json.loads(files["json"].read_text())["rows"]}
    assert {name: r["trainings"][0]["iterations"] for name, r in rows.items()} == {"clear": 24, "1/2 as long": 12}
    for found in rows.values():
        (training,) = found["trainings"]
        assert training["curve"][-1] == [pytest.approx(training["seconds"]), pytest.approx(training["psnr"], abs=1e-3)]
    text = capsys.readouterr().out
    assert text.strip() in page.read_text()
    assert str(tmp_path) not in text + files["json"].read_text()
    assert files["picture"].stat().st_size > 10_000
