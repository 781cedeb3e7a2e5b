"""CLEAR in a 3DGS-style train.py: by one line in it, or by `python -m integration.inria train.py …` without any change."""

from __future__ import annotations

import logging
import runpy
import sys

import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from integration import HostError
from integration.inria.__main__ import main
from integration.inria.from_options import install
from tests.helpers.host_parts import FOLDER, FROM_START, N, options

SETUP = "    gaussians.training_setup(opt)\n"


def test_one_line_and_none_give_the_same_file(inria_host, inria_capture, caplog, monkeypatch):
    settings, sr = [*FROM_START, "strategies.svs.anchor_start=7500"], str(inria_capture / "sr")
    script = ["-s", str(inria_capture), "--iterations", "8", "--densify_until_iter", "7", "--save"]
    clear = ["--sr", sr, *(f"--overrides={s}" for s in settings)]
    with caplog.at_level(logging.INFO):
        assert main([*clear, str(FOLDER / "train.py"), *script, str(inria_capture / "none")]) == 0
    assert "8 merges" in caplog.text
    assert not hasattr(inria_host.render, "__wrapped__")
    source = (FOLDER / "train.py").read_text()
    line = f"    install(gaussians, scene, opt, overrides={settings!r}, sr={sr!r})\n"
    edited = inria_capture / "edited.py"
    edited.write_text("from integration.inria import install\n" + source.replace(SETUP, SETUP + line, 1))
    monkeypatch.setattr(sys, "argv", ["edited.py", *script, str(inria_capture / "one")])
    runpy.run_path(str(edited), run_name="__main__")
    one, none = load_file(inria_capture / "one"), load_file(inria_capture / "none")
    assert len(one["xyz"]) != N  # the host has densified
    for name, rows in one.items():
        assert torch.equal(rows, none[name]), name


def test_schedules_are_those_of_the_hosts_own_options(inria_host, inria_capture):
    """Its defaults are not on the command line: 30 iterations, densification until 24."""
    opt = options(inria_host, inria_capture)
    gaussians, scene = inria_host.setup(opt)
    clear = install(gaussians, scene, opt, strategies="clear_paper", overrides=FROM_START[2:], sr=inria_capture / "sr")
    conductor = clear.attachment.conductor
    assert opt.densify_until_iter == 15  # clear_paper takes its anchor at half of the iterations
    assert conductor.may_densify(14)
    assert not conductor.may_densify(15)
    assert conductor.objective.lambda_hr(9) == conductor.objective.lambda_hr.peak  # full at 3,000 of 10,000
    with pytest.raises(HostError, match="has no iterations"):
        install(gaussians, scene, object(), sr=inria_capture / "sr")


@pytest.mark.parametrize("points", ["own", "stereo"])
def test_a_run_continues_from_the_hosts_checkpoint_as_if_it_had_not_stopped(
    points, inria_capture, inria_launched, caplog
):
    checkpoint, common = str(inria_capture / "5.pth"), ["--iterations", "8", "--sh_interval", "1"]
    with caplog.at_level(logging.INFO):
        whole = inria_launched(
            "whole", *common, "--checkpoint", checkpoint, "--checkpoint_iteration", "5", points=points
        )
    assert caplog.text.count("points=stereo: ") == (points == "stereo")
    assert "8 merges" in caplog.text
    assert (len(whole["xyz"]) == N) == (points == "own")
    resumed = inria_launched("resumed", *common, "--start_checkpoint", checkpoint, points=points)
    for name, rows in whole.items():
        assert torch.allclose(rows, resumed[name], atol=1e-5), name


def test_a_checkpoint_without_clear_is_refused(inria_host, inria_capture, caplog):
    opt = options(inria_host, inria_capture)
    gaussians, _ = inria_host.setup(opt)
    torch.save((gaussians.capture(), 3), inria_capture / "3.pth")
    command = ["--sr", str(inria_capture / "sr"), str(FOLDER / "train.py"), "-s", str(inria_capture)]
    assert main([*command, "--start_checkpoint", str(inria_capture / "3.pth")]) == 2
    assert "written without CLEAR" in caplog.text


def test_save_lr_writes_the_photos_as_they_are_trained_on_and_stops(inria_host, inria_capture):
    with pytest.raises(SystemExit) as stopped:
        main(["--save-lr", str(inria_capture / "lr"), str(FOLDER / "train.py"), "-s", str(inria_capture)])
    assert stopped.value.code == 0
    written = sorted((inria_capture / "lr").iterdir())
    assert [file.name for file in written] == sorted(f.name for f in (inria_capture / "images").iterdir())
    assert Image.open(written[0]).size == (24, 16)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--strategies", "nobody", str(FOLDER / "train.py")], "nobody"),
        (["--overrides", "strategies.gco.tolerance=2", str(FOLDER / "train.py")], "tolerance: must lie in"),
        ([str(FOLDER / "train.py")], "sr: must be the folder of the SR images"),
        (["--sr", ".", "missing.py"], "is not there"),
    ],
)
def test_wrong_arguments_are_refused_before_the_host_starts(arguments, message, inria_capture, caplog):
    assert main([*arguments, "-s", str(inria_capture)]) == 2
    assert message in caplog.text


def test_a_train_py_that_trains_nothing_is_an_error(inria_capture, inria_host, caplog):
    (inria_capture / "train.py").write_text("import gaussian_renderer")
    assert main(["--sr", str(inria_capture / "sr"), str(inria_capture / "train.py")]) == 1
    assert "trained without CLEAR" in caplog.text
