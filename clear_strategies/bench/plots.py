"""Figures from the tables: time against error, and time against quality."""

from __future__ import annotations

import textwrap

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


def time_against_quality(probes: pd.DataFrame) -> Figure:
    """Seconds of training against PSNR: one panel per scene, one colour per variant, one line per seed; upper left is better.

    Args:
        probes: the table `seconds_probes`.
    """
    scenes = list(probes["scene"].unique())
    figure = Figure(figsize=(1.2 + 3 * len(scenes), 4.2), layout="constrained")
    axes = figure.subplots(1, len(scenes), squeeze=False)[0]
    colours = {variant: f"C{i}" for i, variant in enumerate(probes["variant"].unique())}
    for axis, scene in zip(axes, scenes, strict=True):
        for (variant, seed), rows in probes[probes["scene"] == scene].groupby(["variant", "seed"], sort=False):
            name = textwrap.fill(variant, 48 * len(scenes))
            label = None if name in axis.get_legend_handles_labels()[1] else name
            axis.plot(rows["training_s"], rows["psnr"], "o-", markersize=3, color=colours[variant], label=label)
            axis.annotate(
                f"{seed}", tuple(rows[["training_s", "psnr"]].iloc[-1]), (4, 0), textcoords="offset points", fontsize=7
            )
        axis.set(title=scene, xlabel="seconds of training")
        axis.grid(alpha=0.25)
    axes[0].set_ylabel("PSNR of the test views, dB")
    handles, names = axes[0].get_legend_handles_labels()
    beside = max(1, 40 * len(scenes) // max(map(len, names)))  # columns that the width holds
    figure.legend(handles, names, loc="outside lower left", fontsize=8, ncols=min(beside, len(names)))
    return figure
