"""Figures from the tables: time against error, and time against quality."""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure


def time_against_error(time: pd.DataFrame, error: pd.DataFrame) -> Figure:
    """One panel per scene, one line per backend through its presets; lower left is better.

    Args:
        time, error: the tables `rasterizers_time` and `rasterizers_error`.
    """
    without_cut_offs = error[error["truth"] == "no cut-offs"]
    rows = time.merge(without_cut_offs, on=["scene", "backend", "module", "preset"])
    rows["module"] = rows["module"].fillna("")  # empty in a CSV
    rows["ms"] = rows["forward_ms"] + rows["backward_k1_ms"]
    scenes = list(rows["scene"].unique())
    figure = Figure(figsize=(1.2 + 3 * len(scenes), 3.6), layout="constrained")
    axes = figure.subplots(1, len(scenes), squeeze=False, sharey=True)[0]
    for axis, scene in zip(axes, scenes, strict=True):
        for names, of_backend in rows[rows["scene"] == scene].groupby(["backend", "module"], sort=False):
            axis.semilogy(
                of_backend["ms"], of_backend["means_relative"], "o-", markersize=4, label=" ".join(filter(None, names))
            )
            for row in of_backend.itertuples():
                point = (row.ms, row.means_relative)
                axis.annotate(row.preset, point, (6, 4), textcoords="offset points", fontsize=8, color="gray")
        axis.set(title=scene, xlabel="forward + backward, ms")
        axis.margins(x=0.25, y=0.15)
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("error of the gradient of the means,\nrelative L2, against float64")
    axes[0].legend()
    return figure


def time_against_quality(pareto: pd.DataFrame, title: str) -> Figure:
    """Seconds of training against PSNR, one colour per kind of variant; upper left is better.

    Args:
        pareto: the table `pareto`.
    """
    figure = Figure(figsize=(9, 5.6), layout="constrained")
    axis = figure.subplots()
    front = pareto[pareto["front"]]
    axis.plot(front["seconds"], front["psnr"], color="black", linewidth=1, label="front")
    for i, (_, rows) in enumerate(pareto.groupby("kind", sort=False)):
        for marker, row in zip("osD^vPX*", rows.itertuples(), strict=False):
            axis.errorbar(
                row.seconds, row.psnr, row.psnr_std, row.seconds_std, fmt=marker, color=f"C{i}", elinewidth=0.7,
                label=row.variant,
            )  # fmt: skip
    axis.set(title=title, xlabel="seconds of training", ylabel="PSNR of the test views, dB")
    axis.grid(alpha=0.25)
    figure.legend(loc="outside right center")
    return figure
