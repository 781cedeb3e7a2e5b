"""The benchmark's command line: its files, its exit codes, and the data files of docs/explanation/benchmarks.md."""

from __future__ import annotations

import json

import pandas as pd
import pytest
import torch

from clear_strategies.bench import rasterizers
from clear_strategies.bench.__main__ import main


def test_rasterizers_writes_every_stage_both_errors_a_figure_and_the_machine(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    asked = ["rasterizers", "--scene", "tiny", "--repeats", "1", "--preset", "fast", "--backend", "torch"]
    assert main([*asked, "--out", str(out)]) == 0
    time, error, turns = (pd.read_csv(out / f"rasterizers_{table}.csv") for table in ("time", "error", "turns"))
    assert list(time["backend"]) == ["torch"]
    assert time.loc[0, "k2_over_k1"] == pytest.approx(time["backward_k2_ms"][0] / time["backward_k1_ms"][0], rel=1e-4)
    stages = (rasterizers.FORWARD, *rasterizers.BACKWARD, rasterizers.TOGETHER, rasterizers.SEPARATE)
    assert list(turns["stage"]) == list(stages)
    assert list(error["truth"]) == [rasterizers.SAME, rasterizers.NONE]
    assert error["means_relative"][0] < 1e-4 < error["means_relative"][1]
    assert (out / "time_against_error.png").stat().st_size > 5_000
    facts = json.loads((out / "rasterizers.json").read_text())
    assert facts["options"] == {"device": "cpu", "repeats": 1}
    assert {"date", "platform", "python", "torch", "nvidia_gpu_models"} <= set(facts["machine"])
    assert str(tmp_path) not in json.dumps(facts)
    assert "forward_ms" in capsys.readouterr().out


NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rasterizers", "--scene", "nowhere"], "nowhere: is no scene"),
        (["rasterizers", "--scene", "tiny", "--backend", "cuda"], "cuda: is no backend"),
        (["iteration", "--scene", "nowhere"], "nowhere: is no scene"),
        pytest.param(["rasterizers", "--device", "cuda"], "no such device", marks=NO_GPU),
    ],
)
def test_unusable_input_is_one_line_and_exit_code_2(arguments, message, caplog, tmp_path):
    assert main([*arguments, "--out", str(tmp_path)]) == 2
    assert message in caplog.records[-1].getMessage()
    assert "\n" not in caplog.records[-1].getMessage()


def test_a_folder_that_cannot_be_made_is_known_before_measuring(tmp_path, caplog):
    (tmp_path / "file").touch()
    assert main(["iteration", "--out", str(tmp_path / "file")]) == 2
    assert str(tmp_path / "file") in caplog.records[-1].getMessage()


@pytest.mark.parametrize("arguments", ["iteration --repeats 0", "rasterizers --preset best", "nothing"])
def test_bad_arguments_have_exit_code_2(arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments.split())
    assert stopped.value.code == 2


@pytest.mark.slow
def test_host_measures_a_loop_alone_and_with_a_strategy(tmp_path):
    asked = ["host", "--strategies", "clear", "--gaussians", "300", "--width", "16", "--repeats", "2", "--threads", "1"]
    assert main([*asked, "--out", str(tmp_path)]) == 0
    host, error = (pd.read_csv(tmp_path / f"{name}.csv").set_index("loop") for name in ("host", "host_error"))
    assert list(host.index) == ["alone", "clear"]
    assert host["operations"]["clear"] - host["operations"]["alone"] <= 60
    assert host["reads"]["clear"] < host["reads"]["alone"] + 0.5  # whether f_det is stepped on is looked at once
    assert host["merge_ms"]["clear"] > 0
    assert error.loc["clear", ["means", "quats", "scales", "opacities", "sh0", "shN"]].max() < 1e-3
