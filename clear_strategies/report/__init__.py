"""`python -m clear_strategies.report DIR …`: a table, pictures and an HTML page of finished runs.

Every folder at or below DIR with a metrics.json is a run. Runs of a scene that differ only in their seed share a row.
Files:

- report.md, report.csv: the table, and the paper's numbers beside ours if the runs are of its data sets
- report.html: the tables and pictures of all scenes; it needs the pictures beside it, and no network
- comparison_SCENE.png: one test view of up to 18 methods, enlarged where they differ most
- curves_SCENE.png: the columns of history.csv, over iterations and over training time
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from clear_strategies import console, files
from clear_strategies.commands import path_of
from clear_strategies.data.file_names import name_key
from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import DataError, counted
from clear_strategies.outputs.figures import SheetRow, write_contact_sheet, write_curves
from clear_strategies.report import paper
from clear_strategies.report.runs import FinishedRun, collect, history
from clear_strategies.report.table import compare, layout, markdown, notes

__all__ = ["FinishedRun", "collect", "compare", "layout", "main", "markdown", "notes", "write"]

_log = logging.getLogger(__name__)

_DRAWN: Final = 18  # methods in the pictures of a scene, as many as lines can be told apart
_LONGEST: Final = 60  # characters of a scene in the name of a file


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the report, and print its table."""
    parser = argparse.ArgumentParser(
        prog="python -m clear_strategies.report", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folders", nargs="+", type=path_of, metavar="DIR", help="a run's folder, or a folder of runs")
    parser.add_argument("--out", type=path_of, metavar="FOLDER", help="where the report goes (default: the first DIR)")
    against = "the method that Δ is the difference from (default: baseline, or without one the first)"
    parser.add_argument("--against", metavar="METHOD", help=against)
    options = parser.parse_args(arguments)
    console.show()
    out = options.out or options.folders[0]
    sys.stdout.write(write(collect(options.folders), out, options.against))


def write(runs: Sequence[FinishedRun], out: Path, against: str | None = None) -> str:
    """Write the files of a report into `out`; returns the text of report.md.

    Args:
        against: see `compare`.
    """
    table = compare(runs, against)
    text = markdown(layout(table), notes(table, runs))
    papers = {f"{data}, beside the paper's numbers": cells for data, cells in paper.beside(runs).items()}
    for title, cells in papers.items():
        text += f"\n{title}:\n\n{markdown(cells, [paper.NOTE])}"
    files.write_text(out / "report.md", text)
    records = table.drop(columns=["average", "run"])
    files.write_text(out / "report.csv", records.to_csv(index=False))

    sections: list[dict[str, Any]] = []  # of the page: the average over scenes, which has no pictures, then the scenes
    for scene, name in _file_names(table["scene"]).items():
        rows, pictures = table[table["scene"] == scene], list[str]()
        section = {"title": scene, "cells": layout(rows).drop(columns="scene"), "notes": notes(rows, runs)}
        if rows["average"].any():
            sections.insert(0, section)
            continue
        drawn = rows.sort_values(["reference", "psnr"], ascending=False, kind="stable").head(_DRAWN).sort_index()
        shown = dict(zip(drawn["method"], drawn["run"], strict=True))  # the first of several seeds
        if len(drawn) < len(rows):
            _log.info("%s: the pictures show the reference and the %d best others of %d.", scene, _DRAWN - 1, len(rows))
        if _compare_renders(out / f"comparison_{name}.png", scene, shown):
            pictures.append(f"comparison_{name}.png")
        pictures.append(f"curves_{name}.png")
        write_curves(out / pictures[-1], {method: history(run.folder) for method, run in shown.items()}, scene)
        sections.append({**section, "pictures": pictures})
    sections += [{"title": title, "cells": cells, "notes": [paper.NOTE]} for title, cells in papers.items()]
    _write_page(out / "report.html", sections)
    _log.info("report of %s: %s (report.html opens in any browser)", counted(len(runs), "run"), out)
    return text


def _write_page(path: Path, sections: Sequence[Mapping[str, Any]]) -> None:
    from jinja2 import Environment, FileSystemLoader

    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True)
    scenes = [section["title"] for section in sections if "pictures" in section]
    title = f"Report: {', '.join(scenes) if len(scenes) < 4 else f'{len(scenes)} scenes'}"
    files.write_text(path, environment.get_template("page.html.j2").render(title=title, sections=sections))


def _file_names(scenes: Iterable[str]) -> dict[str, str]:
    """A short word for each scene, unique even on disks that ignore case."""
    words: dict[str, str] = {}
    for scene in dict.fromkeys(scenes):
        word = re.sub(r"\W+", "_", scene).strip("_")[:_LONGEST] or "scene"
        while name_key(word) in map(name_key, words.values()):
            word += "_"
        words[scene] = word
    return words


def _compare_renders(path: Path, scene: str, runs: Mapping[str, FinishedRun]) -> bool:
    """Draw a test view that all runs rendered, and the truth if it is known; returns False if there is no such view."""
    names = [{file.name for file in (run.folder / "renders").glob("*.png")} for run in runs.values()]
    shared = sorted(set.intersection(*names))
    truths = {
        name: file
        for name in shared
        for run in runs.values()
        if (file := run.folder / "views" / f"{Path(name).stem}_truth.png").is_file()
    }
    shared = list(truths) or shared
    if not shared:
        _log.warning("%s: no render is common to all runs, so there is no comparison image.", scene)
        return False
    view = shared[len(shared) // 2]
    try:
        tiles = {method: np.asarray(read_image(run.folder / "renders" / view)) for method, run in runs.items()}
        truth = {"truth": np.asarray(read_image(truths[view]))} if view in truths else {}
    except DataError as error:
        _log.warning("%s; there is no comparison image.", error)
        return False
    if len({tile.shape for tile in (*tiles.values(), *truth.values())}) > 1:
        _log.warning("%s: the runs rendered at different sizes, so there is no comparison image.", scene)
        return False
    captions = {method: f"mean of the views: {run.numbers['psnr']:.2f} dB" for method, run in runs.items()}
    row = SheetRow("", {**tiles, **truth}, captions, tiles, next(iter(truth), None))
    write_contact_sheet(path, [row], f"{scene} · {Path(view).stem}")
    return True
