"""`python -m integration.inria train.py …`: CLEAR in a 3DGS-style train.py without any change to it."""

from __future__ import annotations

import logging

import pytest
import torch
from safetensors.torch import load_file

from clear_strategies.compose import conductor
from integration.inria import attach
from integration.inria.__main__ import main
from tests.helpers.inria import FOLDER, N, options


def test_two_lines_and_none_give_the_same_file(inria_host, inria_capture, caplog):
    settings = ["strategies.p2g.patch=4", "strategies.svs.anchor_strength=0"]
    opt = options(inria_host, inria_capture, iterations=12, densify_until_iter=9)
    gaussians, scene = inria_host.setup(opt)
    clear = attach(
        gaussians, scene.getTrainCameras(), conductor("clear", *settings, iterations=12), sr=inria_capture / "sr",
        threshold=opt.densify_grad_threshold, densify_until=opt.densify_until_iter,
    )  # fmt: skip
    inria_host.training(opt, gaussians, scene, clear.wrap(inria_host.render))
    gaussians.save_ply(inria_capture / "two.ply")

    command = [
        "--sr", str(inria_capture / "sr"), *(f"--set={s}" for s in settings),
        str(FOLDER / "train.py"), "-s", str(inria_capture), "--save", str(inria_capture / "none.ply"),
        "--iterations", "12", "--densify_until_iter", "9",
    ]  # fmt: skip
    with caplog.at_level(logging.INFO):
        assert main(command) == 0
    assert "12 merges" in caplog.text
    two, none = load_file(inria_capture / "two.ply"), load_file(inria_capture / "none.ply")
    assert len(two["xyz"]) != N  # the host has densified
    for name, rows in two.items():
        assert torch.equal(rows, none[name]), name
    assert not hasattr(inria_host.render, "__wrapped__")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--clear", "nobody"], "nobody"),
        (["--set", "strategies.gco.tolerance=2"], "tolerance must lie in"),
        ([], "sr: must be the folder of the SR images"),
    ],
)
def test_wrong_arguments_are_refused_before_the_host_starts(arguments, message, inria_capture, caplog):
    assert main([*arguments, str(FOLDER / "train.py"), "-s", str(inria_capture)]) == 2
    assert message in caplog.text


def test_a_missing_script_and_the_hosts_checkpoints_are_refused(inria_capture, caplog):
    assert main(["--sr", str(inria_capture), str(inria_capture / "train.py")]) == 2
    assert "is not there" in caplog.text
    assert main(["--sr", str(inria_capture), "--", str(FOLDER / "train.py"), "--start_checkpoint", "chkpnt.pth"]) == 2
    assert "without --start_checkpoint" in caplog.text


def test_a_train_py_that_renders_nothing_is_an_error(inria_capture, inria_host, caplog):
    (inria_capture / "train.py").write_text("import gaussian_renderer")
    assert main(["--sr", str(inria_capture / "sr"), str(inria_capture / "train.py")]) == 1
    assert "CLEAR had no effect" in caplog.text
