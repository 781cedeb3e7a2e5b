"""`fit.viewer=true` shows a run while it trains, and changes nothing of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.command_line import TINY, run

SMALL = [*TINY, "fit.probe_every=5000", "fit.threads=1", "prior=bicubic", "+strategy=gco"]


@pytest.mark.slow
def test_a_run_with_a_viewer_has_the_bits_of_one_without(tmp_path: Path):
    pytest.importorskip("clear_strategies.viewing.server", exc_type=ImportError)
    said = {}
    for name, overrides in {"plain": [], "viewed": ["fit.viewer=true"]}.items():
        done = run(*SMALL, *overrides, f"hydra.run.dir={name}", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        said[name] = done.stdout + done.stderr
    assert "look while it trains" not in said["plain"]
    assert "look while it trains: http://127.0.0.1:" in said["viewed"]
    viewed, plain = ((tmp_path / name / "point_cloud.ply").read_bytes() for name in ("viewed", "plain"))
    assert viewed == plain
