"""The doors, as a user goes through them: the command line, its outputs, and what it says to bad input."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf

from clear_strategies import Conductor, Strategy
from clear_strategies.run import CONF
from tests.helpers.malformed import CASES

ROOT = Path(__file__).resolve().parents[1]
TINY = ["data.reader.width=64", "data.reader.height=48", "fit.iterations=12", "fit.max_degree=1", "data.cloud.init=random",
        "data.cloud.random_points=60", "data.reader.views=5", "data.reader.train=2", "data.views.train=2",
        "skips=none"]  # fmt: skip


def run(
    *arguments: str, cwd: Path, module: str = "clear_strategies.run", **options
) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), "CLEAR_CACHE": str(cwd / "cache"), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(
        command, cwd=cwd, env=env, capture_output=True, text=True, timeout=240, check=False, **options
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A tiny run of everything."""
    folder = tmp_path_factory.mktemp("run")
    result = run("+strategy=clear", "hydra.run.dir=here", *TINY, cwd=folder)
    assert result.returncode == 0, result.stderr
    (folder / "said").write_text(result.stdout + result.stderr)
    return folder


def test_a_run_leaves_everything_it_promises(finished):
    out = finished / "here"
    tables, pictures = (
        ("metrics.json", "conflict.csv", "timing.csv", "history.csv"),
        ("contact_sheet.png", "curves.png"),
    )
    for name in (*tables, *pictures, "point_cloud.ply"):
        assert (out / name).stat().st_size > 0, name
    assert len(list((out / "renders").glob("*.png"))) == 3
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["strategies"] == ["gco", "p2g", "svs"]
    assert metrics["synthetic_prior"] is True
    assert set(metrics["test"]["mean"]) == {"ours", "bicubic", "prior"}
    assert set(metrics["test"]["mean"]["ours"]) == {"psnr", "ssim", "gmsd", "blur"}
    assert 0 < metrics["conflict"]["gaussian"] < 1
    assert {"versions", "git", "seed", "backend", "plan"} <= set(metrics["provenance"])
    assert b"comment SplatRenderMode: mip" in (out / "point_cloud.ply").read_bytes()[:300]
    assert (out / "checkpoints" / "step_0000013" / "manifest.json").is_file()
    header = (out / "conflict.csv").read_text().splitlines()[0]
    assert header.startswith("t,conflict,conflict_means")
    timing = (out / "timing.csv").read_text()
    assert "skipped" in timing
    assert "\nmaps,1," in timing
    assert len(list((out / "views").glob("*_truth.png"))) == 3
    assert len(list((out / "maps").glob("*/corrected.png"))) == 2


def test_the_plan_is_printed_before_training(finished):
    said = (finished / "said").read_text()
    for phrase in (
        "train views",
        "LR ",
        "HR ",
        "initial points",
        "points use test views",
        "rasterizer",
        "skipped",
    ):
        assert phrase in said, phrase
    assert said.index("initial points") < said.index("done in")
    assert "synthetic" in said


def test_the_exported_ply_looks_as_it_was_measured(finished):
    """Rendering the file with the filter off gives the test render: everything was folded in."""
    import torch

    import rasterizers
    from clear_strategies.data.photo_files import read_image
    from clear_strategies.data.ply import read_gaussians
    from clear_strategies.data.readers import demo
    from rasterizers import Splats

    g = read_gaussians(finished / "here" / "point_cloud.ply")
    splats = Splats(g.means, g.quats, g.scales.exp(), g.opacities.sigmoid(), g.sh0, g.shN)
    capture = demo.read(width=64, height=48, views=5, train=2)
    frame = next(f for f in capture.frames if f.split == "test")
    image = rasterizers.load("torch", near=0.01)(splats, frame.camera).image.clamp(0, 1)
    saved = read_image(finished / "here" / "renders" / f"{frame.name}.png")
    assert float((image - saved).abs().max()) < 0.01
    assert torch.isfinite(image).all()


def test_report_of_a_run(finished):
    result = run("here", "--out", "report", cwd=finished, module="clear_strategies.report")
    assert result.returncode == 0, result.stderr
    assert "| bicubic" in result.stdout
    assert (finished / "report" / "report.csv").is_file()
    assert "data:image/png" in (finished / "report" / "report.html").read_text(encoding="utf-8")
    nothing = run("cache", cwd=finished, module="clear_strategies.report")
    assert nothing.returncode == 2
    assert "Traceback" not in nothing.stderr


def test_resuming_through_the_door_gives_the_same_field(finished):
    """A run cut by SIGTERM and resumed ends where the uninterrupted one did."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "CLEAR_CACHE": str(finished / "cache"), "OMP_NUM_THREADS": "1"}
    overrides = ["+strategy=clear", *TINY, "fit.iterations=30"]
    command = [sys.executable, "-m", "clear_strategies.run", *overrides, "hydra.run.dir=cut"]
    with subprocess.Popen(
        command, cwd=finished, env=env, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        deadline = time.monotonic() + 120
        while "it/s" not in process.stderr.readline() and time.monotonic() < deadline:
            pass
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 143, errors
    assert "Go on with fit.resume=" in errors or "fit.resume" in (finished / "cut" / "run.log").read_text()
    resumed = run(*overrides, "hydra.run.dir=resumed", "fit.resume=cut", cwd=finished)
    whole = run(*overrides, "hydra.run.dir=whole", cwd=finished)
    assert resumed.returncode == whole.returncode == 0, resumed.stderr
    plys = [(finished / name / "point_cloud.ply").read_bytes() for name in ("resumed", "whole")]
    assert plys[0] == plys[1]
    other = run("+strategy=gco", *TINY, "fit.iterations=30", "fit.resume=cut", cwd=finished)
    assert other.returncode == 2
    assert "this is not the configuration that wrote it" in other.stdout + other.stderr


def test_a_sweep_goes_on_after_a_bad_job(tmp_path):
    result = run(
        "-m", "strategies.gco.tolerance=0.1,7", "+strategy=gco", "fit.iterations=3", *TINY[:2], *TINY[4:], cwd=tmp_path
    )
    said = result.stdout + result.stderr
    assert result.returncode == 2
    assert "tolerance must lie in [0, 1), got 7" in said
    assert "Traceback" not in said
    assert len(list(tmp_path.glob("multirun/*/*/metrics.json"))) == 1


def test_a_strategy_of_another_package(tmp_path):
    (tmp_path / "theirs.py").write_text(
        "from dataclasses import dataclass\n"
        "from clear_strategies import Strategy\n\n\n"
        "@dataclass(frozen=True)\n"
        "class Mine(Strategy):\n"
        "    share: float = 0.5\n\n"
        "    def correct(self, lr, hr, evidence):\n"
        "        return hr * self.share\n"
    )
    result = run("+strategy=p2g", "+strategies.mine._target_=theirs.Mine", "+strategies.mine.share=0.25", "fit.iterations=3",
                 "hydra.run.dir=out", *TINY[:2], *TINY[4:], cwd=tmp_path)  # fmt: skip
    # `python -m` puts the current folder on the path, as a user expects.
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["strategies"] == ["p2g", "mine"]
    clash = run("+strategy=gco", "+strategies.mine._target_=theirs.Mine", *TINY, cwd=tmp_path)
    assert clash.returncode == 2
    assert "GCO and Mine both implement correct()" in clash.stdout + clash.stderr


def test_lr_images_are_written_for_an_external_model_whose_results_come_back(tmp_path):
    """data.save_lr writes and stops; whatever enlarges those files is then a prior."""
    from PIL import Image

    from clear_strategies.data.photo_files import list_images

    written = run("data.save_lr=lr", *TINY, cwd=tmp_path)
    assert written.returncode == 0, written.stderr
    assert not list(tmp_path.glob("outputs/**/metrics.json"))
    (tmp_path / "sr").mkdir()
    for path in list_images(tmp_path / "lr"):
        with Image.open(path) as image:
            image.resize((image.width * 4, image.height * 4), Image.Resampling.LANCZOS).save(
                tmp_path / "sr" / f"{path.stem}_x4.png"
            )
    result = run("prior=images", "prior.path=sr", "prior.suffix=_x4", "hydra.run.dir=out", *TINY, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "images sr" in result.stdout + result.stderr


BAD_SETTINGS = {
    "+strategy=gco strategies.gco.bound=both": "bound must be omega or coefficient",
    "+strategy=p2g strategies.p2g.score_by=best": "score_by must be one of",
    "+strategy=svs strategies.svs.dropout.maximum=1": "dropout rate must lie in [0, 1)",
    "objective.lambda_hr.start=4000": "start <= full",
    "objective.lr_from=both": "lr_from must be lr or hr",
    "objective.lambda_lr=0": "L_base must act from the first iteration",
    "data.views.sizes=pad": "data.views.sizes: must be one of crop, round, got 'pad'",
    "data.views.sr_scale=2.5": "data.views.sr_scale: must be a whole number of at least 1, got 2.5",
    "data.views.shrink=200": "data.views.shrink: must leave a whole LR pixel",
    "density.mode=median": "mode must be quantile or fixed",
    "rasterizer.kernel=-1": "kernel must be",
    "fit.map_views=-1": "must be at least 0, got -1",
    "fit.iterations=0": "iterations must be at least 1",
    "data.views.train=99": "99 training views are asked for",
    "data=llff": "data.path",
    "+scene=fern data=llff": "data.root",
    "prior=onnx": "prior.path",
    "prior=onnx prior.path=nowhere.onnx": "nowhere.onnx",
    "prior=images prior.path=nowhere": "nowhere",
    "data.cloud.init=ply data.cloud.path=nowhere.ply": "nowhere.ply",
    "fit.resume=nowhere": "no checkpoint is here",
    "rasterizer.name=cuda": "unknown rasterizer",
    "rasterizer.preset=best": "unknown preset",
}


@pytest.mark.parametrize(("overrides", "message"), BAD_SETTINGS.items(), ids=list(BAD_SETTINGS))
def test_bad_settings_get_one_line_and_exit_code_2(overrides, message, tmp_path):
    quick = [] if "data=" in overrides else [o for o in TINY if o.split("=")[0] not in overrides]
    result = run(*quick, *overrides.split(), cwd=tmp_path)
    said = result.stdout + result.stderr
    assert result.returncode == 2, said
    assert message in said
    assert "Traceback" not in said


@pytest.mark.parametrize("case", CASES[:: max(1, len(CASES) // 12)], ids=lambda c: c.name)
def test_malformed_data_get_one_line_and_exit_code_2(case, tmp_path):
    kind, path = case.build(tmp_path)
    result = run(f"data={kind}", f"data.path={path}", "fit.iterations=1", "prior=bicubic", "data.views.train=null",
                 "data.views.train_names=null", cwd=tmp_path)  # fmt: skip
    said = result.stdout + result.stderr
    assert result.returncode == 2, said
    assert "Traceback" not in said
    assert not list(tmp_path.glob("outputs/**/metrics.json"))


def configs(group: str) -> list[str]:
    return sorted(p.stem for p in (CONF / group).glob("*.yaml") if not p.stem.startswith("_"))


@pytest.mark.parametrize("group", ["strategy", "rasterizer", "data", "prior", "objective", "density", "optim"])
def test_every_config_composes(group):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for name in configs(group):
            prefix = "+" if group == "strategy" else ""
            config = compose("config", [f"{prefix}{group}={name}"])
            assert config.fit.iterations > 0
            if group == "strategy":
                OmegaConf.set_struct(config, False)
                strategies = [instantiate(s, _convert_="object") for s in config.strategies.values()]
                assert all(isinstance(s, Strategy) for s in strategies)
                Conductor(*strategies)
            if group in ("objective", "density", "optim"):
                instantiate(config[group], _convert_="object")


def test_every_field_of_a_strategy_is_in_its_yaml():
    from dataclasses import fields

    from clear_strategies import GCO, P2G, SVS

    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", ["+strategy=clear"])
    for name, kind in (("gco", GCO), ("p2g", P2G), ("svs", SVS)):
        assert {f.name for f in fields(kind) if f.init} == set(config.strategies[name]) - {"_target_"}


def test_the_two_sets_of_readings_differ_where_they_say():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        measured, literal = (compose("config", [f"+strategy={name}"]) for name in ("clear", "clear_paper"))
    assert (measured.strategies.p2g.score_by, literal.strategies.p2g.score_by) == ("sum", "evidence")
    assert (measured.objective.lambda_hr.final, literal.objective.lambda_hr.final) == (1.0, 0.1)
    assert (measured.optim.detail_decay, literal.optim.detail_decay) == (0.002, 0.0)
    assert literal.strategies.svs.anchor_weights.means == 1.0
    assert literal.strategies.svs.anchor_weights.detail == 0.0
