"""A scene in other units trains to the same picture, and what was saved of it can be looked at."""

from __future__ import annotations

import functools
from pathlib import Path

import pytest

from clear_strategies.core.points import spread
from clear_strategies.jobs import job
from clear_strategies.jobs.saved import open_splat
from tests.helpers import captures, forked
from tests.helpers.command_line import ALONE
from tests.helpers.configs import composed

SETTINGS = [
    *ALONE, "prior=bicubic", "data.views.photos_are=hr", "data.views.test_every=3", "+strategy=best", "fit.iterations=60",
    "skips=none", "fit.threads=1",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory):
    @functools.cache
    def train(scale: float) -> tuple[float, Path]:
        """PSNR of the test views, dB, and the run's folder, of a room `scale` times as large."""
        here = tmp_path_factory.mktemp("units")
        root = captures.demo_on_disk(here / "room", scale, views=6, size=(96, 72))
        words = ["data=nerfstudio", f"data.path={root}", *SETTINGS]
        with forked.not_drawn():
            return job.run(composed(*words), here / "run", words), here / "run"

    return train


@pytest.mark.parametrize("scale", [1e-5, 0.003, 100.0, 1e5])
def test_a_scene_in_other_units_gives_equal_results(scale: float, trained, caplog) -> None:
    score, folder = trained(scale)
    assert score == pytest.approx(trained(1.0)[0], abs=0.2)
    assert "near" not in caplog.text
    for saved in (folder, folder / "point_cloud.ply"):
        splat = open_splat(saved)
        assert spread(splat.painter.field.means.data) == pytest.approx(3 * scale, rel=0.5)
        image = splat.painter.color(splat.poses()[0])
        assert float(image.std()) > 0.05
