"""`.ci/gpu`, as far as a machine without a GPU can show it: its programs are stand-ins that only say how they were called."""

import os
import re
import subprocess

from clear_strategies.bench.__main__ import parser
from tests.helpers.configs import composed
from tests.helpers.paths import ROOT

SCRIPT = ROOT / ".ci" / "gpu"


def test_every_command_is_understood_and_a_step_that_fails_or_is_cut_off_stops_no_other(tmp_path):
    programs, out, scenes = tmp_path / "bin", tmp_path / "out", tmp_path / "scenes"
    programs.mkdir()
    called = f'echo "$(basename $0) $*" >> "{tmp_path}/calls"; echo "the last line"'
    beside = f'case "$*" in *gsplat.cuda*) touch "{tmp_path}/gsplat"; exit ;; esac'  # other steps
    limited = (
        f'{beside}; echo "$2" >> "{tmp_path}/limits"; shift 2; "$@" || exit; case "$*" in *" host "*) exit 124 ;; esac'
    )
    for name, program in {"python": called, "compute-sanitizer": called, "timeout": limited}.items():
        (programs / name).write_text(f"#!/bin/sh\n{program}\n")
        (programs / name).chmod(0o755)
    environment = {**os.environ, "PATH": f"{programs}:{os.environ['PATH']}"}
    done = subprocess.run([SCRIPT, out, scenes], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    steps = re.findall(r"(\S+): (passed|failed|cut off), \d+ s; (.*)\n", done.stdout)
    assert [(name, result) for name, result, _ in steps if result != "passed"] == [
        ("replays-replayed", "failed"), ("same-bits", "failed"), ("bench-host", "cut off"), ("replays-fern", "failed")
    ]  # fmt: skip
    assert {line for _, result, line in steps if result == "passed"} == {"the last line"}
    assert "point_cloud.ply" in (out / "logs" / "same-bits.log").read_text()
    assert sum(map(int, (tmp_path / "limits").read_text().split())) <= 9 * 60

    calls = [line.split() for line in (tmp_path / "calls").read_text().splitlines()]
    assert (tmp_path / "gsplat").exists()
    modules = [words[words.index("-m") + 1] for words in calls]
    order = ["pytest", *["clear_strategies.run"] * 2, *["clear_strategies.bench"] * 3]
    assert modules == [*order, "clear_strategies.run", "clear_strategies.bench", "pytest", "clear_strategies.run"]
    assert calls[-1][:3] == ["compute-sanitizer", "--tool", "memcheck"]
    for module, words in zip(modules, calls, strict=True):
        arguments = words[words.index(module) + 1 :]
        if module == "clear_strategies.bench":
            assert parser().parse_args(arguments).device == "cuda"
        elif module == "clear_strategies.run":
            assert composed(*(word for word in arguments if not word.startswith("hydra."))).fit.device == "cuda"
        else:
            assert all((ROOT / word).exists() for word in arguments if word.startswith("tests/"))
