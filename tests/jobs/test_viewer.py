"""`fit.viewer=true` opens a viewer and changes nothing of the run."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.jobs.saved import open_splat
from tests.helpers.command_line import TINY, run

SMALL = [
    *TINY,
    "fit.map_views=0",
    "fit.video=0",
    "fit.probe_every=0",
    "fit.threads=1",
    "prior=bicubic",
    "+strategy=gco",
]


@pytest.mark.slow
def test_a_run_that_is_watched_has_the_bits_of_one_that_is_not(tmp_path):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    fields = []
    for viewer in ("true", "false"):
        folder = tmp_path / viewer
        done = run(*SMALL, f"fit.viewer={viewer}", f"hydra.run.dir={folder}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert ("look while it trains: http://127.0.0.1:" in done.stdout + done.stderr) == (viewer == "true")
        splat = open_splat(folder)
        assert [saved.split for saved in splat.cameras][:2] == ["train", "train"]
        fields.append(splat.painter.field.raw())
    assert all(torch.equal(fields[0][name], fields[1][name]) for name in fields[0])
