"""`bench device`: its steps, as far as a CPU can show them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from clear_strategies.bench import device
from clear_strategies.bench.__main__ import parser
from clear_strategies.bench.device import Step
from clear_strategies.bench.results import Results
from clear_strategies.errors import DataError
from tests.helpers.configs import composed


def request(tmp_path: Path, **options) -> device.Request:
    return device.Request(tmp_path / "out", **{"device": "cpu", "quick": True, **options})


def prints(text: str, code: int = 0) -> list[str]:
    return [sys.executable, "-c", f"print({text!r}); raise SystemExit({code})"]


def steps_by_name(asked: device.Request) -> dict[str, Step]:
    return {step.name: step for step in device.steps(asked)}


def test_a_failed_step_stops_no_other_and_each_has_its_log(tmp_path):
    plan = [
        Step("first, a failure", prints("it broke", 3)),
        Step("compares", prints("done"), problem=lambda: "two files differ"),
        Step("works", prints("done")),
        Step("no GPU", prints("never"), "there is none"),
        Step("no program", [str(tmp_path / "absent")]),
    ]
    results = Results("device", lambda line: None)
    device.measure(results, request(tmp_path), lambda asked: plan)
    table, logs = results.tables["device"], tmp_path / "out" / "logs"
    assert results.failed
    assert list(table["result"]) == ["failed", "failed", "passed", "not run", "failed"]
    assert list(table["reason"])[:4] == ["exit code 3: it broke", "two files differ", "", "there is none"]
    assert (logs / "01_first_a_failure.log").read_text() == "it broke\n"
    assert not (logs / "04_no_gpu.log").exists()


def test_a_step_that_cannot_run_has_a_reason(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    on_cpu = steps_by_name(request(tmp_path, quick=False))
    assert on_cpu["compute-sanitizer racecheck"].why_not == "it needs CUDA"
    assert on_cpu["first use, filled cache"].why_not == "it needs CUDA"
    assert on_cpu["train, fern HR 1008x756"].why_not == "give the folder that holds fern with --data-root"
    (tmp_path / "fern" / "images_4").mkdir(parents=True)
    on_cuda = steps_by_name(request(tmp_path, device="cuda", quick=False, data_root=tmp_path))
    assert "not on the PATH" in str(on_cuda["compute-sanitizer memcheck"].why_not)
    assert on_cuda["train, fern HR 1008x756"].why_not is None
    assert "images_2 is not there" in str(on_cuda["train, fern HR 2016x1512"].why_not)


def test_a_sanitized_training_runs_uncached_under_the_tool(tmp_path, monkeypatch):
    tool = tmp_path / "compute-sanitizer"
    tool.touch(mode=0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    step = steps_by_name(request(tmp_path, device="cuda"))["compute-sanitizer memcheck"]
    assert list(step.command[:5]) == [str(tool), "--tool", "memcheck", "--error-exitcode", "9"]
    assert step.environment == {"PYTORCH_NO_CUDA_MEMORY_CACHING": "1"}
    assert step.why_not is None


def test_two_trainings_are_compared_byte_by_byte(tmp_path):
    asked = request(tmp_path)
    for name in ("once", "twice"):
        (asked.out / "checks" / name).mkdir(parents=True)
        (asked.out / "checks" / name / "point_cloud.ply").write_bytes(b"same")
    compare = steps_by_name(asked)["train, demo, twice: same bits"].problem
    assert compare() is None
    (asked.out / "checks" / "twice" / "point_cloud.ply").write_bytes(b"others")
    assert "differ" in compare()


def test_a_folder_with_files_is_refused(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(DataError, match="must be a new folder"):
        device.measure(Results("device", print), request(tmp_path))


@pytest.mark.parametrize("quick", [True, False])
def test_every_command_is_understood_by_its_program(tmp_path, quick):
    (tmp_path / "fern" / "images_4").mkdir(parents=True)
    paths = {"data_root": tmp_path, "data": tmp_path / "garden.npz", "scene": (tmp_path / "field.ply",)}
    for step in device.steps(request(tmp_path, device="cuda", quick=quick, **paths)):
        words = [str(word) for word in step.command]
        module, arguments = words[words.index("-m") + 1], words[words.index("-m") + 2 :]
        if module == "clear_strategies.bench":
            assert parser().parse_args(arguments).device == "cuda"
        elif module == "clear_strategies.run":
            overrides = [argument for argument in arguments if not argument.startswith("hydra.")]
            config = composed(*overrides)
            assert config.fit.device == "cuda"
            assert set(config.strategies) == {"gco", "p2g", "svs"}
        else:
            assert module == "pytest"


@pytest.mark.slow
def test_a_rehearsal_on_a_cpu_trains_and_measures(tmp_path, monkeypatch):
    monkeypatch.setenv("CLEAR_CACHE", str(tmp_path / "cache"))
    results, kept = Results("device", print), {"bench kernels", "train, demo", "first use, filled cache"}
    asked = request(tmp_path)
    device.measure(results, asked, lambda r: [step for step in device.steps(r) if step.name in kept])
    table = results.tables["device"].set_index("step")["result"]
    assert dict(table) == {"bench kernels": "passed", "train, demo": "passed", "first use, filled cache": "not run"}
    assert "SSIM" in (asked.out / "tables" / "kernels" / "kernels.csv").read_text()
    assert (asked.out / "runs" / "demo" / "timing.csv").is_file()
