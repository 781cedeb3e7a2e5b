"""`fit.viewer=true` and `fit.log=tensorboard` show a run while it trains, and change nothing of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from clear_strategies.errors import SettingError
from clear_strategies.outputs import tensorboard
from tests.helpers.command_line import TINY, run

SMALL = [*TINY, "fit.probe_every=5000", "fit.threads=1", "prior=bicubic", "+strategy=gco"]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., tuple[Path, str]]:
    """Trains with some overrides; gives the folder and what was said."""
    cwd = tmp_path_factory.mktemp("watched")

    def train(name: str, *overrides: str) -> tuple[Path, str]:
        done = run(*SMALL, *overrides, f"hydra.run.dir={name}", cwd=cwd)
        assert done.returncode == 0, done.stderr
        return cwd / name, done.stdout + done.stderr

    return train


@pytest.fixture(scope="module")
def plain(trained) -> Path:
    """A run that nothing watches."""
    folder, said = trained("plain")
    assert not (folder / "tensorboard").exists()
    assert "look while it trains" not in said
    return folder


@pytest.mark.slow
def test_a_run_with_a_viewer_has_the_bits_of_one_without(trained, plain):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    folder, said = trained("viewed", "fit.viewer=true")
    assert "look while it trains: http://127.0.0.1:" in said
    assert (folder / "point_cloud.ply").read_bytes() == (plain / "point_cloud.ply").read_bytes()


@pytest.mark.slow
def test_numbers_and_pictures_are_logged_and_the_run_has_the_bits_of_one_without(trained, plain):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder, _ = trained("logged", "fit.log=tensorboard")
    assert (folder / "point_cloud.ply").read_bytes() == (plain / "point_cloud.ply").read_bytes()

    log = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0, "images": 0}).Reload()
    tags = log.Tags()
    expected = {"loss/lr", "loss/base", "psnr/train_lr", "psnr/test", "n/gaussians", "conflict", "conflict/means"}
    assert expected <= set(tags["scalars"]), tags["scalars"]
    assert [event.step for event in log.Scalars("loss/lr")] == list(range(1, 13))
    history = (folder / "history.csv").read_text().splitlines()
    column = history[0].split(",").index("loss_lr")
    assert [event.value for event in log.Scalars("loss/lr")] == pytest.approx(
        [float(row.split(",")[column]) for row in history[1:]], rel=1e-6
    )
    (view,) = tags["images"]
    assert [event.step for event in log.Images(view)] == [6, 12]
    assert view in json.loads((folder / "metrics.json").read_text())["test"]["views"]


def test_without_the_package_the_extra_is_named_before_anything_is_read(monkeypatch):
    monkeypatch.setattr(tensorboard, "find_spec", lambda _: None)
    with pytest.raises(SettingError, match=r"pip install 'clear-strategies\[log\]'"):
        tensorboard.require_tensorboard()
