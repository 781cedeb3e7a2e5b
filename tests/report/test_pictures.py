"""A comparison shows all runs, and enlarges the window where they differ; charts draw what was measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from clear_strategies.report.pictures import write_charts, write_comparison
from tests.helpers.image_files import array, holds, read


def test_a_comparison_enlarges_the_part_where_runs_differ_most(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    other = base.copy()
    other[32:48, 120:180] = array(1, 16, 60)  # a quarter of the size each way, on the grid of windows
    other[0, 0] = 1 - other[0, 0]
    write_comparison(
        tmp_path / "c.png", {"one": base, "two": other}, {"one": "20 dB"}, "scene · view", truth := array(2, 64, 240)
    )
    drawn = read(tmp_path / "c.png")
    for tile in (base, other, truth):
        assert holds(drawn, tile[32:48, 120:180], times=4)


def test_equal_runs_and_a_single_run_are_compared_at_the_centre(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    for tiles in ({"one": base}, {"one": base, "two": base}):
        write_comparison(tmp_path / "c.png", tiles, {}, "scene · view")
        assert holds(read(tmp_path / "c.png"), base[24:40, 90:150], times=4)


def test_many_runs_go_to_more_lines_and_long_names_are_wrapped(tmp_path: Path) -> None:
    tiles = {f"run {i}, objective.lambda_hr.peak=0.0, objective.lambda_hr.final=0.0": array(i) for i in range(8)}
    write_comparison(tmp_path / "c.png", tiles, {}, "scene · view")
    drawn = read(tmp_path / "c.png")
    assert drawn.shape[1] < 7 * 260
    assert drawn.shape[0] > 2 * 2 * 160


def history(**columns: float) -> list[dict[str, float]]:
    return [{"t": float(t), "seconds": t / 2, **{k: v + t / 200 for k, v in columns.items()}} for t in range(1, 21)]


@pytest.mark.filterwarnings("error")
def test_runs_without_history_are_not_drawn_and_dollars_are_no_mathematics(tmp_path: Path) -> None:
    runs = {f"run {i} $20_$": history(psnr_test=20.0 + i, conflict=0.1 * i, n_gaussians=100.0) for i in range(9)}
    for name, shown in {"nine": runs, "ten": {**runs, "empty": []}, "none": {"empty": []}}.items():
        write_charts(tmp_path / f"{name}.png", shown, "$20_$")
    nine, ten, none = (read(tmp_path / f"{name}.png") for name in ("nine", "ten", "none"))
    assert np.array_equal(nine, ten)
    assert not np.array_equal(nine, none)
