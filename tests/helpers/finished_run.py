"""The folder of a finished run, as far as a report reads it."""

from pathlib import Path
from typing import Any

import pandas as pd
import torch

from clear_strategies import files, report
from clear_strategies.data.photo_files import write_png


def scores(psnr: float | None) -> dict[str, float | None]:
    return {"psnr": psnr, "ssim": 0.5, "gmsd": 0.1, "blur": 0.2}


def make_run(
    folder: Path, *overrides: str, psnr: float | None = 20.0, seed: int = 0, scene: str = "demo", bicubic: float = 18.0,
    **facts: Any,
) -> Path:  # fmt: skip
    """Write the files that run.py would."""
    mean = {"ours": scores(psnr), "bicubic": scores(bicubic), "prior": scores(bicubic + 1)}
    content = {
        "scene": scene, "strategies": ["gco"], "seed": seed, "iterations": 100, "gaussians": 1200, "seconds": 61.7,
        "conflict": {"gaussian": 0.25, "means": 0.3}, "synthetic_prior": False,
        "test": {"against": "HR photos", "views": {"view.png": {"ours": scores(psnr)}}, "mean": mean},
        "train": {"against": "HR photos", "views": {}, "mean": mean}, "provenance": {},
        "overrides": [*overrides, f"fit.seed={seed}"], **facts,
    }  # fmt: skip
    files.write_json(folder / "metrics.json", content)
    (folder / ".hydra").mkdir(exist_ok=True)
    rows = [{"t": t, "psnr_test": 15 + t, "n_gaussians": 1000 + t, "seconds": t / 2} for t in range(1, 6)]
    pd.DataFrame(rows).to_csv(folder / "history.csv", index=False)
    write_png(folder / "renders" / "view.png", torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(seed)))
    write_png(folder / "views" / "view_truth.png", torch.full((24, 32, 3), 0.5))
    return folder


def rows_of(*folders: Path) -> dict[str, pd.Series]:
    """The rows of the table by their method."""
    return {row["method"]: row for _, row in report.compare(report.collect(folders)).iterrows()}


def averages_of(folder: Path) -> pd.DataFrame:
    table = report.compare(report.collect([folder]))
    return table[table["average"]].set_index("method")


def table_of(folder: Path) -> str:
    """The table of all runs in the folder, as Markdown."""
    runs = report.collect([folder])
    table = report.compare(runs)
    return report.markdown(report.layout(table), report.notes(table, runs))


def cells(text: str) -> list[dict[str, str]]:
    """The lines of a Markdown table."""
    header, _, *lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return [{name.strip(): cell.strip() for name, cell in zip(header, line, strict=True)} for line in lines]
