"""The paper's figures from finished runs, and the table of experiment=training_time: `python docs/figures.py NAME SWEEP`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from style import save  # beside this file

from clear_strategies.data.photo_files import read_image
from clear_strategies.errors import DataError
from clear_strategies.outputs.figures import SheetRow, write_contact_sheet
from clear_strategies.report.paper import data_of
from clear_strategies.report.runs import FinishedRun


def write_training_time(runs: Sequence[FinishedRun], csv: Path) -> str:
    """Write the CSV file of experiment=training_time: PSNR of the test views over CPU seconds of training.

    Returns:
        A Markdown table: the seconds of each stage, and those until a method is as good as the worst at its end.
    """
    names, seeds, tables, stages = lines_of(runs), {run.seed for run in runs}, [], {}
    for run in runs:
        name = f"{names[run]}, seed {run.seed}" if len(seeds) > 1 else names[run]
        history = table_of(run, "history.csv", "t", "psnr_test", "processor_seconds")
        probed = history.dropna(subset="psnr_test")
        seconds, psnr = probed["processor_seconds"].round(1), probed["psnr_test"].round(3)
        tables.append(pd.DataFrame({"scene": run.scene, "method": name, "CPU seconds": seconds, "PSNR (dB)": psnr}))
        iterations = table_of(run, "timing.csv", "stage", "runs").set_index("stage")["runs"]
        whole = history["processor_seconds"].iloc[-1]
        first = history[history["t"] <= iterations.get("first stage", 0)]["processor_seconds"].max()
        stages[run.scene, name] = [whole] if pd.isna(first) else [first, whole - first]
    table = pd.concat(tables)
    table.to_csv(csv, index=False)
    lines = ["| scene | method | CPU seconds | PSNR (dB) | seconds to equal PSNR |", "|---|---|---|---|---|"]
    for scene, of_scene in table.groupby("scene", sort=False):
        curves = of_scene.groupby("method", sort=False)
        equal = curves["PSNR (dB)"].max().min()
        for method, curve in curves:
            seconds, psnr = curve["CPU seconds"], curve["PSNR (dB)"]
            until, took = seconds[psnr >= equal].iloc[0], " + ".join(f"{s:.0f}" for s in stages[scene, method])
            lines.append(f"| {scene} | {method} | {took} | {psnr.iloc[-1]:.2f} | {until:.0f}, to {equal:.2f} dB |")
    return "\n".join(lines) + "\n"


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


def draw_conflict(axes: Any, table: pd.DataFrame, x: str, **style: Any) -> None:
    """The share of Gaussians in conflict over `x`, a line for each of the table's column `line`."""
    for line, of_line in averaged(table, "line", x).groupby("line", sort=False):
        points = of_line.sort_values(x)
        axes.plot(points[x], points["conflict"], label=line, **style)
    axes.set_ylabel("Gaussians in conflict")


def figure1b(runs: Sequence[FinishedRun], folder: Path) -> None:
    """The share of Gaussians in conflict by the number of training views."""
    lines = lines_of(runs)
    rows = [
        {"line": lines[run], "views": views_of(run), "scene": run.scene, "conflict": run.numbers["conflict"]}
        for run in runs
    ]
    figure, axes = plt.subplots(figsize=(4, 2.6))
    draw_conflict(axes, pd.DataFrame(rows), "views", marker="o", markersize=4)
    axes.set_xlabel("training views")
    axes.legend()
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
    all_axes[1].legend(fontsize=6, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.3))
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
        whole = conflict["t"].max() + 1  # scenes may differ in it
        part = (conflict["t"] * parts // whole + 0.5) / parts
        tables.append(conflict.assign(line=line, scene=run.scene, part=part))
    figure, axes = plt.subplots(figsize=(5, 2.8))
    draw_conflict(axes, pd.concat(tables), "part")
    axes.set_xlabel("part of the training")
    axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
    save(figure, folder / "figure5.svg")
    figure3([run for run in runs if run.seed == runs[0].seed], folder, "figure5_views")


DRAWN: Final = {draw.__name__: draw for draw in (figure1b, figure1c, figure3, figure5)}
