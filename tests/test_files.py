"""A file is whole or as it was before; numbers that JSON does not have become null."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from clear_strategies import files


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    target = tmp_path / "results.json"
    files.write_text(target, "old")

    def interrupted(descriptor: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        files.write_text(target, "new")
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_processes_of_one_number_in_two_containers_do_not_write_into_one_file(tmp_path: Path) -> None:
    with files.replacing(tmp_path / "sr.png") as first, files.replacing(tmp_path / "sr.png") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "sr.png").read_text() == "first"  # the context that ends last
    assert list(tmp_path.iterdir()) == [tmp_path / "sr.png"]


def test_missing_folders_are_made_and_an_old_file_is_replaced_whatever_the_length_of_its_name(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / f"{'ω' * 125}.txt"  # the longest that a disk takes
    files.write_text(target, "1")
    files.write_text(target, "ω̃ = 2")
    assert target.read_text(encoding="utf-8") == "ω̃ = 2"
    assert list(target.parent.iterdir()) == [target]


def test_json_has_null_where_a_number_is_not_finite(tmp_path: Path) -> None:
    value = {"a": [math.nan, 1.5, (math.inf,)], "b": {"c": -math.inf, 3: "λ"}}
    files.write_json(tmp_path / "v.json", value)
    assert json.loads((tmp_path / "v.json").read_text(encoding="utf-8")) == {
        "a": [None, 1.5, [None]],
        "b": {"c": None, "3": "λ"},
    }
