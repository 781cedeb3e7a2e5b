"""Curves show everything that was measured and nothing else."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from clear_strategies.outputs.curves import write_curves
from tests.helpers.image_files import read


def history(n: int = 100, **columns: float) -> list[dict[str, float]]:
    return [{"t": float(t), **{name: value + 0.1 * t / n for name, value in columns.items()}} for t in range(1, n + 1)]


@pytest.mark.parametrize(
    "rows",
    [
        [], history(1, loss_lr=0.1), history(loss_lr=0.1), history(loss_lr=0.0, conflict=math.nan),
        history(loss_lr=0.1, loss_base=0.2, loss_hf=0.05, conflict=0.3, conflict_means=0.2, mean_q=0.9, corrected=0.1),
        [*history(5, loss_lr=0.1), {"t": 6.0, "loss_lr": math.inf, "psnr_test": 20.0, "n_gaussians": 100.0}],
    ],
    ids=["nothing", "one iteration", "LR alone", "zeros and NaN", "everything", "an infinity"],
)  # fmt: skip
@pytest.mark.filterwarnings("error", "ignore::DeprecationWarning")
def test_curves_draw_whatever_was_measured(tmp_path: Path, rows: list[dict[str, float]]) -> None:
    marks = {"HR from": 5, "HR full": 30, "opacity reset": 30, "anchor": 50}
    write_curves(tmp_path / "curves.png", rows, marks, "scene · strategy")
    assert read(tmp_path / "curves.png").shape == (800, 1500, 3)


def test_a_measured_column_is_drawn_and_an_unknown_one_is_not(tmp_path: Path) -> None:
    histories = {
        "plain": history(loss_lr=0.1),
        "measured": history(loss_lr=0.1, conflict=0.4),
        "unknown": history(loss_lr=0.1, weather=0.4),
    }
    for name, rows in histories.items():
        write_curves(tmp_path / f"{name}.png", rows, {}, "scene")
    plain, measured, unknown = (read(tmp_path / f"{name}.png") for name in ("plain", "measured", "unknown"))
    assert not np.array_equal(plain, measured)
    assert np.array_equal(plain, unknown)
