"""A saved run is drawn as it was evaluated, from its checkpoint and from its PLY file; what `render` and `export` leave of it."""

import json
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import rasterizers
from clear_strategies.commands import export, render, view
from clear_strategies.data.photo_files import read_header, read_image
from clear_strategies.data.ply import read_gaussians, write_gaussians
from clear_strategies.errors import SettingError
from clear_strategies.jobs.saved import open_splat
from clear_strategies.outputs import metrics
from clear_strategies.outputs.results import export_ply
from clear_strategies.training import checkpoint
from tests.helpers import toy

CAMERA = toy.camera(0.2)


def exact(field):
    return field.render(rasterizers.load("torch"), CAMERA).clamp(0, 1)


def test_a_run_its_checkpoints_one_of_them_and_its_ply_file_open_alike(saved_run):
    folder, field = saved_run
    for path in (folder, folder / "checkpoints", folder / "checkpoints" / "step_0000001.safetensors"):
        splat = open_splat(path)
        assert torch.equal(splat.painter.color(CAMERA), exact(field))
        assert [saved.split for saved in splat.cameras] == ["train"] * 3 + ["test"]
        assert splat.folder == folder
        assert len(splat.poses()) == 3
    splat = open_splat(folder / "point_cloud.ply", "torch")
    torch.testing.assert_close(splat.painter.color(CAMERA), exact(field), atol=2e-5, rtol=0)
    assert len(splat.cameras) == 4


def test_a_run_is_drawn_over_the_background_of_its_photos(saved_run, tmp_path):
    folder, field = shutil.copytree(saved_run[0], tmp_path / "run"), saved_run[1]
    entries = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps([{**entry, "background": [1.0, 1.0, 1.0]} for entry in entries]))
    white = field.render(rasterizers.load("torch", background=(1.0, 1.0, 1.0)), CAMERA).clamp(0, 1)
    assert not torch.equal(white, exact(field))
    assert torch.equal(open_splat(folder).painter.color(CAMERA), white)


def test_a_ply_file_of_3dgs_and_of_a_run_without_compensation_is_drawn_with_its_blur(saved_run, tmp_path):
    folder, field = saved_run
    content = (folder / "point_cloud.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(content.replace(b"comment SplatRenderMode: mip\n", b""))
    plain, mip = (open_splat(path, "torch").painter for path in (tmp_path / "a.ply", folder / "point_cloud.ply"))
    rasterizer = rasterizers.load("torch", kernel=0.3, antialiased=False)
    assert torch.equal(plain.color(CAMERA), mip.field.render(rasterizer, CAMERA).clamp(0, 1))
    export_ply(tmp_path / "run" / "point_cloud.ply", field, antialiased=False)
    export.main([str(tmp_path / "run"), "--out", str(tmp_path / "again.ply")])
    for path in (tmp_path / "run" / "point_cloud.ply", tmp_path / "again.ply"):
        assert b"SplatRenderMode" not in path.read_bytes()[:300]
        found = open_splat(path, "torch").painter.color(CAMERA)
        torch.testing.assert_close(found, field.render(rasterizer, CAMERA).clamp(0, 1), atol=2e-5, rtol=0)


def test_the_ply_file_of_a_finished_run_is_drawn_with_the_settings_of_the_run(saved_run, tmp_path, monkeypatch, caplog):
    rules = {"kernel": 0.05, "antialiased": False, "background": (0.0, 0.5, 1.0)}
    exact = saved_run[1].render(rasterizers.load("torch", **rules), CAMERA).clamp(0, 1)
    export_ply(tmp_path / "point_cloud.ply", saved_run[1], antialiased=False)
    shutil.copy(saved_run[0] / "cameras.json", tmp_path)
    (tmp_path / "metrics.json").write_text("{}")
    assert not open_splat(tmp_path).antialiased
    assert "metrics.json: " in caplog.text  # damaged, it keeps nobody from looking
    config = {f"rasterizer.{name}": value for name, value in {"name": "torch", **rules}.items()}
    monkeypatch.setattr(metrics, "read", lambda path, remedy: SimpleNamespace(config=config))
    for path in (tmp_path, tmp_path / "point_cloud.ply"):
        torch.testing.assert_close(open_splat(path).painter.color(CAMERA), exact, atol=2e-5, rtol=0)
    export_ply(tmp_path / "point_cloud.ply", saved_run[1])  # another file, which was trained otherwise
    assert open_splat(tmp_path).antialiased


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
    assert float(splat.painter.numbers(camera, torch.ones(len(field), 3)).max()) > 0.2
    points = field.means.data.double() @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    u = points[:, 0] / points[:, 2] * camera.fx + camera.cx
    assert float(((u > 0) & (u < camera.width) & (points[:, 2] > 0)).double().mean()) > 0.8


@pytest.mark.parametrize(("name", "value"), [("scales", 50.0), ("opacities", -500.0)])
def test_a_ply_file_of_numbers_that_overflow_is_drawn_and_written(name, value, saved_run, tmp_path):
    ply = read_gaussians(saved_run[0] / "point_cloud.ply")
    write_gaussians(tmp_path / "a.ply", replace(ply, **{name: torch.full_like(getattr(ply, name), value)}))
    splat = open_splat(tmp_path / "a.ply")
    assert splat.painter.color(splat.poses()[0]).isfinite().all()
    export.main([str(tmp_path / "a.ply"), "--out", str(tmp_path / "b.ply")])
    assert len(read_gaussians(tmp_path / "b.ply")) == len(ply)


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


# ---- `clear-strategies render RUN`: which files it leaves
def files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_a_loop_is_a_video_and_on_request_one_of_the_depth(saved_run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    render.main([str(saved_run[0]), "--frames", "3", "--depth", "--out", str(tmp_path)])
    assert files(tmp_path) == ["cameras.mp4", "cameras_depth.mp4"]


def test_test_views_are_what_was_evaluated(saved_run, tmp_path):
    folder, field = saved_run
    render.main([str(folder), "--path", "test", "--out", str(tmp_path)])
    (view,) = toy.scene().test
    assert files(tmp_path) == [f"{view.name}.png"]
    exact = field.render(rasterizers.load("torch"), view.hr.camera).clamp(0, 1)
    torch.testing.assert_close(read_image(tmp_path / f"{view.name}.png"), exact, atol=0.5 / 255 + 1e-5, rtol=0)


def test_width_sets_the_size_and_a_file_of_cameras_gives_a_picture_of_each_and_of_its_depth(saved_run, tmp_path):
    folder, _ = saved_run
    render.main([str(folder), "--path", "train", "--width", "48"])
    assert read_header(folder / "rendered" / "view0.png").size(None) == (48, 32)
    (entry, *_) = json.loads((folder / "cameras.json").read_text())
    (tmp_path / "path.json").write_text(json.dumps([{**entry, "img_name": name} for name in "ab"]))
    render.main([str(folder), "--path", str(tmp_path / "path.json"), "--depth", "--out", str(tmp_path / "out")])
    assert files(tmp_path / "out") == ["a.png", "b.png", "depth/a.png", "depth/b.png"]
    assert read_header(tmp_path / "out" / "depth" / "b.png").size(None) == (96, 64)


# ---- files for viewers hold the splat as it was measured; another program reads them
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
    ours, theirs = (splats.means[:, 0].numpy().argsort(kind="stable") for splats in (exact, back))
    np.testing.assert_allclose(back.means[:, 0].numpy()[theirs], exact.means[:, 0].numpy()[ours], atol=2e-3)
    opacity = back.opacities.sigmoid().numpy()[theirs]
    np.testing.assert_allclose(opacity, exact.opacities.numpy()[ours], atol=0.02)


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        (render, ["--path", "nowhere"], "--path: must be cameras, train, test or a file"),
        (render, ["--frames", "0"], "must be a whole number above 0"),
        (render, ["--width", "0"], "must be a whole number above 0"),
        (render, ["--width", "9" * 400], "must be a whole number above 0 and at most 100,000, got 9{20}\\."),
        (render, ["--typo"], "unrecognized arguments: --typo"),
        (export, ["--sh", "4"], "invalid choice"),
        (export, ["--out", "a.spz"], "must end in .ply, got a.spz. splat-transform makes"),
        (view, ["--port", "-1"], "--port: must be a whole number from 0 to 65535, got -1"),
        (view, ["--port", "65536"], "--port: must be a whole number from 0 to 65535, got 65536"),
        (view, ["--host", "192.0.2.1"], "--host: must be an address of this machine, got 192.0.2.1"),
    ],
)
def test_wrong_arguments_are_refused_in_one_line(saved_run, command, arguments, message):
    with pytest.raises(SettingError, match=message):
        command.main([str(saved_run[0]), *arguments])
