"""A baseline beside a run is read from its folder; what is not whole is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from clear_strategies import files
from clear_strategies.errors import DataError
from clear_strategies.outputs.baseline import Baseline
from tests.helpers.finished_run import make_run


def test_its_scores_and_its_renders_are_those_of_its_files(tmp_path: Path) -> None:
    baseline = Baseline.read(make_run(tmp_path, psnr=21.5))
    assert (baseline.means["test"].psnr, baseline.means["train"].ssim, baseline.seconds) == (21.5, 0.5, 61.7)
    assert baseline.views["view.png"].psnr == 21.5
    assert baseline.render_of("view.png") == tmp_path / "renders" / "view.png"
    assert baseline.to_json()["test"] == {"psnr": 21.5, "ssim": 0.5, "gmsd": 0.1, "blur": 0.2}


def test_a_number_that_was_not_finite_is_nan_and_a_part_without_views_has_no_mean(tmp_path: Path) -> None:
    baseline = Baseline.read(make_run(tmp_path, psnr=None, test={"against": "nothing", "views": {}, "mean": {}}))
    assert math.isnan(baseline.means["train"].psnr)
    assert set(baseline.means) == {"train"}
    assert "test" not in baseline.to_json()


@pytest.mark.parametrize("key", ["seconds", "test", "train"])
def test_damaged_metrics_are_refused_with_the_remedy(tmp_path: Path, key: str) -> None:
    path = make_run(tmp_path) / "metrics.json"
    content = json.loads(path.read_text())
    files.write_json(path, {name: value for name, value in content.items() if name != key})
    with pytest.raises(DataError, match=r"metrics\.json: .*remove this baseline's metrics.json: it is then"):
        Baseline.read(tmp_path)


def test_a_missing_render_is_refused_before_the_run_trains(tmp_path: Path) -> None:
    (make_run(tmp_path) / "renders" / "view.png").unlink()
    with pytest.raises(DataError, match=r"view\.png: file: is not there"):
        Baseline.read(tmp_path)
