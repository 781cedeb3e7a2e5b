"""A saved run is drawn as it was evaluated, from its checkpoint and from its PLY file."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import pytest
import torch

import rasterizers
from clear_strategies.commands import export
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.outputs.export import export_ply
from clear_strategies.training import checkpoint
from tests.helpers import toy

CAMERA = toy.camera(0.2)


def exact(field):
    return field.render(rasterizers.load("torch"), CAMERA).clamp(0, 1)


def test_a_run_its_checkpoints_and_one_of_them_open_alike(saved_run):
    folder, field = saved_run
    for path in (folder, folder / "checkpoints", folder / "checkpoints" / "step_0000001.safetensors"):
        splat = open_splat(path)
        assert torch.equal(splat.painter.color(CAMERA), exact(field))
        assert [saved.split for saved in splat.cameras] == ["train"] * 3 + ["test"]
        assert splat.folder == folder
        assert len(splat.poses()) == 3


def test_a_run_is_drawn_over_the_background_of_its_photos(saved_run, tmp_path):
    folder, field = shutil.copytree(saved_run[0], tmp_path / "run"), saved_run[1]
    entries = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps([{**entry, "background": [1.0, 1.0, 1.0]} for entry in entries]))
    white = field.render(rasterizers.load("torch", background=(1.0, 1.0, 1.0)), CAMERA).clamp(0, 1)
    assert not torch.equal(white, exact(field))
    assert torch.equal(open_splat(folder).painter.color(CAMERA), white)


def test_a_ply_file_looks_the_same(saved_run):
    folder, field = saved_run
    splat = open_splat(folder / "point_cloud.ply", "torch")
    torch.testing.assert_close(splat.painter.color(CAMERA), exact(field), atol=2e-5, rtol=0)
    assert len(splat.cameras) == 4


def test_a_ply_file_of_3dgs_is_drawn_with_its_blur(saved_run, tmp_path):
    folder, _ = saved_run
    content = (folder / "point_cloud.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"comment SplatRenderMode: mip\n", b""))
    plain, mip = (open_splat(path, "torch").painter for path in (tmp_path / "a.ply", folder / "point_cloud.ply"))
    rasterizer = rasterizers.load("torch", kernel=0.3, antialiased=False)
    assert torch.equal(plain.color(CAMERA), mip.field.render(rasterizer, CAMERA).clamp(0, 1))


def test_a_run_without_compensation_has_a_ply_file_that_says_so(saved_run, tmp_path):
    _, field = saved_run
    export_ply(tmp_path / "run" / "point_cloud.ply", field, antialiased=False)
    export.main([str(tmp_path / "run"), "--out", str(tmp_path / "again.ply")])
    rasterizer = rasterizers.load("torch", kernel=0.3, antialiased=False)
    for path in (tmp_path / "run" / "point_cloud.ply", tmp_path / "again.ply"):
        assert b"SplatRenderMode" not in path.read_bytes()[:300]
        found = open_splat(path, "torch").painter.color(CAMERA)
        torch.testing.assert_close(found, field.render(rasterizer, CAMERA).clamp(0, 1), atol=2e-5, rtol=0)


def test_ply_files_in_one_folder_have_their_own_names_and_are_never_overwritten(saved_run, tmp_path):
    folder, _ = saved_run
    models = [tmp_path / f"{name}.ply" for name in ("garden", tmp_path.name)]
    for model in models:
        shutil.copy(folder / "point_cloud.ply", model)
        with pytest.raises(SettingError, match="must be another file than the one that is read"):
            export.main([str(model), "--sh", "0"])
    assert set(tmp_path.iterdir()) == set(models)
    assert {model.read_bytes() for model in models} == {(folder / "point_cloud.ply").read_bytes()}


def test_a_lone_ply_file_has_an_upright_camera_that_sees_it(saved_run, tmp_path):
    folder, field = saved_run
    shutil.copy(folder / "point_cloud.ply", tmp_path)
    splat = open_splat(tmp_path)
    assert not splat.cameras
    (camera,) = splat.poses()
    assert torch.equal(camera.world_to_camera[:3, :3], torch.eye(3, dtype=camera.world_to_camera.dtype))
    assert float(splat.painter.numbers(camera, torch.ones(len(field))).max()) > 0.2
    points = field.means.data.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    u = points[:, 0] / points[:, 2] * camera.fx + camera.cx
    assert float(((u > 0) & (u < camera.width) & (points[:, 2] > 0)).double().mean()) > 0.8


def test_the_inria_layout_of_a_model_is_found(saved_run, tmp_path):
    folder, _ = saved_run
    for iteration in (7000, 30000):
        own = tmp_path / "point_cloud" / f"iteration_{iteration}"
        own.mkdir(parents=True)
        shutil.copy(folder / "point_cloud.ply", own)
    shutil.copy(folder / "cameras.json", tmp_path)
    splat = open_splat(tmp_path)
    assert "iteration_30000" in splat.source
    assert len(splat.cameras) == 4


def test_a_rasterizer_that_is_not_here_gives_way(saved_run, tmp_path, caplog):
    folder, _ = saved_run
    shutil.copytree(folder, tmp_path / "run")
    for path in (tmp_path / "run" / "checkpoints").rglob("step_*"):
        saved = checkpoint.load(path)
        checkpoint.save(path.parent, replace(saved, config={**saved.config, "rasterizer.name": "theirs"}))
    assert open_splat(tmp_path / "run").painter.color(CAMERA).isfinite().all()
    assert "draws instead" in caplog.text
    with pytest.raises(SettingError, match="nothing"):
        open_splat(folder, "nothing")
