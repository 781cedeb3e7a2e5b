"""The pictures of the documentation.

python docs/figures.py                     those of the evidence pages, from their CSV files
python docs/figures.py training_time SWEEP   that of experiment=training_time, its CSV file and its table
python docs/figures.py figure1b SWEEP …    the paper's figure of that name from your own runs, into the first SWEEP: also figure1c
                                           (of multirun/table1, table2 and table3, say), figure3 and figure5
python docs/figures.py demo [OVERRIDE …]   the first tutorial's: trains the demo without strategies and with clear
python docs/figures.py host                the README's: trains in a gsplat loop, without strategies and with best
python docs/figures.py notebook            runs docs/tutorial/notebook.ipynb and keeps the outputs of its cells
"""

from __future__ import annotations

import base64
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import matplotlib.pyplot as plt
import pandas as pd
import sweep_figures  # beside this file, as style
from style import save

from clear_strategies.errors import ClearError
from clear_strategies.report.runs import collect

DOCS: Final = Path(__file__).resolve().parent
GREY: Final = "0.6"


def csv_file(name: str) -> Path:
    return DOCS / "data" / "evidence" / f"{name}.csv"


def table(name: str) -> pd.DataFrame:
    return pd.read_csv(csv_file(name))


def measured(cells: pd.Series) -> tuple[pd.Series, pd.Series]:
    """The first number of each cell, and the one after ±; 0 without one."""
    parts = cells.str.extract(r"([-+.\d]+)(?:.*± ([.\d]+))?").astype(float)
    return parts[0], parts[1].fillna(0)


def ablation(folder: Path) -> None:
    rows = table("ablation").dropna(subset="Δ")
    methods, scenes = list(rows["method"].unique())[1:], list(rows["scene"].unique())
    figure, axes = plt.subplots(figsize=(7, 3))
    for k, scene in enumerate(scenes):
        gains, errors = measured(rows[rows["scene"] == scene].set_index("method")["Δ"].loc[methods])
        average = scene.startswith("average")
        axes.errorbar(
            [i + 0.11 * (k - (len(scenes) - 1) / 2) for i in range(len(methods))],
            gains,
            errors,
            fmt="D" if average else "o",
            color="black" if average else None,
            markersize=6 if average else 4,
            elinewidth=1,
            label=scene,
        )
    axes.axhline(0, color=GREY, linewidth=1)
    axes.set_xticks(range(len(methods)), methods)
    axes.set_ylabel("Δ PSNR over the baseline, dB")
    axes.legend(ncols=3)
    save(figure, folder / "evidence_ablation.svg")


def skips(folder: Path) -> None:
    rows = table("skips").query("scene != 'average'")
    figure, axes = plt.subplots(figsize=(7, 2.6))
    for (_, row), error in zip(rows.iterrows(), measured(rows["Δ"])[1], strict=True):
        seconds = row[["seconds, all drawn", "seconds, default skips"]]
        gain = row["PSNR, default skips"] - row["PSNR, all drawn"]
        (line,) = axes.plot(seconds, [0, gain], marker="o", label=row["scene"])
        axes.errorbar(seconds.iloc[1], gain, error, color=line.get_color(), elinewidth=1)
    axes.axhline(0, color=GREY, linewidth=1, zorder=0)
    axes.set(xlabel="seconds (right: everything drawn, left: default skips)", ylabel="Δ PSNR, dB")
    axes.legend()
    save(figure, folder / "evidence_skips.svg")


def best(folder: Path) -> None:
    rows = table("best_today")
    figure, axes = plt.subplots(figsize=(7, 2.4))
    places, (gains, errors), (psnr, _) = range(len(rows)), measured(rows["Δ best"]), measured(rows["baseline"])
    colors = ["black" if scene.startswith("average") else "C0" for scene in rows["scene"]]
    axes.bar(places, gains, yerr=errors, color=colors, width=0.6)
    axes.axhline(0, color=GREY, linewidth=1)
    axes.set_xticks(places, [f"{scene}\n{dB:.2f} dB" for scene, dB in zip(rows["scene"], psnr, strict=True)])
    axes.set_ylabel("Δ PSNR of best, dB")
    save(figure, folder / "evidence_best.svg")


def hosts(folder: Path) -> None:
    rows = table("hosts_best").query("scene == 'both'")
    means = rows.groupby(["host", "points", "strategies"])["PSNR at HR (dB)"].last().astype(float)  # of several dates
    names = list(rows["host"].unique())
    series = (("own", "none"), ("stereo", "clear"), ("stereo", "best"))
    figure, axes = plt.subplots(figsize=(7, 2.4))
    for k, (points, strategies) in enumerate(series):
        heights = [means[name, points, strategies] for name in names]
        label = "alone, its own points" if strategies == "none" else f"{strategies}, from stereo"
        axes.bar([i + 0.25 * (k - 1) for i in range(len(names))], heights, width=0.23, label=label)
    axes.set_xticks(range(len(names)), names)
    axes.set(ylim=(14, None), ylabel="PSNR at HR, dB")
    axes.legend(ncols=3, loc="upper left", bbox_to_anchor=(0, 1.16))
    save(figure, folder / "evidence_hosts.svg")


def conflict(folder: Path) -> None:
    """The share of Gaussians whose LR and HR gradients oppose: by the number of views, and in training."""
    figure, (by_views, in_training) = plt.subplots(1, 2, figsize=(7, 2.6))
    for axes, name, x in ((by_views, "conflict_by_views", "views"), (in_training, "conflict_in_training", "iteration")):
        for method, rows in table(name).groupby("method", sort=False):
            axes.plot(rows[x], rows["conflict"], marker="o" if x == "views" else None, markersize=4, label=method)
        axes.set_xlabel(f"training {x}" if x == "views" else x)
        axes.legend()
    by_views.set_ylabel("Gaussians in conflict")
    save(figure, folder / "evidence_conflict.svg")


def training_time(folder: Path) -> None:
    """PSNR of the test views against CPU seconds of training, of one stage and of two."""
    scenes = table("training_time").groupby("scene", sort=False)
    figure, all_axes = plt.subplots(1, len(scenes), figsize=(7, 2.4), squeeze=False)
    for axes, (scene, of_scene) in zip(all_axes[0], scenes, strict=True):
        for method, run in of_scene.groupby("method", sort=False):
            axes.plot(run["CPU seconds"], run["PSNR (dB)"], marker=".", label=method)
        axes.set(title=scene, xlabel="CPU seconds")
    all_axes[0][0].set_ylabel("PSNR of the test views, dB")
    all_axes[0][0].legend()
    save(figure, folder / "evidence_training_time.svg")


def main(folder: Path) -> None:
    for draw in (ablation, skips, best, hosts, conflict, training_time):
        draw(folder)


# The test view of the README's picture, and the part of it that is magnified: left, top, right, bottom, px.
VIEW: Final = "demo_08"
PART: Final = (10, 24, 122, 108)
TEST: Final = 3  # of the demo's test views


def demo(folder: Path, *overrides: str) -> None:
    with tempfile.TemporaryDirectory() as runs:
        into = [f"hydra.sweep.dir={runs}", "hydra.sweep.subdir=${hydra.job.num}"]
        command = [sys.executable, "-m", "clear_strategies.run", "-m", "+strategy=baseline,clear", *overrides, *into]
        subprocess.run(command, cwd=DOCS.parent, check=True)  # noqa: S603 - this interpreter
        readme_picture(Path(runs) / "0", Path(runs) / "1", folder / "demo.png")


def readme_picture(baseline: Path, run: Path, out: Path) -> None:
    """One test view of a run and of a baseline, whole and a part, beside its LR photo, its SR image and the truth."""
    panels = {
        "LR photo": run / "views" / f"{VIEW}_lr.png",
        "SR image": run / "views" / f"{VIEW}_prior.png",
        "baseline": baseline / "renders" / f"{VIEW}.png",
        "CLEAR": run / "renders" / f"{VIEW}.png",
        "truth": run / "views" / f"{VIEW}_truth.png",
    }
    height, width, _ = plt.imread(panels["truth"]).shape
    figure, axes = plt.subplots(2, len(panels), figsize=(12, 3.8))
    for column, (title, file) in enumerate(panels.items()):
        whole, part = axes[:, column]
        for axis in (whole, part):
            axis.imshow(plt.imread(file), extent=(0, width, height, 0), interpolation="nearest")
            axis.set_axis_off()
        whole.set_title(title)
        left, top, right, bottom = PART
        whole.add_patch(
            mpl.patches.Rectangle((left, top), right - left, bottom - top, fill=False, color="white", lw=0.8)
        )
        part.set_xlim(left, right)
        part.set_ylim(bottom, top)
    figure.subplots_adjust(0, 0, 1, 0.93, wspace=0.02, hspace=0.03)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def host(out: Path) -> None:
    """A test view of the demo as gsplat's loop learns it from three LR photos, alone and with `best`."""
    import torch

    from clear_strategies.core.images import downsample
    from integration.examples.gsplat_loop import train
    from rasterizers import native

    panels: dict[str, Any] = {}
    torch.set_num_threads(1)
    with torch.no_grad():
        for title, strategies in (("gsplat's loop", None), ("the same loop with best", "best")):
            torch.manual_seed(0)
            with torch.enable_grad(), native.kernel_threads(native.threads()):
                demo, render = train(500, strategies)
            viewmat, K, truth = demo.tests[TEST]
            height, width, _ = truth.shape
            panels[title] = render(viewmat, K, width, height).clamp(0, 1)
    panels = {"at the photos' size": downsample(truth, 4), **panels, "truth": truth}
    figure, axes = plt.subplots(1, len(panels), figsize=(12, 2.5))
    for axis, (title, image) in zip(axes, panels.items(), strict=True):
        axis.imshow(image.numpy(), extent=(0, width, height, 0), interpolation="nearest")
        axis.set_title(title)
        axis.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 0.9, wspace=0.02)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def notebook(path: Path) -> None:
    """Run the cells of a notebook in an empty folder, and write it back with their outputs."""
    import nbformat
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output

    content, shell = nbformat.read(path, 4), InteractiveShell.instance()
    with tempfile.TemporaryDirectory() as empty:
        os.chdir(empty)  # the process ends with this
        for count, cell in enumerate((cell for cell in content.cells if cell.cell_type == "code"), start=1):
            with capture_output():
                result = shell.run_cell(cell.source)
            result.raise_error()
            shown, metadata = shell.display_formatter.format(result.result)
            data = {kind: base64.b64encode(x).decode() if isinstance(x, bytes) else x for kind, x in shown.items()}
            if "image/jpeg" in data:
                data.pop("image/png", None)  # eight times as large
            cell.execution_count, cell.outputs = count, []
            if result.result is not None:
                cell.outputs.append(
                    nbformat.v4.new_output("execute_result", data=data, metadata=metadata, execution_count=count)
                )
        os.chdir(DOCS)
    nbformat.write(content, path)


def command(words: Sequence[str]) -> None:
    match words:
        case []:
            main(DOCS / "images")
        case ["training_time", sweep]:
            runs = collect([Path(sweep)])
            sys.stdout.write(sweep_figures.write_training_time(runs, csv_file("training_time")))
            training_time(DOCS / "images")
        case [name, *sweeps] if name in sweep_figures.DRAWN and sweeps:
            folders = list(map(Path, sweeps))
            sweep_figures.DRAWN[name](collect(folders), folders[0])
        case ["demo", *overrides]:
            demo(DOCS / "images", *overrides)
        case ["host"]:
            host(DOCS / "images" / "host.png")
        case ["notebook"]:
            notebook(DOCS / "tutorial" / "notebook.ipynb")
        case _:
            sys.exit(__doc__)


if __name__ == "__main__":
    try:
        command(sys.argv[1:])
    except ClearError as error:
        sys.exit(str(error))
