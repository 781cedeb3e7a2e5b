"""maps/coverage.png: how many photos see each point, and photos without a pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clear_strategies.outputs import coverage
from tests.helpers import wall
from tests.helpers.image_files import read

SCENE = wall.scene(-1.0, 0.0, 1.0)


def test_a_point_is_seen_by_the_photos_whose_frame_it_lies_in(monkeypatch: pytest.MonkeyPatch) -> None:
    points, times = coverage.coverage_of(SCENE, wall.painter())
    inside = sum((abs(points[:, 0] - x) < 2.3) & (abs(points[:, 1]) < 1.5) for x in (-1.0, 0.0, 1.0))
    outside = sum((abs(points[:, 0] - x) < 2.5) & (abs(points[:, 1]) < 1.7) for x in (-1.0, 0.0, 1.0))
    assert bool(((inside <= times) & (times <= outside)).all())
    assert set(times.tolist()) == {0, 1, 2, 3}
    monkeypatch.setattr(coverage, "_MOST_POINTS", 5)
    assert 0 < len(coverage.coverage_of(SCENE, wall.painter())[0]) <= 5


def test_the_map_has_the_colours_of_its_legend_and_dollars_are_no_mathematics(tmp_path: Path) -> None:
    scene = replace(SCENE, unplaced={"b$1_$.jpg": "12 features: blurred, dark, or without texture"})
    coverage.write_coverage(tmp_path / "coverage.png", scene, wall.painter(), "toy $20_$")
    drawn = torch.from_numpy(read(tmp_path / "coverage.png").copy()).flatten(0, 1)
    for color in coverage._COLORS:
        assert int((drawn == torch.tensor(list(bytes.fromhex(color[1:])))).all(1).sum()) > 50
