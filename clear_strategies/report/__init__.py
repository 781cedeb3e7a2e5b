"""`python -m clear_strategies.report DIR …`: a run, or a sweep, as a table (Markdown and CSV), pictures, and a page.

Every folder below DIR with a metrics.json is a run. Runs of a scene that differ in nothing but their seed share a row:
mean ± standard deviation, and the best beside it. What all runs of a scene have in common is said once, below the table.
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from clear_strategies import files
from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import ClearError, DataError
from clear_strategies.outputs import pictures
from clear_strategies.report import page
from clear_strategies.report.published import PAPER, Beside, beside
from clear_strategies.report.runs import Run, collect, history
from clear_strategies.report.table import Row, aligned, columns, markdown, record, table

__all__ = ["Row", "Run", "aligned", "collect", "main", "markdown", "table", "write"]

_log = logging.getLogger(__name__)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 0, or 2 where there is nothing to report."""
    parser = argparse.ArgumentParser(
        prog="python -m clear_strategies.report", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a run's folder, or a folder of runs")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the report goes (default: the first DIR)")
    parser.add_argument("--paper", choices=sorted(PAPER), help="set the paper's numbers of this table beside ours")
    parser.add_argument(
        "--page-mb", type=float, default=page.BUDGET_MB, metavar="MB", help="what report.html may weigh (%(default)s)"
    )
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    out = options.out or options.folders[0]
    try:
        text = write(collect(options.folders), out, paper=options.paper, page_mb=options.page_mb)
    except (ClearError, OSError) as error:
        _log.error("%s", error)
        return 2
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(text.encode(encoding, "replace").decode(encoding))  # a terminal may not know ↑
    return 0


def write(runs: Sequence[Run], out: Path, *, paper: str | None = None, page_mb: float = page.BUDGET_MB) -> str:
    """Leave report.md, report.csv, report.html and each scene's comparison_*.png, curves_*.png and
    psnr_over_seconds_*.png in `out`; returns report.md.

    Args:
        paper: which of `PAPER`'s tables stands beside ours.
        page_mb: what report.html may weigh, 10⁶ bytes; where it does not fit it shows fewer views, and says so.
    """
    rows = table(runs)

    def papers(some: Sequence[Row], of: Sequence[Run]) -> Beside | None:
        return None if paper is None else beside(some, of, PAPER[paper])

    published = papers(rows, runs)
    text = markdown(rows, published)
    files.write_text(out / "report.md", text)
    records = [record(row) for row in rows]
    if published is not None:
        records = [{**known, **numbers} for known, numbers in zip(records, published.records(rows), strict=True)]
    files.write_csv(out / "report.csv", records, list(dict.fromkeys(key for line in records for key in line)))
    sections = []
    for scene in dict.fromkeys(run.scene for run in runs):
        # Of several seeds the first is shown.
        shown = {row.method: row.runs[0] for row in rows if row.scene == scene and not row.baseline}
        name = re.sub(r"\W+", "_", scene).strip("_")
        _compare(out / f"comparison_{name}.png", scene, shown)
        histories = {method: history(run.folder) for method, run in shown.items()}
        pictures.overlay(out / f"curves_{name}.png", histories, scene)
        pictures.over_seconds(out / f"psnr_over_seconds_{name}.png", histories, scene)
        of_scene = [row for row in rows if row.scene == scene]
        own = papers(of_scene, [run for run in runs if run.scene == scene])
        sections.append(page.Section(scene, *columns(of_scene, own), shown, histories))
    if averages := [row for row in rows if not row.runs]:
        sections.insert(0, page.Section("average over scenes", *columns(averages, published), {}, {}))
    size = page.write(out / "report.html", sections, budget_mb=page_mb)
    _log.info("report of %d runs: %s (report.html, %.1f MB, opens in any browser)", len(runs), out, size / 1e6)
    return text


def _compare(path: Path, scene: str, runs: Mapping[str, Run]) -> None:
    """A test view that all runs rendered, side by side."""
    names = [{file.name for file in (run.folder / "renders").glob("*.png")} for run in runs.values()]
    shared = sorted(set.intersection(*names))
    if not shared:
        _log.warning("%s: no render is common to all runs; there is no comparison picture.", scene)
        return
    view = shared[len(shared) // 2]
    try:
        tiles = {method: np.asarray(read_image(run.folder / "renders" / view)) for method, run in runs.items()}
    except DataError as error:
        _log.warning("%s; there is no comparison picture.", error)
        return
    if len({tile.shape for tile in tiles.values()}) > 1:
        _log.warning("%s: the runs rendered at different sizes; there is no comparison picture.", scene)
        return
    captions = {method: f"mean of its views: {run.scores['ours']['psnr']:.2f} dB" for method, run in runs.items()}
    pictures.comparison(path, tiles, captions, f"{scene} · {Path(view).stem}")
