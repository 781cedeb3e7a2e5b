"""Training from Python: what `train` returns."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import clear_strategies as cs
from clear_strategies.errors import DataError, SettingError
from tests.helpers.command_line import TINY


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> cs.Run:
    folder = tmp_path_factory.mktemp("notebook") / "run"
    threads = torch.get_num_threads()
    made = cs.train(None, *TINY, "fit.checkpoint_every=0", "prior=bicubic", folder=folder)
    assert torch.get_num_threads() == threads
    return made


def test_a_run_has_its_numbers_and_its_gaussians_by_gsplats_names(run: cs.Run) -> None:
    n = run.metrics["gaussians"]
    widths = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (3, 3)}
    assert {name: tuple(rows.shape) for name, rows in run.splats.items()} == {k: (n, *w) for k, w in widths.items()}
    assert {"pseudo_views", "fading_opacity"} <= set(run.metrics["strategies"])  # best, unless another is chosen
    assert {"+strategy=best", "prior=bicubic"} <= set(run.metrics["overrides"])
    assert "threads" in (run.folder / "run.log").read_text()  # a line that the console shows with -v alone


def test_it_renders_what_the_run_rendered_and_from_anywhere_else(run: cs.Run) -> None:
    camera = run.cameras[0]
    picture = run.render()
    assert picture.shape == (camera.height, camera.width, 3)
    pose = camera.world_to_camera.clone()
    pose[0, 3] += 0.3
    moved = run.render(replace(camera, world_to_camera=pose))
    assert not torch.equal(moved, picture)


def test_a_folder_without_a_finished_run_and_a_wrong_setting_are_told(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no run has finished here"):
        cs.Run(tmp_path)
    with pytest.raises(SettingError, match="iteration"):
        cs.train(None, "fit.iteration=3", folder=tmp_path / "run")
    with pytest.raises(SettingError, match=r"data\.save_lr: must be null, since .* on the command line"):
        cs.train(None, f"data.save_lr={tmp_path / 'lr'}", folder=tmp_path / "run")
    for key, value in (("hydra.run.dir", tmp_path / "elsewhere"), ("hydra/launcher", "basic")):
        with pytest.raises(SettingError, match=rf"{key}: must be left out, .*folder=… is for its files"):
            cs.train(None, "fit.iterations=1", f"{key}={value}", folder=tmp_path / "run")
    assert not (tmp_path / "lr").exists()
    assert not (tmp_path / "run").exists()
    with pytest.raises(SettingError, match="is not there"):
        cs.train(tmp_path / "nothing")
