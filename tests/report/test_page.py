"""report.html is whole in itself and shows what the runs wrote."""

from __future__ import annotations

import base64
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch

from clear_strategies import files, report
from clear_strategies.data.photo_files import write_png
from clear_strategies.report.page import Section, write_page
from clear_strategies.report.table import Table
from tests.helpers.finished_run import make_run


class Page(HTMLParser):
    """What a browser would find: elements that are closed in order, what they refer to, and the embedded data."""

    def __init__(self, path: Path) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.references: list[str] = []
        self.text, self.embedded = "", ""
        self.feed(path.read_text(encoding="utf-8"))
        self.data = json.loads(self.embedded)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "srcset", "xlink:href")]
        if tag not in ("meta", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in ("href", "xlink:href")]

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


def test_the_page_refers_to_nothing_outside_itself(page_folder: Path) -> None:
    page = Page(page_folder / "report.html")
    assert page.open == []
    assert all(reference.startswith("#") for reference in page.references)
    source = (page_folder / "report.html").read_text(encoding="utf-8")
    assert [word for word in ("http:", "https:", "@import", "fetch(", "file:") if word in source] == []
    assert source.count("url(") == source.count("url(#")


def test_the_page_shows_every_method_image_and_map(page_folder: Path) -> None:
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
    for words in ("PSNR of test views, dB", "number of Gaussians", "lambda_HR = 0 (75x)", "1.5"):
        assert words in page.text
    render = (page_folder / "0" / "renders" / "view.png").read_bytes()
    shown = page.data["images"][view["layers"][3]["image"]]
    assert shown == "data:image/png;base64," + base64.b64encode(render).decode()


def test_images_that_methods_share_are_embedded_once(page_folder: Path) -> None:
    # Both renders of seed 0, LR and prior of both runs, and their five maps are the same bytes.
    assert len(Page(page_folder / "report.html").data["images"]) == 5


def test_a_page_over_its_budget_shows_fewer_views_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    run = make_run(tmp_path / "0", "+strategy=gco")
    g = torch.Generator().manual_seed(0)
    for i in range(4):
        for path in (
            run / "renders" / f"v{i}.png",
            *(run / "views" / f"v{i}_{k}.png" for k in ("lr", "prior", "truth")),
        ):
            write_png(path, torch.rand(96, 128, 3, generator=g))
    sizes, section = [], Section("demo", Table({}), {"gco": report.Run.read(run)})
    for budget in (20.0, 0.4, 0.25, 0.01):
        sizes.append(write_page(tmp_path / "report.html", [section], budget_mb=budget) / 1e6)
        page = Page(tmp_path / "report.html")
        assert page.data["scenes"][0]["views"], budget
    assert sizes[0] > sizes[1] > sizes[2] >= sizes[3]
    assert (sizes[1] <= 0.4, sizes[2] <= 0.25) == (True, True)
    assert "test views fit into --page-mb" in page.text
    assert "report.html is larger than 0.01 MB" in caplog.text


def test_layers_and_methods_have_the_same_numbers_in_all_views(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """page.js finds them by number: those of another view would stand under the wrong name."""
    runs = {name: report.Run.read(make_run(tmp_path / name, "+strategy=gco", seed=i)) for i, name in enumerate("abc")}
    (tmp_path / "b" / "maps" / "train").rename(tmp_path / "b" / "maps" / "other")
    files.write_json(tmp_path / "b" / "maps" / "maps.json", {"views": {"other.png": {}}})
    (tmp_path / "c" / "maps" / "train" / "lr.png").unlink()  # damaged, and read first by a page of its own
    for run in runs.values():
        shutil.copy(run.folder / "renders" / "view.png", run.folder / "renders" / "wide.png")
        for kind in ("lr", "prior"):  # the truth of this view is unknown
            shutil.copy(run.folder / "views" / f"view_{kind}.png", run.folder / "views" / f"wide_{kind}.png")
    write_page(tmp_path / "report.html", [Section("demo", Table({}), runs), Section("c", Table({}), {"c": runs["c"]})])
    both, damaged = Page(tmp_path / "report.html").data["scenes"]
    for view in both["views"]:
        assert [layer["label"] for layer in view["layers"]] == ["LR, enlarged", "SR prior", "a", "b", "c"]
    assert [view["name"] for view in both["maps"]] == ["train", "other"]
    assert [[m["label"] for m in view["methods"]] for view in both["maps"]] == [["a", "b", "c"]] * 2
    assert [bool(m["maps"]) for m in both["maps"][1]["methods"]] == [False, True, False]
    assert damaged["maps"] == []
    assert "its maps cannot be shown" in caplog.text


def test_runs_without_views_and_maps_still_make_a_page_and_splats_are_linked(tmp_path, caplog) -> None:
    run = make_run(tmp_path / "runs" / "a b#", "+strategy=gco")
    for folder in ("views", "maps"):
        shutil.rmtree(run / folder)
    (run / "splat.html").write_text("<html></html>")
    report.write(report.collect([tmp_path / "runs"]), tmp_path / "report")
    page = Page(tmp_path / "report" / "report.html")
    (scene,) = page.data["scenes"]
    assert [layer["label"] for layer in scene["views"][0]["layers"]] == ["gco"]
    assert scene["maps"] == []
    assert "no run has views/" in caplog.text
    assert [to for to in page.references if to.endswith("splat.html")] == ["../runs/a%20b%23/splat.html"]
