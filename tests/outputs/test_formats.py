"""Files for viewers hold the splat as it was measured; another program reads them."""

from __future__ import annotations

import json
import os
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
from rasterizers.geometry import SH_C0, rotation_matrix, spherical_harmonics
from tests.helpers import saved_run

LAYOUT = [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]


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


def test_a_splat_file_holds_position_scale_colour_and_rotation_and_the_most_visible_come_first(run, exported):
    table = np.frombuffer(exported("splat").read_bytes(), LAYOUT)
    weight = table["scales"].prod(1) * table["rgba"][:, 3]
    assert weight[:10].min() > weight[-10:].max()
    exact = run[1].baked()
    order = np.argsort(exact.means[:, 0].numpy(), kind="stable")
    found = sorted_by_x(table, table["means"][:, 0])
    np.testing.assert_array_equal(found["means"], exact.means.numpy()[order])
    np.testing.assert_allclose(found["scales"], exact.scales.numpy()[order], rtol=1e-5)
    color = (exact.sh0[:, 0] * SH_C0 + 0.5 + exact.rgb_offset).clamp(0, 1).numpy()[order]
    np.testing.assert_allclose(found["rgba"][:, :3] / 255, color, atol=0.51 / 255)
    np.testing.assert_allclose(found["rgba"][:, 3] / 255, exact.opacities.numpy()[order], atol=0.51 / 255)
    quats = torch.nn.functional.normalize(exact.quats, dim=1).numpy()[order]
    np.testing.assert_allclose((found["quats"].astype(float) - 128) / 128, quats, atol=1.01 / 128)


def test_a_ply_is_the_one_of_the_run(run, exported):
    folder, _ = run
    assert exported("ply").read_bytes() == (folder / "point_cloud.ply").read_bytes()
    export.main([str(folder), "--to", "ply", "--sh", "1"])
    assert read_gaussians(folder / f"{folder.name}.ply").shN.shape[1] == 3


def read_glb(path):
    """(content, attributes) of a .glb, by the letter of glTF 2.0."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    content = json.loads(data[20 : 20 + size])
    rest, binary = struct.unpack_from("<I4s", data, 20 + size)
    assert (kind, binary, size % 4, rest % 4) == (b"JSON", b"BIN\0", 0, 0)
    buffer = data[28 + size :]
    assert len(buffer) == rest
    found = {}
    for name, index in content["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = content["accessors"][index]
        view, width = (
            content["bufferViews"][accessor["bufferView"]],
            {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]],
        )
        assert accessor["componentType"] == 5126
        values = np.frombuffer(buffer, "<f4", accessor["count"] * width, view["byteOffset"])
        found[name] = values.reshape(accessor["count"], width)
    return content, found


def test_a_glb_holds_the_splats_of_the_ply(run, exported):
    content, found = read_glb(exported("glb"))
    g, prefix = read_gaussians(run[0] / "point_cloud.ply"), "KHR_gaussian_splatting:"
    exact = {
        "POSITION": g.means, f"{prefix}SCALE": g.scales.exp(), f"{prefix}OPACITY": g.opacities.sigmoid()[:, None],
        f"{prefix}ROTATION": torch.nn.functional.normalize(g.quats, dim=1)[:, [1, 2, 3, 0]],
        "COLOR_0": torch.cat([(g.sh0[:, 0] * SH_C0 + 0.5).clamp(0, 1), g.opacities.sigmoid()[:, None]], 1),
        f"{prefix}SH_DEGREE_0_COEF_0": g.sh0[:, 0], f"{prefix}SH_DEGREE_1_COEF_2": g.shN[:, 2],
        f"{prefix}SH_DEGREE_2_COEF_0": g.shN[:, 3], f"{prefix}SH_DEGREE_3_COEF_6": g.shN[:, 14],
    }  # fmt: skip
    assert len(found) == 5 + 16
    for name, values in exact.items():
        np.testing.assert_allclose(found[name], values.numpy(), rtol=1e-6, atol=1e-7, err_msg=name)
    position = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    np.testing.assert_array_equal(position["max"], found["POSITION"].max(0))
    assert content["extensionsUsed"] == ["KHR_gaussian_splatting"]


VALIDATE = """
const validator = require("gltf-validator"), bytes = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(bytes)).then((report) => console.log(JSON.stringify(report.issues.messages)));
"""


def errors_of_glb(path) -> list[str]:
    """Khronos' validator: the code and the place of each error and each warning."""
    npm, node = shutil.which("npm"), shutil.which("node")
    if npm is None or node is None:
        pytest.skip("Node.js, and npm install -g gltf-validator")
    packages = subprocess.run([npm, "root", "-g"], check=True, capture_output=True, text=True).stdout.strip()
    places = {"NODE_PATH": os.pathsep.join([packages, os.environ.get("NODE_PATH", "")])}
    command = [node, "-e", VALIDATE, str(path)]
    ended = subprocess.run(command, check=False, capture_output=True, text=True, env={**os.environ, **places})
    if "Cannot find module 'gltf-validator'" in ended.stderr:
        pytest.skip("npm install -g gltf-validator")
    assert ended.returncode == 0, ended.stderr
    return [f"{m['code']} {m['pointer']}" for m in json.loads(ended.stdout) if m["severity"] <= 1]


def test_khronos_validator_finds_nothing_but_the_names_that_it_does_not_know_yet(exported):
    """glTF-Validator issue 252: it refuses attributes named by an extension. With names that glTF keeps for applications,
    of the same length, the same file is without errors and warnings.
    """
    path = exported("glb")
    named = "MESH_PRIMITIVE_INVALID_ATTRIBUTE /meshes/0/primitives/0/attributes/KHR_gaussian_splatting:"
    assert [error for error in errors_of_glb(path) if not error.startswith(named)] == []
    path.write_bytes(path.read_bytes().replace(b"KHR_gaussian_splatting:", b"_HR_gaussian_splatting:"))
    assert errors_of_glb(path) == []


@pytest.mark.skipif(shutil.which("splat-transform") is None, reason="npm install -g @playcanvas/splat-transform")
@pytest.mark.parametrize("form", ["ply", "splat", "spz", "sog"])
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
