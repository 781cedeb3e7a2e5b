"""`.ci/gpu`, as far as a machine without a GPU can show it: its programs are stand-ins that only say how they were called."""

import os
import subprocess
from pathlib import Path

from clear_strategies.bench.__main__ import parser
from tests.helpers.configs import composed

SCRIPT = Path(__file__).resolve().parents[1] / ".ci" / "gpu"


def test_every_command_is_understood_and_a_failed_step_stops_no_other(tmp_path):
    programs, out, scenes = tmp_path / "bin", tmp_path / "out", tmp_path / "scenes"
    programs.mkdir()
    for name in ("python", "compute-sanitizer"):
        (programs / name).write_text(f'#!/bin/sh\necho "{name} $*" >> "{tmp_path}/calls"\n')
        (programs / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    done = subprocess.run([SCRIPT, out, scenes], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    failed = [f"{step}: failed, 0 s" for step in ("same-bits", "same-bits-replayed")]
    assert [line for line in done.stdout.splitlines() if ": passed" not in line] == failed
    assert "point_cloud.ply" in (out / "logs" / "same-bits.log").read_text()
    calls = [line.split() for line in (tmp_path / "calls").read_text().splitlines()]
    modules = [words[words.index("-m") + 1] for words in calls]
    assert {"clear_strategies.bench", "clear_strategies.run"} <= set(modules)
    assert [words[:3] for words in calls[-2:]] == [
        ["compute-sanitizer", "--tool", tool] for tool in ("memcheck", "racecheck")
    ]
    for module, words in zip(modules, calls, strict=True):
        arguments = words[words.index(module) + 1 :]
        if module == "clear_strategies.bench":
            assert parser().parse_args(arguments).device == "cuda"
        elif module == "clear_strategies.run":
            assert composed(*(word for word in arguments if not word.startswith("hydra."))).fit.device == "cuda"
