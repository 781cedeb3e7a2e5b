"""A report says what the runs measured: seeds averaged, settings told apart, what is missing named."""

from __future__ import annotations

import base64
import csv
import json
import os
import shutil
import statistics
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import torch

from clear_strategies import files, report
from clear_strategies.data.photo_files import write_png
from clear_strategies.errors import DataError


def scores(psnr: float | None) -> dict[str, float | None]:
    return {"psnr": psnr, "ssim": 0.5, "gmsd": 0.1, "blur": 0.2}


def make_run(
    folder: Path, *overrides: str, psnr: float | None = 20.0, seed: int = 0, scene: str = "demo", bicubic: float = 18.0,
    **facts: Any,
) -> Path:  # fmt: skip
    """What run.py leaves, as far as a report reads it."""
    mean = {"ours": scores(psnr), "bicubic": scores(bicubic), "prior": scores(bicubic + 1)}
    content = {
        "scene": scene, "strategies": ["gco"], "seed": seed, "iterations": 100, "gaussians": 1200, "seconds": 61.7,
        "conflict": {"gaussian": 0.25, "means": 0.3}, "synthetic_prior": False,
        "test": {"against": "HR photos", "views": {"view.png": {"ours": scores(psnr)}}, "mean": mean},
        "train": {"against": "HR photos", "views": {}, "mean": mean}, "provenance": {}, **facts,
    }  # fmt: skip
    files.write_json(folder / "metrics.json", content)
    overrides = (*overrides, f"fit.seed={seed}")
    files.write_text(folder / ".hydra" / "overrides.yaml", "".join(f"- {o!r}\n" for o in overrides))
    rows = [{"t": t, "psnr_test": 15 + t, "n_gaussians": 1000 + t, "seconds": t / 2} for t in range(1, 6)]
    files.write_csv(folder / "history.csv", rows, ["t", "psnr_test", "n_gaussians", "seconds", "conflict"])
    write_png(folder / "renders" / "view.png", torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(seed)))
    shade = torch.linspace(0, 1, 32).expand(24, 32)
    for kind, image in {
        "lr": shade[::4, ::4, None].expand(6, 8, 3),
        "prior": shade[..., None].expand(24, 32, 3),
    }.items():
        write_png(folder / "views" / f"view_{kind}.png", image)
        write_png(folder / "maps" / "train" / f"{kind}.png", image)
    write_png(folder / "views" / "view_truth.png", torch.full((24, 32, 3), 0.5))
    for name in ("reliability", "demand", "weight", "corrected", "conflict"):
        write_png(folder / "maps" / "train" / f"{name}.png", shade * 0.2)
    files.write_json(folder / "maps" / "maps.json", {"views": {"train.png": {"reliability": 0.75}}})
    timing = {"stage": "backward HR", "seconds_saved": 1.5, "why": "lambda_HR = 0 (75x)"}
    files.write_csv(folder / "timing.csv", [timing], list(timing))
    return folder


def rows_of(*folders: Path) -> dict[str, report.Row]:
    return {row.method: row for row in report.table(report.collect(folders))}


def cells(text: str) -> list[dict[str, str]]:
    """The lines of a Markdown table."""
    header, _, *lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [{name.strip(): cell.strip() for name, cell in zip(header, line, strict=True)} for line in lines]


# ── which runs share a row ───────────────────────────────────────────────────────────────────────────────────────────


def test_runs_that_differ_in_their_seed_share_a_row(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.0, 25.0)):
        make_run(tmp_path / str(seed), "+strategy=clear", seed=seed, psnr=psnr)
    row = rows_of(tmp_path)["clear"]
    assert row.values["psnr"] == [20.0, 21.0, 25.0]
    (line,) = (c for c in cells(report.markdown([row])) if c["method"] == "clear")
    assert line["PSNR (dB) ↑"] == "22.00 ± 2.65"  # deviations -2, -1, 3: sqrt(14 / 2)
    assert (line["best"], line["seeds"], line["Gaussians"]) == ("25.00", "0, 1, 2", "1,200 ± 0")


@pytest.mark.parametrize(
    "setting", ["prior=onnx", "strategies.gco.tolerance=0.1", "~strategies.p2g", "fit.iterations=9"]
)
def test_runs_that_differ_in_a_setting_have_rows_that_name_it(tmp_path: Path, setting: str) -> None:
    make_run(tmp_path / "0", "+strategy=clear", "data=llff")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", setting)
    assert {"clear", f"clear, {setting}"} <= set(rows_of(tmp_path))


def test_what_changes_no_result_separates_no_runs(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=clear", "fit.threads=1", "hydra.run.dir=here")
    make_run(tmp_path / "1", "+strategy=clear", "fit.threads=2", "fit.probe_every=7", seed=1)
    assert len(rows_of(tmp_path)["clear"].runs) == 2


def test_strategies_are_named_as_they_were_asked_for(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=baseline", strategies=[])
    make_run(tmp_path / "1", "+strategy=[gco,p2g]", strategies=["gco", "p2g"])
    make_run(tmp_path / "2", "+strategy=clear_paper", strategies=["gco", "p2g", "svs"])
    bare = make_run(tmp_path / "3", strategies=["mine", "svs"])
    (bare / ".hydra" / "overrides.yaml").unlink()
    assert {"baseline", "gco + p2g", "clear_paper", "mine + svs"} <= set(rows_of(tmp_path))


def test_runs_repeated_with_one_seed_are_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "0", "+strategy=clear")
    make_run(tmp_path / "1", "+strategy=clear")
    rows_of(tmp_path)
    assert "demo, clear: a row holds several runs with the same seed" in caplog.text


# ── the table ────────────────────────────────────────────────────────────────────────────────────────────────────────


def test_a_sweep_is_a_ladder_from_its_first_job_with_the_baselines_once(tmp_path: Path) -> None:
    for job, (strategy, psnr) in enumerate([("baseline", 20.0), *[("gco", 20.5)] * 9, ("clear", 19.25)]):
        make_run(tmp_path / str(job), f"+strategy={strategy}", psnr=psnr, seed=job)
    lines = cells(report.markdown(report.table(report.collect([tmp_path]))))
    assert [line["method"] for line in lines] == ["bicubic", "prior", "baseline", "gco", "clear"]
    assert [line["Δ"] for line in lines] == ["", "", "+0.00", "+0.50", "-0.75"]
    assert lines[0]["PSNR (dB) ↑"] == "18.00"


def test_baselines_of_different_inputs_stand_apart(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "prior=onnx")
    make_run(tmp_path / "1", "+strategy=clear", "prior=onnx")
    make_run(tmp_path / "2", "+strategy=gco", "prior=bicubic", bicubic=17.0)
    rows = rows_of(tmp_path)
    assert rows["prior, prior=onnx"].values["psnr"] == [19.0]
    assert rows["prior, prior=bicubic"].values["psnr"] == [18.0]


def test_scenes_keep_their_own_ladder_and_marks(tmp_path: Path) -> None:
    make_run(tmp_path / "a", "+strategy=gco", psnr=20.0, synthetic_prior=True)
    make_run(tmp_path / "b", "+strategy=gco", psnr=25.0, scene="fern")
    make_run(tmp_path / "c", "+strategy=clear", psnr=26.0, scene="fern")
    lines = cells(report.markdown(report.table(report.collect([tmp_path]))))
    found = {(line["scene"], line["method"]): line["Δ"] for line in lines}
    assert found["demo (synthetic prior)", "gco"] == "+0.00"
    assert found["fern", "clear"] == "+1.00"


def test_scores_that_are_not_of_hr_test_views_are_marked(tmp_path: Path) -> None:
    lr = {"against": "LR photos", "views": {}, "mean": {"ours": scores(20.0), "prior": scores(21.0)}}
    nothing: dict[str, Any] = {"against": "nothing", "views": {}, "mean": {}}
    make_run(tmp_path / "a", test=lr, scene="a")
    make_run(tmp_path / "b", test=nothing, train=lr, scene="b")
    scenes = {row.scene for row in report.table(report.collect([tmp_path]))}
    assert scenes == {"a (against LR photos)", "b (training views, against LR photos)"}


def test_columns_that_say_nothing_are_left_out(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", conflict={})
    (line,) = (c for c in cells(report.markdown(report.table(report.collect([tmp_path])))) if c["method"] == "gco")
    assert not {"conflict", "Δ", "best"} & set(line)


def test_settings_that_all_runs_share_are_said_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "data=llff", "fit.iterations=600")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", "fit.iterations=600")
    text = report.markdown(report.table(report.collect([tmp_path])))
    assert "All runs of demo: `data=llff fit.iterations=600`." in text
    assert text.count("data=llff") == 1


def test_a_run_without_a_finite_score_is_said_to_be_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "0", "+strategy=gco", psnr=20.0)
    make_run(tmp_path / "1", "+strategy=gco", psnr=None, seed=1)
    assert rows_of(tmp_path)["gco"].values["psnr"] == [20.0]
    assert "demo, gco: runs without a finite PSNR are left out of its mean" in caplog.text


def test_a_bar_in_a_name_does_not_break_the_table(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", scene="a|b")
    assert "a\\|b" in report.markdown(report.table(report.collect([tmp_path])))


def test_differences_are_paired_by_seed(tmp_path: Path) -> None:
    for seed, (first, second) in enumerate(((20.0, 20.5), (22.0, 22.25), (21.0, 22.5))):
        make_run(tmp_path / f"a{seed}", "+strategy=baseline", seed=seed, psnr=first)
        make_run(tmp_path / f"b{seed}", "+strategy=gco", seed=seed, psnr=second)
    delta = rows_of(tmp_path)["gco"].delta
    # Differences 0.5, 0.25, 1.5: mean 0.75, deviations -0.25, -0.5, 0.75, so √(0.875 / 2) / √3.
    assert delta is not None
    assert (delta.mean, delta.pairs) == (0.75, 3)
    assert delta.error == pytest.approx((0.875 / 2 / 3) ** 0.5)
    lines = {line["method"]: line for line in cells(report.markdown(report.table(report.collect([tmp_path]))))}
    assert (lines["baseline"]["Δ"], lines["gco"]["Δ"]) == ("+0.00", "+0.75 ± 0.38")


def test_the_average_over_scenes_is_of_their_means_and_its_differences_are_paired(tmp_path: Path) -> None:
    for scene, offset in (("fern", 0.0), ("horns", 4.0)):
        for seed in (0, 1, 2)[: 3 if scene == "fern" else 1]:
            psnr = 20.0 + offset + seed
            make_run(tmp_path / f"{scene}a{seed}", "+strategy=baseline", seed=seed, psnr=psnr, scene=scene)
            make_run(tmp_path / f"{scene}b{seed}", "+strategy=gco", seed=seed, psnr=psnr + 1 + offset, scene=scene)
    rows = [row for row in report.table(report.collect([tmp_path])) if not row.runs]
    assert {row.scene for row in rows} == {"average of 2 scenes"}
    assert [row.method for row in rows] == ["bicubic", "prior", "baseline", "gco"]
    baseline, gco = rows[2:]
    assert baseline.values["psnr"] == [21.0, 24.0]  # each scene counts once, however many seeds it has
    assert gco.delta is not None
    assert (gco.delta.mean, gco.delta.pairs) == (2.0, 4)  # 1, 1, 1, 5
    assert gco.delta.error == pytest.approx(1.0)  # s = 2
    line = cells(report.markdown(rows))[3]
    assert (line["PSNR (dB) ↑"], line["Δ"]) == ("25.50", "+2.00 ± 1.00")


def test_scenes_are_averaged_over_what_their_own_data_settings_say(tmp_path: Path) -> None:
    for scene, shrink in (("fern", 2), ("horns", 4)):
        for job, strategy in enumerate(("baseline", "gco")):
            make_run(tmp_path / f"{scene}{job}", f"+strategy={strategy}", f"data.views.shrink={shrink}", scene=scene)
    make_run(tmp_path / "only_here", "+strategy=gco", "density.threshold=1", "data.views.shrink=2", scene="fern")
    averages = [row.method for row in report.table(report.collect([tmp_path])) if not row.runs]
    assert averages == ["bicubic", "prior", "baseline", "gco"]


def test_a_method_names_its_runs_and_where_a_scene_lies_separates_none(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+method=srgs", "+scene=fern", strategies=["hr_only"])
    make_run(tmp_path / "1", "+method=srgs", "data.path=elsewhere/fern", "data.reader.path=x", seed=1)
    assert rows_of(tmp_path)["srgs"].seeds == "0, 1"


# ── the paper's tables ───────────────────────────────────────────────────────────────────────────────────────────────


def test_published_numbers_stand_right_of_ours_and_the_caption_says_what_differs(tmp_path: Path) -> None:
    plan = {"train views": "3: a, b, c", "HR": "504x376 (x4), SR images: onnx span.onnx", "initial points": "9,199: LR"}
    make_run(tmp_path / "0", "+method=dropgaussian", provenance={"plan": plan}, iterations=1500)
    make_run(tmp_path / "1", "+strategy=clear", "density.threshold=1e-3", provenance={"plan": plan}, iterations=1500)
    make_run(tmp_path / "2", "+strategy=mine", provenance={"plan": plan}, iterations=1500)
    report.write(report.collect([tmp_path]), tmp_path, paper="llff")
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    lines = {line["method"]: line for line in cells(text)}
    assert list(lines["mine"])[2:4] == ["PSNR (dB) ↑", "PSNR, paper"]
    assert (lines["dropgaussian"]["PSNR, paper"], lines["dropgaussian"]["LPIPS, paper"]) == ("18.57", "0.390")
    assert lines["clear, density.threshold=1e-3"]["SSIM, paper"] == "0.682"
    assert (lines["mine"]["PSNR, paper"], lines["mine"]["LPIPS"]) == ("", "–")
    for phrase in (
        "Table 1",
        "1,500 iterations",
        "HR 504x376",
        "onnx span.onnx",
        "9,199: LR",
        "S2Gaussian 20.17 / 0.640",
    ):
        assert phrase in text, phrase
    assert "training views (" not in text  # three, as in the protocol
    with (tmp_path / "report.csv").open(newline="", encoding="utf-8") as file:
        assert {r["method"]: r["paper_psnr"] for r in csv.DictReader(file)}["dropgaussian"] == "18.57"


def test_the_ablation_is_matched_step_by_step(tmp_path: Path) -> None:
    for job, strategy in enumerate(("baseline", "gco", "[gco,p2g]", "clear")):
        make_run(tmp_path / str(job), f"+strategy={strategy}")
    report.write(report.collect([tmp_path]), tmp_path, paper="ablation")
    lines = cells((tmp_path / "report.md").read_text(encoding="utf-8"))
    assert [line["PSNR, paper"] for line in lines] == ["", "", "18.74", "19.72", "20.09", "20.42"]
    assert [line["conflict, paper"] for line in lines][2:] == ["0.243", "0.228", "0.210", "0.162"]


# ── the page ─────────────────────────────────────────────────────────────────────────────────────────────────────────


class Page(HTMLParser):
    """What a browser would find: elements that are closed in order, what they refer to, and the embedded data."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.references: list[str] = []
        self.text, self.charts, self.embedded = "", 0, ""
        self.feed(path.read_text(encoding="utf-8"))
        self.data = json.loads(self.embedded)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "xlink:href")]
        self.charts += tag == "svg" and ("role", "img") in attrs
        if tag not in ("meta", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        pass

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.embedded = self.embedded or data
        else:
            self.text += data


@pytest.fixture(scope="module")
def page_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    make_run(folder / "0", "+strategy=baseline")
    make_run(folder / "1", "+strategy=<b>clear</b>")
    report.write(report.collect([folder]), folder)
    return folder


def test_the_page_is_whole_by_itself(page_folder: Path) -> None:
    page = Page(page_folder / "report.html")
    assert page.open == []
    assert all(reference.startswith("#") for reference in page.references)
    source = (page_folder / "report.html").read_text(encoding="utf-8")
    assert [word for word in ("http:", "https:", "url(", "@import", "fetch(", "file:") if word in source] == []
    assert page.charts == 4


def test_the_page_shows_every_method_picture_and_map(page_folder: Path) -> None:
    page = Page(page_folder / "report.html")
    (scene,) = page.data["scenes"]
    (view,), (mapped,) = scene["views"], scene["maps"]
    methods = ["baseline", "<b>clear</b>"]
    assert [layer["label"] for layer in view["layers"]] == ["LR, enlarged", "SR prior", "truth", *methods]
    assert (view["width"], view["height"]) == (32, 24)
    assert view["layers"][-1]["note"] == "20.00 dB"
    assert [method["label"] for method in mapped["methods"]] == methods
    assert set(mapped["methods"][0]["maps"]) == {"reliability", "demand", "weight", "corrected", "conflict"}
    assert mapped["tops"]["corrected"] == 0.25  # the next round number above 0.2
    for name in methods:
        assert name in page.text
    for why in ("lambda_HR = 0 (75x)", "1.5"):
        assert why in page.text
    render = (page_folder / "0" / "renders" / "view.png").read_bytes()
    shown = page.data["images"][view["layers"][3]["image"]]
    assert shown == "data:image/png;base64," + base64.b64encode(render).decode()


def test_pictures_that_methods_share_are_stored_once(page_folder: Path) -> None:
    # Both renders of seed 0, LR and prior of both runs, and their five maps are the same bytes.
    assert len(Page(page_folder / "report.html").data["images"]) == 5


def test_a_page_over_its_budget_shows_less_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = make_run(tmp_path / "0", "+strategy=gco")
    g = torch.Generator().manual_seed(0)
    for i in range(4):
        for path in (
            run / "renders" / f"v{i}.png",
            *(run / "views" / f"v{i}_{k}.png" for k in ("lr", "prior", "truth")),
        ):
            write_png(path, torch.rand(96, 128, 3, generator=g))
    sizes = []
    for budget in (20.0, 0.4, 0.2, 0.01):
        report.write(report.collect([tmp_path]), tmp_path, page_mb=budget)
        sizes.append((tmp_path / "report.html").stat().st_size / 1e6)
        page = Page(tmp_path / "report.html")
        assert page.data["scenes"][0]["views"], budget
    assert sizes[0] > sizes[1] > sizes[2] >= sizes[3]
    assert (sizes[1] <= 0.4, sizes[2] <= 0.2) == (True, True)
    assert "test views fit into --page-mb" in page.text
    assert "report.html is larger than 0.01 MB" in caplog.text


def test_runs_of_an_older_version_still_make_a_page(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = make_run(tmp_path / "0", "+strategy=gco")
    for folder in ("views", "maps"):
        shutil.rmtree(run / folder)
    report.write(report.collect([tmp_path]), tmp_path)
    (scene,) = Page(tmp_path / "report.html").data["scenes"]
    assert [layer["label"] for layer in scene["views"][0]["layers"]] == ["gco"]
    assert scene["maps"] == []
    assert "no run left views/" in caplog.text


# ── the folder ───────────────────────────────────────────────────────────────────────────────────────────────────────


def test_damaged_and_unfinished_runs_are_named_and_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    make_run(tmp_path / "good", "+strategy=gco")
    (make_run(tmp_path / "truncated") / "metrics.json").write_text('{"scene": "de')
    (make_run(tmp_path / "list") / "metrics.json").write_text("[]")
    make_run(tmp_path / "no_scores", test={"mean": {"prior": scores(3.0)}})
    make_run(tmp_path / "wrong_type", gaussians="many")
    (make_run(tmp_path / "bad_yaml") / ".hydra" / "overrides.yaml").write_text("- [a\n")
    (tmp_path / "unfinished" / ".hydra").mkdir(parents=True)
    assert [run.folder.name for run in report.collect([tmp_path])] == ["good"]
    for name in ("truncated", "list", "no_scores", "wrong_type", "bad_yaml", "unfinished"):
        (told,) = (r.getMessage() for r in caplog.records if str(tmp_path / name) in r.getMessage())
        assert "left out" in told
        assert "\n" not in told


def test_a_run_given_twice_counts_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    assert len(report.collect([tmp_path, tmp_path / "0", tmp_path / "0" / ".." / "0"])) == 1


def test_a_folder_without_runs_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="there is no finished run here: give the folder of a run or of a sweep"):
        report.collect([tmp_path, tmp_path / "absent"])


def test_the_report_is_a_table_for_readers_one_for_programs_and_pictures(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.5)):
        make_run(tmp_path / "runs" / str(seed), "+strategy=gco", seed=seed, psnr=psnr)
    make_run(tmp_path / "runs" / "2", "+strategy=clear", psnr=22.0)
    text = report.write(report.collect([tmp_path / "runs"]), tmp_path / "out")
    assert (tmp_path / "out" / "report.md").read_text(encoding="utf-8") == text
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "report.md", "report.csv", "report.html", "comparison_demo.png", "curves_demo.png", "psnr_over_seconds_demo.png",
    }  # fmt: skip
    with (tmp_path / "out" / "report.csv").open(newline="", encoding="utf-8") as file:
        records = {record["method"]: record for record in csv.DictReader(file)}
    assert float(records["gco"]["psnr"]) == 20.75
    assert float(records["gco"]["psnr_std"]) == pytest.approx(statistics.stdev((20.0, 21.5)))
    assert float(records["gco"]["gaussians"]) == 1200
    assert float(records["clear"]["psnr_delta"]) == 1.25
    assert (records["bicubic"]["conflict"], records["bicubic"]["psnr_delta"]) == ("", "")


def test_runs_without_pictures_or_history_are_still_tabled(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = make_run(tmp_path / "0", "+strategy=gco")
    (run / "history.csv").write_text("t,psnr_test\n1,oops\n")
    (run / "renders" / "view.png").write_bytes(b"no picture")
    assert report.main([str(tmp_path)]) == 0
    assert "its history cannot be drawn" in caplog.text
    assert "there is no comparison picture" in caplog.text


def test_the_command_prints_the_table_on_any_terminal_and_knows_no_hydra(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco")
    code = (
        "import sys; from clear_strategies import report; code = report.main([sys.argv[1]]); "
        "sys.exit(9 if {'hydra', 'matplotlib.pyplot'} & set(sys.modules) else code)"
    )
    environment = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": str(Path(report.__file__).parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "| demo  | gco" in done.stdout


def test_the_command_says_in_one_line_what_is_wrong_and_exits_with_2(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    assert report.main([str(tmp_path)]) == 2
    assert len(caplog.records) == 1
    assert capsys.readouterr().out == ""


def test_rows_stand_in_the_order_in_which_a_sweep_was_asked_for(tmp_path: Path) -> None:
    for number, name in ((2, "a_clear"), (10, "b_more"), (0, "z_baseline")):
        folder = make_run(tmp_path / name, f"+strategy={name[2:]}")
        files.write_text(folder / ".hydra" / "hydra.yaml", f"hydra:\n  job:\n    num: {number}\n")
    assert [run.name for run in report.collect([tmp_path])] == ["baseline", "clear", "more"]


def test_a_method_takes_the_place_of_the_strategies_before_it(tmp_path: Path) -> None:
    run = report.Run.read(make_run(tmp_path / "run", "+strategy=clear", "+method=srgs"))
    assert run.name == "srgs"
