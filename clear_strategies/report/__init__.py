"""`python -m clear_strategies.report DIR …`: runs as a table, comparisons and a page.

Every folder at or below DIR with a metrics.json is a run. Runs of a scene that differ only in their seed share a row. A
baseline that trained beside runs (`fit.baseline`) counts once. Files:

- report.md, report.csv: the table
- report.html: the table, images, maps and charts, in one file that needs no network
- comparison_SCENE.png: one test view of all methods, enlarged where they differ most
- curves_SCENE.png: PSNR, conflict and number of Gaussians over iterations, and PSNR over training time
"""

from __future__ import annotations

import argparse
import logging
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from clear_strategies import console, files
from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import ClearError, DataError
from clear_strategies.outputs.figures import save_png
from clear_strategies.report import charts, page
from clear_strategies.report.comparison import write_comparison
from clear_strategies.report.published import PAPER
from clear_strategies.report.rows import Row, compare
from clear_strategies.report.runs import Run, collect, history
from clear_strategies.report.table import Table, aligned, layout, record

__all__ = ["Row", "Run", "Table", "aligned", "collect", "compare", "layout", "main", "write"]

_log = logging.getLogger(__name__)

_LONGEST: Final = 60  # characters of a scene in the name of a file


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 0, or 2 where there is nothing to report."""
    parser = argparse.ArgumentParser(
        prog="python -m clear_strategies.report", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR", help="a run's folder, or a folder of runs")
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="where the report goes (default: the first DIR)")
    parser.add_argument(
        "--paper", choices=sorted(PAPER), help="show the numbers of this table of the paper beside ours"
    )
    parser.add_argument(
        "--page-mb", type=float, default=page.BUDGET_MB, metavar="MB", help="size limit of report.html (%(default)s)"
    )
    options = parser.parse_args(arguments)
    console.show()
    out = options.out or options.folders[0]
    try:
        text = write(collect(options.folders), out, paper=options.paper, page_mb=options.page_mb)
    except (ClearError, OSError) as error:
        _log.error("%s", error)
        return 2
    encoding = sys.stdout.encoding or "utf-8"
    sys.stdout.write(text.encode(encoding, "replace").decode(encoding))  # a terminal may lack ↑
    return 0


def write(runs: Sequence[Run], out: Path, *, paper: str | None = None, page_mb: float = page.BUDGET_MB) -> str:
    """Write the files of a report into `out`; returns the text of report.md.

    Args:
        paper: a key of `PAPER`, whose table stands beside ours.
        page_mb: size limit of report.html, 10⁶ bytes; the page shows fewer views where not all fit.
    """
    published = None if paper is None else PAPER[paper]
    rows = compare(runs)

    def table(shown: Sequence[Row], noted: Sequence[Row] = rows) -> Table:
        if published is None:
            return layout(shown)
        return layout(shown, beside=published.columns(shown), notes=published.notes(noted))

    text = table(rows).markdown
    files.write_text(out / "report.md", text)
    records = [record(row) for row in rows]
    if published is not None:
        records = [ours | theirs for ours, theirs in zip(records, published.records(rows), strict=True)]
    files.write_csv(out / "report.csv", records, list(dict.fromkeys(key for line in records for key in line)))

    sections = []
    if averages := [row for row in rows if row.is_average]:
        sections.append(page.Section("average over scenes", table(averages)))
    for scene, name in _file_names(run.scene for run in runs).items():
        of_scene = [row for row in rows if row.scene == scene]
        shown = {row.method: row.runs[0] for row in of_scene if not row.is_baseline}  # of several seeds the first
        _compare_renders(out / f"comparison_{name}.png", scene, shown)
        figure = charts.draw_runs({method: history(run.folder) for method, run in shown.items()}, scene)
        save_png(figure, out / f"curves_{name}.png")
        skipped = page.skipped_work(shown)
        sections.append(page.Section(scene, table(of_scene, of_scene), shown, charts.as_svg(figure), skipped))
    size = page.write_page(out / "report.html", sections, budget_mb=page_mb)
    _log.info("report of %d runs: %s (report.html, %.1f MB, opens in any browser)", len(runs), out, size / 1e6)
    return text


def _file_names(scenes: Iterable[str]) -> dict[str, str]:
    """A short word for each scene, no two alike."""
    words: dict[str, str] = {}
    for scene in dict.fromkeys(scenes):
        word = re.sub(r"\W+", "_", scene).strip("_")[:_LONGEST] or "scene"
        while word in words.values():
            word += "_"
        words[scene] = word
    return words


def _compare_renders(path: Path, scene: str, runs: Mapping[str, Run]) -> None:
    """The comparison of a test view that all runs rendered."""
    names = [{file.name for file in (run.folder / "renders").glob("*.png")} for run in runs.values()]
    shared = sorted(set.intersection(*names))
    if not shared:
        _log.warning("%s: no render is common to all runs, so there is no comparison image.", scene)
        return
    view = shared[len(shared) // 2]
    try:
        tiles = {method: np.asarray(read_image(run.folder / "renders" / view)) for method, run in runs.items()}
    except DataError as error:
        _log.warning("%s; there is no comparison image.", error)
        return
    if len({tile.shape for tile in tiles.values()}) > 1:
        _log.warning("%s: the runs rendered at different sizes, so there is no comparison image.", scene)
        return
    captions = {method: f"mean of its views: {run.scores['ours']['psnr']:.2f} dB" for method, run in runs.items()}
    write_comparison(path, tiles, captions, f"{scene} · {Path(view).stem}")
