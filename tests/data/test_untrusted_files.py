"""Files that would hang, fill the memory or lead out of the data set, beside those of tests/stress/attacks.py."""

from __future__ import annotations

import html
from pathlib import Path

import pytest
import torch

from clear_strategies.data import ply
from clear_strategies.data.cameras import pose_from_opengl
from clear_strategies.errors import DataError
from clear_strategies.report.table import Table, aligned
from rasterizers import Camera


def test_an_ascii_ply_without_vertices_is_read(tmp_path: Path) -> None:
    path = tmp_path / "none.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    assert len(ply.read_points(path)) == 0


def test_a_camera_farther_than_float32_resolves_is_refused() -> None:
    pose = [[1.0, 0, 0, 1e17], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    with pytest.raises(DataError, match="no 3x4 or 4x4 matrix of finite numbers"):
        pose_from_opengl(Path("transforms.json"), "frames[0]", pose)


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.mul_(0),
        lambda p: p[:3, :3].mul_(2),
        lambda p: p[0].neg_(),
        lambda p: p[0, 1].add_(0.1),
        lambda p: p[3, 3].mul_(2),
    ],
    ids=["zero", "scaled", "reflected", "sheared", "last row"],
)
def test_a_pose_that_is_not_rigid_is_refused(change) -> None:
    pose = torch.eye(4)
    change(pose)
    with pytest.raises(ValueError, match="must be a rotation and a translation"):
        Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10)


def test_a_name_in_a_report_is_text_and_no_markup() -> None:
    rows = "\n".join(aligned({"scene": ["<script>alert(1)</script>"], "method": ["a|b\nc"]}))
    assert "<script>" not in rows
    assert html.escape("<script>") in rows
    assert "a\\|b c" in rows
    assert "<img" not in Table({"scene": ["x"]}, ["All runs of x: `<img src=y>`."]).markdown
