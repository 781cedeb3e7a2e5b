"""The doors, as a user goes through them: the command line, its outputs, what it says to bad input, and its exit codes."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from clear_strategies.jobs import exit_codes
from tests.helpers.command_line import TINY, environment, run, started, stopped_by, wait_for


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A tiny run of everything."""
    folder, shown = tmp_path_factory.mktemp("run"), ["fit.video=2", "fit.map_views=2"]
    result = run("+strategy=clear", "hydra.run.dir=here", *TINY, *shown, cwd=folder, drawn=True)
    assert result.returncode == 0, result.stderr
    return folder


def test_a_run_leaves_everything_it_promises(finished):
    out = finished / "here"
    for name in ("metrics.json", "conflict.csv", "timing.csv", "history.csv", "contact_sheet.png", "curves.png"):
        assert (out / name).stat().st_size > 0, name
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["strategies"], metrics["overrides"][0]) == (["gco", "p2g", "svs"], "+strategy=clear")
    assert metrics["synthetic_prior"] is True
    assert set(metrics["test"]["mean"]) == {"ours", "bicubic", "prior"}
    assert 0 < metrics["conflict"]["gaussian"] < 1
    assert {"versions", "git", "seed", "backend", "plan"} <= set(metrics["provenance"])
    assert b"comment SplatRenderMode: mip" in (out / "point_cloud.ply").read_bytes()[:300]
    assert (out / "checkpoints" / "step_0000013.safetensors").is_file()
    timing = (out / "timing.csv").read_text()
    assert "skipped" in timing
    stages = [line.split(",")[0] for line in timing.splitlines()[1:]]
    assert stages[:2] == ["photos and SR images", "initial points"]
    assert {"maps", "contact sheet and curves"} <= set(stages)
    pictures = [len(list(out.glob(kind))) for kind in ("renders/*.png", "views/*_truth.png", "maps/*/corrected.png")]
    assert pictures == [3, 3, 2]


@pytest.mark.slow
def test_resuming_through_the_door_gives_the_same_field(finished):
    """A run cut by SIGTERM and resumed ends where the uninterrupted one did."""
    overrides, said = ["+strategy=clear", *TINY], finished / "said_before_the_cut"
    code = stopped_by(signal.SIGTERM, after=5)
    assert started("-c", code, *overrides, "hydra.run.dir=cut", cwd=finished, said=said).wait() == 143, said.read_text()
    assert "fit.resume=" in said.read_text()
    resumed = run(*overrides, "hydra.run.dir=resumed", "fit.resume=cut", cwd=finished)
    assert resumed.returncode == 0, resumed.stderr
    plys = [(finished / name / "point_cloud.ply").read_bytes() for name in ("resumed", "here")]
    assert plys[0] == plys[1]


def test_a_sweep_goes_on_after_a_bad_job(tmp_path):
    result = run("-m", "strategies.gco.tolerance=0.1,7", "+strategy=gco", *TINY, "fit.iterations=3", cwd=tmp_path)
    said = result.stdout + result.stderr
    assert result.returncode == 2
    assert "strategies.gco.tolerance: must lie in [0, 1), got 7" in said
    assert "Traceback" not in said
    assert len(list(tmp_path.glob("multirun/*/*/metrics.json"))) == 1


def test_a_strategy_of_another_package_trains_and_the_package_itself_is_the_command_line(tmp_path):
    (tmp_path / "theirs.py").write_text(
        "from dataclasses import dataclass\n"
        "from clear_strategies import Strategy\n\n\n"
        "@dataclass(frozen=True)\n"
        "class Mine(Strategy):\n"
        "    share: float = 0.5\n\n"
        "    def correct(self, lr, hr, evidence):\n"
        "        return hr * self.share\n"
    )
    result = run("+strategy=p2g", "+strategies.mine._target_=theirs.Mine", "+strategies.mine.share=0.25",
                 "hydra.run.dir=out", *TINY, "fit.iterations=3", cwd=tmp_path)  # fmt: skip
    # `python -m` puts the current folder on the path, as a user expects.
    assert result.returncode == 0, result.stderr
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["strategies"] == ["p2g", "mine"]
    result = run(cwd=tmp_path, module="clear_strategies")
    assert (result.returncode, result.stdout.split()[0]) == (0, "clear-strategies")


HEAVY = {"cv2", "scipy", "skimage", "kornia", "matplotlib", "pandas"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("prior=onnx", "prior.path: is needed and missing"),
        ("+data.typo=1", "data.typo: "),
        ("prior=demo prior.share=7", "prior.share: must lie in [0, 1], got 7"),
        ("fit.iterations=[", "fit.iterations: must be a whole number, got '['"),
    ],
)
def test_a_bad_setting_is_told_before_data_are_read_and_heavy_libraries_imported(overrides, message, tmp_path):
    """tests/mistakes.csv lists more settings, with the line and the exit code of each."""
    code = (
        "import sys\nfrom clear_strategies.run import main\n"
        f"try:\n    main()\nfinally:\n    print(sys.modules.keys() & {HEAVY})"
    )
    first_read = ["data=llff", "data.path=nowhere"]  # whoever reads data first complains of this
    ended = subprocess.run([sys.executable, "-c", code, *first_read, *overrides.split()], cwd=tmp_path,
                           env=environment(tmp_path), capture_output=True, text=True, check=False)  # fmt: skip
    told = (ended.stdout + ended.stderr).splitlines()
    assert (ended.returncode, len(told)) == (2, 2), told
    assert "set()" in told
    assert message in "".join(told)


def test_the_exit_codes_of_a_whole_process(tmp_path):
    """What no fork can show: the time from the start; and the folder that Hydra itself makes."""
    began = resource.getrusage(resource.RUSAGE_CHILDREN)
    bad = subprocess.run([sys.executable, "-m", "clear_strategies.run", "fit.iterations=abc"], cwd=tmp_path,
                         env=environment(tmp_path), capture_output=True, text=True, check=False)  # fmt: skip
    took = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert (bad.returncode, (bad.stdout + bad.stderr).count("\n")) == (2, 1), bad.stdout + bad.stderr
    # 2.4 s here; a wall clock counts others too
    assert took.ru_utime + took.ru_stime - began.ru_utime - began.ru_stime < 8
    unwritable = run("hydra.run.dir=/proc/run", cwd=tmp_path)  # by root neither
    said = unwritable.stdout + unwritable.stderr
    assert (unwritable.returncode, said.count("\n"), "/proc/run" in said) == (3, 1, True), said


def test_ctrl_c_while_data_is_prepared_is_one_line(tmp_path):
    (tmp_path / "slow.py").write_text(
        "import time\n\n\ndef read():\n    print('reading', flush=True)\n    time.sleep(99)\n"
    )
    slow = ["hydra.run.dir=out", "~data.reader.width", "~data.reader.height", "~data.reader.views", "~data.reader.train",
            "data.reader._target_=slow.read"]  # fmt: skip
    said = tmp_path / "said"
    process = started("-m", "clear_strategies.run", *slow, cwd=tmp_path, said=said)
    wait_for(lambda: said.read_text() == "reading\n")
    process.send_signal(signal.SIGINT)
    assert process.wait() == 130, said.read_text()
    assert said.read_text() == "reading\nstopped by SIGINT before training began. Nothing was saved.\n"


ENDINGS = {
    KeyboardInterrupt(): (130, "stopped by SIGINT."),  # a job says what it has saved
    OSError(errno.ENOSPC, "No space", "x"): (3, "x: No space. Free space, or write elsewhere (hydra.run.dir=FOLDER"),
    OSError(errno.EROFS, "Read-only", "x"): (
        3,
        "x: Read-only. Write elsewhere (hydra.run.dir=FOLDER of a run, --out of",
    ),
    OSError("Broken pipe\n\nCOMMAND:\nffmpeg"): (3, "output: Broken pipe COMMAND: ffmpeg. Write elsewhere"),
}


@pytest.mark.parametrize(("error", "ending"), ENDINGS.items(), ids=repr)
def test_an_error_that_the_user_can_solve_is_one_line_and_an_exit_code(error, ending) -> None:
    code, message = exit_codes.describe(error)
    assert (code, message[: len(ending[1])]) == ending


def test_a_reader_that_leaves_is_no_error(tmp_path: Path) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "w") as gone:
        ended = subprocess.run([sys.executable, "-m", "clear_strategies.run", "--help"], stdout=gone, cwd=tmp_path,
                               env=environment(tmp_path), stderr=subprocess.PIPE, text=True, check=False)  # fmt: skip
    assert (ended.returncode, ended.stderr) == (141, "")
