"""A comparison shows all runs, and enlarges the window where they differ."""

from __future__ import annotations

from pathlib import Path

from clear_strategies.report.comparison import write_comparison
from tests.helpers.image_files import array, holds, read


def test_a_comparison_enlarges_the_part_where_runs_differ_most(tmp_path: Path) -> None:
    base = array(0, 64, 240)
    other = base.copy()
    other[32:48, 120:180] = array(1, 16, 60)  # a quarter of the size each way, on the grid of windows
    other[0, 0] = 1 - other[0, 0]
    write_comparison(tmp_path / "c.png", {"one": base, "two": other}, {"one": "20 dB"}, "scene · view")
    drawn = read(tmp_path / "c.png")
    for tile in (base, other):
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
