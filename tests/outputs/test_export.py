"""Files for viewers hold the splat as it was measured; another program reads them."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest

from clear_strategies.commands import export
from clear_strategies.data.ply import read_gaussians
from clear_strategies.errors import SettingError


def sorted_by_x(values, x):
    return values[np.argsort(x, kind="stable")]


def test_a_ply_is_the_one_of_the_run(saved_run, tmp_path):
    folder, _ = saved_run
    export.main([str(folder), "--out", str(tmp_path / "a.ply")])
    assert (tmp_path / "a.ply").read_bytes() == (folder / "point_cloud.ply").read_bytes()
    export.main([str(folder), "--sh", "1"])
    assert read_gaussians(folder / f"{folder.name}.ply").shN.shape[1] == 3


@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="npm install -g @playcanvas/splat-transform")
def test_another_program_reads_what_is_written(saved_run, tmp_path):
    command = ["splat-transform", "-q", "-w", saved_run[0] / "point_cloud.ply", tmp_path / "back.ply"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    back, exact = read_gaussians(tmp_path / "back.ply"), saved_run[1].baked()
    assert len(back) == len(saved_run[1])
    x, order = np.sort(back.means[:, 0].numpy()), np.argsort(exact.means[:, 0].numpy())
    np.testing.assert_allclose(x, exact.means[:, 0].numpy()[order], atol=2e-3)
    opacity = sorted_by_x(back.opacities.sigmoid().numpy(), back.means[:, 0].numpy())
    np.testing.assert_allclose(opacity, exact.opacities.numpy()[order], atol=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--sh", "4"], "invalid choice"), (["--out", "a.spz"], "must end in .ply, got a.spz. splat-transform makes")],
)
def test_wrong_arguments_are_refused_in_one_line(saved_run, arguments, message):
    with pytest.raises(SettingError, match=message):
        export.main([str(saved_run[0]), *arguments])
