"""coverage.png and coverage.html: shares that add up, and photos without a pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clear_strategies.outputs import coverage
from tests.helpers import wall

SCENE = wall.scene(-1.0, 0.0, 1.0)


def test_what_a_photo_shows_is_seen_by_it_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coverage, "_MOST_POINTS", 5)  # many points are thinned
    found = coverage.coverage_of(SCENE, wall.painter())
    assert list(found.shares) == [view.name for view in SCENE.train]
    assert all(sum(share) == pytest.approx(1) for share in found.shares.values())
    assert int(found.times.max()) <= len(SCENE.train)
    assert found.shares["photo1"][2] > 0.5
    assert 0 < len(found.points) <= 5
    assert found.times.shape == found.points.shape[:1]


def test_the_picture_names_photos_without_a_pose_and_the_page_is_whole(tmp_path: Path) -> None:
    train = tuple(replace(view, name=f"a${i}_$.png") for i, view in enumerate(SCENE.train))  # $ is no mathematics
    scene = replace(SCENE, train=train, unplaced={"b$1_$.jpg": "12 features: blurred, dark, or without texture"})
    text = "\n".join(coverage._lines(coverage.coverage_of(scene, wall.painter()), scene))
    assert "b$1_$.jpg: 12 features" in text
    assert all(view.name in text for view in train)
    coverage.write_coverage(tmp_path, scene, wall.painter(), "toy $20_$")
    assert (tmp_path / coverage.PICTURE).stat().st_size > 10_000
    pytest.importorskip("viser")
    written = (tmp_path / coverage.PAGE).read_text()
    assert "__VISER_EMBED_DATA__" in written
    assert all(f"</span> {label}</div>" in written for label in ("seen by no photo", "the photos"))


def test_a_page_that_cannot_be_written_does_not_stop_the_run(tmp_path, monkeypatch, caplog) -> None:
    def refuse(*_: object) -> None:
        raise OSError("no loopback address")

    monkeypatch.setattr(coverage.page, "missing", lambda: None)
    monkeypatch.setattr(coverage.page, "write_points_page", refuse)
    coverage.write_coverage(tmp_path, SCENE, wall.painter(), "toy")
    assert "coverage.html could not be written: no loopback address." in caplog.text
    assert (tmp_path / coverage.PICTURE).is_file()


def test_points_have_the_colour_of_their_number_of_photos() -> None:
    colors = coverage._colored(torch.tensor([0, 1, 2, 3, 9]))
    assert (colors[3] == colors[4]).all()
    assert len({tuple(color) for color in colors}) == 4
