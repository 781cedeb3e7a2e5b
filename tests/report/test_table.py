"""The table leaves out what is empty and notes what a reader has to know."""

from __future__ import annotations

import html
from pathlib import Path

import pandas as pd

from clear_strategies import report
from tests.helpers.finished_run import make_run, table_of


def test_empty_columns_are_left_out_and_a_bar_in_a_name_does_not_break_the_table(tmp_path: Path) -> None:
    make_run(tmp_path, "+strategy=gco", conflict={}, scene="a|b")
    header, _, *lines = table_of(tmp_path).splitlines()[:5]
    assert not {"conflict", "Δ", "best"} & set(header.split())
    assert all("a\\|b" in line for line in lines)


def test_settings_that_all_runs_share_are_noted_once(tmp_path: Path) -> None:
    make_run(tmp_path / "0", "+strategy=gco", "data=llff", "fit.iterations=600")
    make_run(tmp_path / "1", "+strategy=clear", "data=llff", "fit.iterations=600")
    text = table_of(tmp_path)
    assert "All runs of demo: `data=llff fit.iterations=600`." in text
    assert text.count("data=llff") == 1


def test_a_name_is_text_and_no_markup() -> None:
    text = report.markdown(
        pd.DataFrame({"scene": ["<script>alert(1)</script>"], "method": ["a|b\nc"]}), ["All runs of x: `<img src=y>`."]
    )
    assert "<script>" not in text
    assert html.escape("<script>") in text
    assert "a\\|b c" in text
    assert "<img" not in text
