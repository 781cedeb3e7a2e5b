"""`fit.log=tensorboard` writes numbers and pictures, and changes nothing of the run."""

from __future__ import annotations

import json
import sys

import pytest

from clear_strategies.errors import SettingError
from clear_strategies.outputs import tensorboard
from tests.helpers.command_line import TINY, run

SMALL = [*TINY, "fit.map_views=0", "fit.video=0", "fit.probe_every=5000", "fit.threads=1",
         "prior=bicubic", "+strategy=gco"]  # fmt: skip


@pytest.mark.slow
def test_numbers_and_pictures_are_there_and_a_resumed_run_goes_on_in_the_same_log(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    first = run(*SMALL, "fit.log=tensorboard", "hydra.run.dir=logged", "fit.iterations=12", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    plain = run(*SMALL, "hydra.run.dir=plain", "fit.iterations=12", cwd=tmp_path)
    assert plain.returncode == 0, plain.stderr
    assert not (tmp_path / "plain" / "tensorboard").exists()
    assert (tmp_path / "logged/point_cloud.ply").read_bytes() == (tmp_path / "plain/point_cloud.ply").read_bytes()

    log = EventAccumulator(str(tmp_path / "logged" / "tensorboard"), size_guidance={"scalars": 0, "images": 0}).Reload()
    tags = log.Tags()
    expected = {"loss/lr", "loss/base", "psnr/train_lr", "psnr/test", "field/n_gaussians", "conflict/conflict",
                "conflict/means", "learning rate/means", "schedule/lambda_hr"}  # fmt: skip
    assert expected <= set(tags["scalars"]), tags["scalars"]
    assert [event.step for event in log.Scalars("loss/lr")] == list(range(1, 13))
    history = (tmp_path / "logged" / "history.csv").read_text().splitlines()
    column = history[0].split(",").index("loss_lr")
    assert [event.value for event in log.Scalars("loss/lr")] == pytest.approx(
        [float(row.split(",")[column]) for row in history[1:]], rel=1e-6
    )
    (render,) = [tag for tag in tags["images"] if tag.endswith("/render")]
    assert [event.step for event in log.Images(render)] == [6, 12]
    view = render.partition("/")[0]
    assert {f"{view}/{name}" for name in ("LR photo", "SR image", "HR photo")} <= set(tags["images"])
    metrics = json.loads((tmp_path / "logged" / "metrics.json").read_text())
    assert view in metrics["test"]["views"]


def test_without_the_package_the_extra_is_named_before_anything_is_read(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.setattr(tensorboard, "find_spec", lambda _: None)
    with pytest.raises(SettingError, match=r"pip install 'clear-strategies\[log\]'"):
        tensorboard.require_tensorboard()


@pytest.mark.parametrize(
    ("column", "tag"),
    [("loss_lr", "loss/lr"), ("conflict", "conflict/conflict"), ("conflict_means", "conflict/means"),
     ("corrected", "corrected/corrected"), ("n_gaussians", "field/n_gaussians"), ("dropout", "strategies/dropout")],
)  # fmt: skip
def test_charts_are_grouped(column, tag):
    assert tensorboard._tag(column) == tag
