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
import csv
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl

mpl.use("Agg")
mpl.rcParams.update(
    {
        "svg.hashsalt": "clear",
        "svg.fonttype": "none",
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
    }
)

import matplotlib.pyplot as plt  # noqa: E402 - after the backend was chosen
import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402

from clear_strategies.data.photo_files import read_image  # noqa: E402
from clear_strategies.errors import ClearError, DataError  # noqa: E402
from clear_strategies.outputs.figures import SheetRow, write_contact_sheet  # noqa: E402
from clear_strategies.report.paper import data_of  # noqa: E402
from clear_strategies.report.runs import FinishedRun, collect  # noqa: E402

DOCS: Final = Path(__file__).resolve().parent
GREY: Final = "0.6"


def table(name: str) -> list[dict[str, str]]:
    with (DOCS / "data" / "evidence" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def numbers(cell: str) -> list[float]:
    """The values of a cell: "+0.07, +0.19 (0.5)" holds two."""
    values = re.sub(r"\(.*?\)", "", cell).split("±")[0]
    return [float(part) for part in values.replace(",", " ").split()]


def error(cell: str) -> float:
    """The number after ±; 0 without one."""
    return float(cell.partition("±")[2] or 0)


def write(figure: Any, folder: Path, name: str) -> None:
    save(figure, folder / f"evidence_{name}.svg")


def save(figure: Any, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def ablation(folder: Path) -> None:
    rows = [row for row in table("ablation") if row["Δ"]]
    methods = list(dict.fromkeys(row["method"] for row in rows))[1:]
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, axes = plt.subplots(figsize=(7, 3))
    for k, scene in enumerate(scenes):
        gains = {row["method"]: row["Δ"] for row in rows if row["scene"] == scene}
        average = scene.startswith("average")
        axes.errorbar(
            [i + 0.11 * (k - (len(scenes) - 1) / 2) for i in range(len(methods))],
            [numbers(gains[m])[0] for m in methods],
            [error(gains[m]) for m in methods],
            fmt="D" if average else "o",
            color="black" if average else None,
            markersize=6 if average else 4,
            elinewidth=1,
            label=scene,
        )
    axes.axhline(0, color=GREY, linewidth=1)
    axes.set_xticks(range(len(methods)), methods)
    axes.set_ylabel("Δ PSNR over the baseline, dB")
    axes.legend(fontsize=7, ncols=3, frameon=False)
    write(figure, folder, "ablation")


def skips(folder: Path) -> None:
    rows = [row for row in table("skips") if row["scene"] != "average"]
    figure, axes = plt.subplots(figsize=(7, 2.6))
    for row in rows:
        seconds = [float(row["seconds, all drawn"]), float(row["seconds, default skips"])]
        psnr = [float(row["PSNR, all drawn"]), float(row["PSNR, default skips"])]
        (line,) = axes.plot(seconds, [p - psnr[0] for p in psnr], marker="o", label=row["scene"])
        axes.errorbar(seconds[1], psnr[1] - psnr[0], error(row["Δ"]), color=line.get_color(), elinewidth=1)
    axes.axhline(0, color=GREY, linewidth=1, zorder=0)
    axes.set_xlabel("seconds (right: everything drawn, left: default skips)")
    axes.set_ylabel("Δ PSNR, dB")
    axes.legend(fontsize=7, frameon=False)
    write(figure, folder, "skips")


def best(folder: Path) -> None:
    rows = table("best_today")
    figure, axes = plt.subplots(figsize=(7, 2.4))
    places, gains = range(len(rows)), [numbers(row["Δ best"])[0] for row in rows]
    colors = ["black" if row["scene"].startswith("average") else "C0" for row in rows]
    axes.bar(places, gains, yerr=[error(row["Δ best"]) for row in rows], color=colors, width=0.6)
    axes.axhline(0, color=GREY, linewidth=1)
    axes.set_xticks(places, [f"{row['scene']}\n{numbers(row['baseline'])[0]:.2f} dB" for row in rows])
    axes.set_ylabel("Δ PSNR of best, dB")
    write(figure, folder, "best")


def hosts(folder: Path) -> None:
    means = {  # the last of several
        (row["host"], row["points"], row["strategies"]): float(row["PSNR at HR (dB)"])
        for row in table("hosts_best")
        if row["scene"] == "both"
    }
    names = list(dict.fromkeys(host for host, *_ in means))
    series = (("own", "none"), ("stereo", "clear"), ("stereo", "best"))
    figure, axes = plt.subplots(figsize=(7, 2.4))
    for k, (points, strategies) in enumerate(series):
        heights = [means[name, points, strategies] for name in names]
        label = "alone, its own points" if strategies == "none" else f"{strategies}, from stereo"
        axes.bar([i + 0.25 * (k - 1) for i in range(len(names))], heights, width=0.23, label=label)
    axes.set_xticks(range(len(names)), names)
    axes.set_ylim(14, None)
    axes.set_ylabel("PSNR at HR, dB")
    axes.legend(fontsize=7, ncols=3, frameon=False, loc="upper left", bbox_to_anchor=(0, 1.16))
    write(figure, folder, "hosts")


def conflict(folder: Path) -> None:
    """The share of Gaussians whose LR and HR gradients oppose: by the number of views, and in training."""
    figure, (by_views, in_training) = plt.subplots(1, 2, figsize=(7, 2.6))
    for axes, name, x in ((by_views, "conflict_by_views", "views"), (in_training, "conflict_in_training", "iteration")):
        rows = table(name)
        for method in dict.fromkeys(row["method"] for row in rows):
            of_method = [(float(row[x]), float(row["conflict"])) for row in rows if row["method"] == method]
            axes.plot(*zip(*of_method, strict=True), marker="o" if x == "views" else None, markersize=4, label=method)
        axes.set_xlabel(f"training {x}" if x == "views" else x)
        axes.legend(fontsize=7, frameon=False)
    by_views.set_ylabel("Gaussians in conflict")
    write(figure, folder, "conflict")


def training_time(folder: Path) -> None:
    """PSNR of the test views against processor seconds of training, of one stage and of two."""
    rows = table("training_time")
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    figure, all_axes = plt.subplots(1, len(scenes), figsize=(7, 2.4), squeeze=False)
    for axes, scene in zip(all_axes[0], scenes, strict=True):
        for method in dict.fromkeys(row["method"] for row in rows):
            axes.plot(*curve(rows, scene, method), marker=".", label=method)
        axes.set_title(scene)
        axes.set_xlabel("processor seconds")
    all_axes[0][0].set_ylabel("PSNR of the test views, dB")
    all_axes[0][0].legend(fontsize=7, frameon=False)
    write(figure, folder, "training_time")


def curve(rows: list[dict[str, str]], scene: str, method: str) -> tuple[list[float], list[float]]:
    """Seconds and PSNR of a run of `training_time.csv`."""
    of_run = [row for row in rows if (row["scene"], row["method"]) == (scene, method)]
    return [float(row["processor seconds"]) for row in of_run], [float(row["PSNR (dB)"]) for row in of_run]


def collect_training_time(sweep: Path) -> None:
    """Write `training_time.csv` from the runs of experiment=training_time, and print their table."""
    tables, stages, runs_of_sweep = [], {}, collect([sweep])
    names, seeds = lines_of(runs_of_sweep), {run.seed for run in runs_of_sweep}
    for run in runs_of_sweep:
        name = f"{names[run]}, seed {run.seed}" if len(seeds) > 1 else names[run]
        history = table_of(run, "history.csv", "t", "psnr_test", "processor_seconds")
        probed = history.dropna(subset="psnr_test")
        seconds, psnr = probed["processor_seconds"].round(1), probed["psnr_test"].round(3)
        tables.append(
            pd.DataFrame({"scene": run.scene, "method": name, "processor seconds": seconds, "PSNR (dB)": psnr})
        )
        runs = table_of(run, "timing.csv", "stage", "runs").set_index("stage")["runs"]
        whole = history["processor_seconds"].iloc[-1]
        first = history[history["t"] <= runs.get("first stage", 0)]["processor_seconds"].max()
        stages[run.scene, name] = [whole] if pd.isna(first) else [first, whole - first]
    pd.concat(tables).to_csv(DOCS / "data" / "evidence" / "training_time.csv", index=False)
    rows = table("training_time")
    lines = ["| scene | method | processor seconds | PSNR (dB) | seconds to equal PSNR |", "|---|---|---|---|---|"]
    for scene in dict.fromkeys(scene for scene, _ in stages):
        curves = {method: curve(rows, scene, method) for of, method in stages if of == scene}
        equal = min(max(psnr) for _, psnr in curves.values())
        for method, (seconds, psnr) in curves.items():
            until = next(s for s, p in zip(seconds, psnr, strict=True) if p >= equal)
            took = " + ".join(f"{of_stage:.0f}" for of_stage in stages[scene, method])
            lines.append(f"| {scene} | {method} | {took} | {psnr[-1]:.2f} | {until:.0f}, to {equal:.2f} dB |")
    sys.stdout.write("\n".join(lines) + "\n")


def lines_of(runs: Sequence[FinishedRun]) -> dict[FinishedRun, str]:
    """The line of each run in a figure: its name, and the readings where they are not the same for all."""
    readings = {run: next((s for s in run.settings if s.startswith("readings=")), "") for run in runs}
    return {
        run: f"{run.name}, {of}" if of and len({*readings.values()}) > 1 else run.name for run, of in readings.items()
    }


def table_of(run: FinishedRun, name: str, *columns: str) -> pd.DataFrame:
    """These columns of a CSV file of a run; each has a number at least."""
    path = run.folder / name
    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise unfit(path, "file", f"cannot be read ({error})") from error
    if absent := [column for column in columns if column not in table or table[column].isna().all()]:
        raise unfit(path, absent[0], "has no numbers")
    return table[[*columns]]


def unfit(path: Path, field: str, problem: str) -> DataError:
    """The error for a run that a figure cannot be drawn from."""
    return DataError(path, field, problem, "give the sweep of the experiment that has the figure's name")


def averaged(table: pd.DataFrame, *by: str) -> pd.DataFrame:
    """Means over scenes of the means over seeds."""
    return table.groupby([*by, "scene"], sort=False).mean().groupby([*by], sort=False).mean().reset_index()


def figure1b(runs: Sequence[FinishedRun], folder: Path) -> None:
    """The share of Gaussians in conflict by the number of training views."""
    lines = lines_of(runs)
    rows = [
        {"line": lines[run], "views": views_of(run), "scene": run.scene, "conflict": run.numbers["conflict"]}
        for run in runs
    ]
    figure, axes = plt.subplots(figsize=(4, 2.6))
    for line, of_line in averaged(pd.DataFrame(rows), "line", "views").groupby("line", sort=False):
        points = of_line.sort_values("views")
        axes.plot(points["views"], points["conflict"], marker="o", markersize=4, label=line)
    axes.set_xlabel("training views")
    axes.set_ylabel("Gaussians in conflict")
    axes.legend(fontsize=7, frameon=False)
    save(figure, folder / "figure1b.svg")


def views_of(run: FinishedRun) -> int:
    """The number of training views that an override of the run asks for."""
    asked = (value for s in run.settings for key, _, value in [s.partition("=")] if key == "data.views.train")
    if not (number := next(asked, "")).isdecimal():
        raise unfit(run.folder, "data.views.train", "is no setting of this run")
    return int(number)


def figure1c(runs: Sequence[FinishedRun], folder: Path) -> None:
    """PSNR, SSIM and GMSD of the methods by data set."""
    scores = {"psnr": "PSNR, dB", "ssim": "SSIM", "gmsd": "GMSD"}
    lines = lines_of(runs)
    rows = [
        {
            "line": lines[run],
            "data": data_of(run) or run.scene,
            "scene": run.scene,
            **{s: run.numbers[s] for s in scores},
        }
        for run in runs
    ]
    means = averaged(pd.DataFrame(rows), "line", "data").set_index(["data", "line"])
    figure, all_axes = plt.subplots(1, len(scores), figsize=(9, 2.8))
    for axes, (score, title) in zip(all_axes, scores.items(), strict=True):
        means[score].unstack(sort=False).plot.bar(
            ax=axes, rot=0, legend=score == "ssim", xlabel="", ylabel=title, width=0.8
        )
    all_axes[1].legend(fontsize=6, frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.3))
    save(figure, folder / "figure1c.svg")


def figure3(runs: Sequence[FinishedRun], folder: Path, name: str = "figure3") -> None:
    """A test view of each scene: the LR photo, the picture of every method, the truth, and the part where they differ most."""
    sheet = []
    for scene in dict.fromkeys(run.scene for run in runs):
        of_scene = [run for run in runs if run.scene == scene]
        views = [{path.stem for path in (run.folder / "renders").glob("*.png")} for run in of_scene]
        if not (shared := sorted(set.intersection(*views))):
            raise unfit(of_scene[0].folder, "renders", f"have no view that every run of {scene} has")
        view = shared[0]
        beside = of_scene[0].folder / "views" / view
        drawn = {line: picture(run.folder / "renders" / f"{view}.png") for run, line in lines_of(of_scene).items()}
        lr, truth = picture(Path(f"{beside}_lr.png")), picture(Path(f"{beside}_truth.png"))
        if sizes := {image.shape for image in drawn.values()} - {truth.shape}:
            raise unfit(of_scene[0].folder, view, f"has several sizes in {scene}: {truth.shape}, {sizes.pop()}")
        factor = len(truth) // len(lr)
        images = {"input": lr.repeat(factor, 0).repeat(factor, 1), **drawn, "truth": truth}
        captions = {line: f"{run.numbers['psnr']:.2f} dB" for run, line in lines_of(of_scene).items()}
        sheet.append(SheetRow(scene, images, captions, drawn))
    write_contact_sheet(folder / f"{name}.png", sheet, ", ".join(row.name for row in sheet), "dB: of all test views")


def picture(path: Path) -> np.ndarray:
    return np.asarray(read_image(path))


def figure5(runs: Sequence[FinishedRun], folder: Path, parts: int = 50) -> None:
    """The share of Gaussians in conflict in training, and a test view of each rung."""
    tables = []
    for run, line in lines_of(runs).items():
        conflict = table_of(run, "conflict.csv", "t", "conflict")
        part = (
            conflict["t"] * parts // (conflict["t"].max() + 1) + 0.5
        ) / parts  # scenes may differ in their iterations
        tables.append(conflict.assign(line=line, scene=run.scene, part=part))
    figure, axes = plt.subplots(figsize=(5, 2.8))
    for line, of_line in averaged(pd.concat(tables), "line", "part").groupby("line", sort=False):
        points = of_line.sort_values("part")
        axes.plot(points["part"], points["conflict"], label=line)
    axes.set_xlabel("part of the training")
    axes.set_ylabel("Gaussians in conflict")
    axes.legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, folder / "figure5.svg")
    figure3([run for run in runs if run.seed == runs[0].seed], folder, "figure5_views")


OF_SWEEPS: Final = {draw.__name__: draw for draw in (figure1b, figure1c, figure3, figure5)}


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
        for title, strategies in (("gsplat's loop", None), ("the same loop with `best`", "best")):
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
            collect_training_time(Path(sweep))
            training_time(DOCS / "images")
        case [name, *sweeps] if name in OF_SWEEPS and sweeps:
            folders = list(map(Path, sweeps))
            OF_SWEEPS[name](collect(folders), folders[0])
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
