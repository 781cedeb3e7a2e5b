"""Charts of many runs."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import pytest

from clear_strategies.report import charts


def history(n: int, **columns: float) -> list[dict[str, float]]:
    return [
        {"t": float(t), "seconds": t / 2, **{k: v + 0.1 * t / n for k, v in columns.items()}} for t in range(1, n + 1)
    ]


@pytest.mark.filterwarnings("error")
def test_runs_without_history_are_not_drawn_and_no_history_says_not_measured() -> None:
    runs = {f"run {i}": history(20, psnr_test=20.0 + i, conflict=0.1 * i, n_gaussians=100.0) for i in range(9)}
    nine, ten, none = (
        charts.as_svg(charts.draw_runs(shown, "scene")) for shown in (runs, {**runs, "empty": []}, {"empty": []})
    )
    assert nine == ten
    assert all(f">{name}<" in nine for name in runs)
    assert nine.count("not measured") == 0
    assert none.count("not measured") == 4


def test_dollars_in_names_are_no_mathematics() -> None:
    assert "of $20_$" in charts.as_svg(charts.draw_runs({"gco, data.of $20_$": history(1, n_gaussians=5.0)}, "$20_$"))


def test_a_long_history_is_thinned() -> None:
    short, long = (charts.as_svg(charts.draw_runs({"run": history(n, n_gaussians=1.0)}, "scene")) for n in (200, 9_999))
    assert len(long) < 2 * len(short)


def test_the_svg_is_one_element_in_the_colours_of_the_page() -> None:
    svg = charts.as_svg(charts.draw_runs({"run & <more>": history(5, psnr_test=20.0)}, "scene"))
    ET.fromstring(svg.replace("xlink:", ""))  # noqa: S314 - our own
    assert "var(--ink)" in svg
    assert "#222222" not in svg
    assert "http" not in svg
