"""Files for viewers hold the splat as it was measured; another program reads them."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys

import numpy as np
import pytest
import torch

from clear_strategies.commands import export
from clear_strategies.data.ply import GaussianPly, read_gaussians
from clear_strategies.errors import SettingError
from clear_strategies.outputs import formats
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from tests.helpers import saved_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, saved_run.write(folder)


@pytest.fixture
def exported(run, tmp_path):
    def export_as(form):
        export.main([str(run[0]), "--to", form, "--out", str(tmp_path / f"a.{form}")])
        return tmp_path / f"a.{form}"

    return export_as


def sorted_by_x(values, x):
    return values[np.argsort(x, kind="stable")]


def test_a_ply_is_the_one_of_the_run(run, exported):
    folder, _ = run
    assert exported("ply").read_bytes() == (folder / "point_cloud.ply").read_bytes()
    export.main([str(folder), "--to", "ply", "--sh", "1"])
    assert read_gaussians(folder / f"{folder.name}.ply").shN.shape[1] == 3


@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="npm install -g @playcanvas/splat-transform")
@pytest.mark.parametrize("form", ["ply", "spz", "sog"])
def test_another_program_reads_what_is_written(run, exported, tmp_path, form):
    command = ["splat-transform", "-q", "-w", exported(form), tmp_path / "back.ply"]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    back, exact = read_gaussians(tmp_path / "back.ply"), run[1].baked()
    assert len(back) == len(run[1])
    x, order = np.sort(back.means[:, 0].numpy()), np.argsort(exact.means[:, 0].numpy())
    np.testing.assert_allclose(x, exact.means[:, 0].numpy()[order], atol=2e-3)
    opacity = sorted_by_x(back.opacities.sigmoid().numpy(), back.means[:, 0].numpy())
    np.testing.assert_allclose(opacity, exact.opacities.numpy()[order], atol=0.02)


@pytest.mark.parametrize(("form", "back"), [("spz", formats.turned), ("sog", lambda g: g)])
def test_a_packed_file_holds_the_splats_of_the_ply(run, exported, tmp_path, form, back):
    """Read by the library that wrote it; SPZ's y points up."""
    gaussforge = pytest.importorskip("gaussforge", reason="pip install gaussforge")
    data = exported(form).read_bytes()
    assert form != "spz" or struct.unpack_from("<4sI", data) == (b"NGSP", 4)
    (tmp_path / "back.ply").write_bytes(gaussforge.GaussForge().convert(data, form, "ply")["data"])
    g, found = read_gaussians(run[0] / "point_cloud.ply"), back(read_gaussians(tmp_path / "back.ply"))
    nearest = torch.cdist(g.means, found.means).argmin(1)
    assert len(found) == len(g)
    np.testing.assert_allclose(found.means[nearest].numpy(), g.means.numpy(), atol=2e-3)
    np.testing.assert_allclose(found.opacities[nearest].sigmoid().numpy(), g.opacities.sigmoid().numpy(), atol=0.02)
    alike = (found.quats[nearest] * torch.nn.functional.normalize(g.quats, dim=1)).sum(1).abs()
    assert alike.min() > 0.999
    np.testing.assert_allclose(found.shN[nearest].numpy(), g.shN.numpy(), atol=0.07)


def test_turned_gaussians_look_the_same_from_the_turned_side():
    generator = torch.Generator().manual_seed(0)
    g = GaussianPly(*(torch.randn(5, *shape, generator=generator) for shape in ((3,), (1, 3), (15, 3), (), (3,), (4,))))
    turn, directions = torch.tensor([1.0, -1.0, -1.0]), torch.nn.functional.normalize(g.means, dim=1)
    seen = (spherical_harmonics(directions, 15)[:, 1:, None] * g.shN).sum(1)
    there = (spherical_harmonics(directions * turn, 15)[:, 1:, None] * formats.turned(g).shN).sum(1)
    torch.testing.assert_close(there, seen)
    axes, turned_axes = rotation_matrix(g.quats), rotation_matrix(formats.turned(g).quats)
    torch.testing.assert_close(turned_axes, turn[:, None] * axes * turn)  # an axis and its opposite are one


@pytest.mark.parametrize("form", ["spz", "sog"])
def test_a_format_without_its_library_names_the_remedy(run, monkeypatch, form):
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    with pytest.raises(SettingError, match=r"pip install 'clear-strategies\[export\]', or choose --to ply"):
        export.main([str(run[0]), "--to", form])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(["--to", "obj"], "invalid choice"), (["--to", "ply", "--out", "a.spz"], "must end in .ply"), ([], "--to")],
)
def test_wrong_arguments_are_refused_in_one_line(run, arguments, message):
    with pytest.raises(SettingError, match=message):
        export.main([str(run[0]), *arguments])
