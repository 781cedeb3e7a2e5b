"""The doors, as a user goes through them: the command line, its outputs, what it says to bad input, and its exit codes."""

import errno
import json
import os
import resource
import signal
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TextIO

import pytest

from clear_strategies.jobs import exit_codes
from tests.helpers.command_line import TINY, environment, read_by, run, started, stopped_by, wait_for
from tests.helpers.forked import Forked


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A tiny run of everything."""
    folder, shown = tmp_path_factory.mktemp("run"), ["fit.video=2", "fit.map_views=2"]
    result = run("+strategy=clear", "hydra.run.dir=here", *TINY, *shown, cwd=folder, drawn=True)
    assert result.returncode == 0, result.stderr
    return folder


def test_a_run_leaves_everything_it_promises(finished):
    out = finished / "here"
    for name in ("metrics.json", "conflict.csv", "timing.csv", "history.csv", "contact_sheet.jpg", "curves.png"):
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
    assert stages[:3] == ["capture and poses", "photos and SR images", "initial points"]
    assert {"maps", "pictures"} <= set(stages)
    pictures = [len(list(out.glob(kind))) for kind in ("renders/*.png", "views/*_truth.png", "maps/*/corrected.png")]
    assert pictures == [3, 3, 2]


SAVING = ["+strategy=gco", *TINY, "hydra.run.dir=cut", "fit.checkpoint_every=0"]


@pytest.mark.parametrize("signals", [(signal.SIGTERM,), (signal.SIGHUP,) * 3], ids=["SIGTERM", "three of SIGHUP"])
def test_a_signal_that_ends_a_run_saves_before(signals, tmp_path):
    """Of a terminal that is closed, the system and the shell send SIGHUP."""
    said = tmp_path / "said"
    ended = started("-c", stopped_by(*signals, after=5), *SAVING, cwd=tmp_path, said=said).wait()
    assert ended == 128 + signals[0], said.read_text()
    assert (
        f"Go on by the same command with fit.resume={tmp_path}/cut/checkpoints/step_0000006.safetensors."
        in said.read_text()
    )
    assert len(list((tmp_path / "cut/checkpoints").iterdir())) == 1


@pytest.mark.parametrize("ignored", [signal.SIGHUP, signal.SIGINT], ids=["nohup", "a job that a script starts with &"])
def test_a_run_goes_on_after_a_signal_that_it_was_started_to_ignore(ignored, tmp_path):
    said, shell = tmp_path / "said", f"import signal\nsignal.signal({int(ignored)}, signal.SIG_IGN)\n"
    ended = started("-c", shell + stopped_by(ignored, after=5), *SAVING, cwd=tmp_path, said=said).wait()
    assert (ended, (tmp_path / "cut/metrics.json").is_file()) == (0, True), said.read_text()


def test_a_terminal_that_is_closed_takes_nothing_of_a_run_with_it(tmp_path):
    """Its bar is drawn on the terminal until then; what is written afterwards fails."""
    code = (
        "import os\n"
        "master, terminal = os.openpty()\n"
        "for stream in (1, 2):\n"
        "    os.dup2(terminal, stream)\n"
        "os.close(terminal)\n"
    )
    kill = "            os.kill"
    closing = stopped_by(signal.SIGHUP, after=5).replace(kill, f"            os.close(master)\n{kill}")
    process = started("-c", code + closing, *SAVING, cwd=tmp_path, said=tmp_path / "said")
    log = tmp_path / "cut/run.log"
    assert process.wait() == 128 + signal.SIGHUP, log.read_text()
    go_on = f"Go on by the same command with fit.resume={tmp_path}/cut/checkpoints/"
    assert f"stopped by SIGHUP before iteration 6. {go_on}" in log.read_text()


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


MISTAKES = {
    "prior=onnx": "prior.path: is needed and missing",
    "+data.typo=1": "data.typo: ",
    "prior=demo prior.share=7": "prior.share: must lie in [0, 1], got 7",
    "fit.iterations=[": "fit.iterations: must be a whole number, got '['",
}


@pytest.mark.slow
def test_a_bad_setting_is_told_before_data_are_read_and_heavy_libraries_imported(tmp_path):
    """tests/mistakes.csv lists more settings, with the line and the exit code of each."""
    first_read = ["data=llff", "data.path=nowhere"]  # whoever reads data first complains of this
    code = (
        "import sys\nfrom clear_strategies.run import main\n"
        f"for words in {[*MISTAKES]}:\n"
        f"    sys.argv = ['clear-strategies', *{first_read}, *words.split()]\n"
        f"    try:\n        main()\n    except SystemExit as ended:\n"
        f"        print(ended.code, sys.modules.keys() & {HEAVY}, flush=True)"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment(tmp_path), text=True,
                           stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=True)  # fmt: skip
    told = iter(ended.stdout.splitlines())
    for message in MISTAKES.values():
        assert message in next(told)
        assert next(told) == "2 set()"
    assert [*told] == []


def test_the_exit_codes_of_a_whole_process(tmp_path):
    """What no fork can show: the time from the start; and the folder that Hydra itself makes."""
    for _ in range(3):  # again where it took long: a virtual machine may count what others use of its processors
        began = resource.getrusage(resource.RUSAGE_CHILDREN)
        bad = subprocess.run([sys.executable, "-m", "clear_strategies.run", "fit.iterations=abc"], cwd=tmp_path,
                             env=environment(tmp_path), capture_output=True, text=True, check=False)  # fmt: skip
        ended = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert (bad.returncode, (bad.stdout + bad.stderr).count("\n")) == (2, 1), bad.stdout + bad.stderr
        took = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
        if took < 8:  # 2.4 s here; a wall clock counts others too
            break
    assert took < 8
    unwritable = run("hydra.run.dir=/proc/run", cwd=tmp_path)  # by root neither
    said = unwritable.stdout + unwritable.stderr
    assert (unwritable.returncode, said.count("\n"), "/proc/run" in said) == (3, 1, True), said


def test_a_signal_at_pythons_own_end_says_nothing(tmp_path):
    """As an impatient second Ctrl-C."""
    code = "import atexit, signal\natexit.register(signal.raise_signal, signal.SIGINT)\n"
    ended = run("--version", cwd=tmp_path, code=f"{code}from clear_strategies.run import main\nmain()")
    assert (ended.stdout[:16], ended.stderr) == ("clear-strategies", "")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_data_is_prepared_is_one_line(stop, tmp_path):
    (tmp_path / "slow.py").write_text(
        "import time\n\n\ndef read():\n    print('reading', flush=True)\n    time.sleep(99)\n"
    )
    slow = ["hydra.run.dir=out", *read_by("slow.read")]
    said = tmp_path / "said"
    process = started("-m", "clear_strategies.run", *slow, cwd=tmp_path, said=said)
    wait_for(lambda: said.read_text().endswith("reading\n"))
    process.send_signal(stop)
    assert process.wait() == 128 + stop, said.read_text()
    assert said.read_text().endswith(f"\nreading\nstopped by {stop.name} before training began. Nothing was saved.\n")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_an_error_after_a_signal_whose_exception_a_library_has_lost_is_the_signals_one_line(stop, tmp_path):
    """As numpy's import does: an attribute is missing later."""
    code = (
        "import contextlib, signal\n"
        "from clear_strategies import run\n"
        "def named(_):\n"
        "    with contextlib.suppress(KeyboardInterrupt):\n"
        f"        signal.raise_signal({int(stop)})\n"
        "    raise AttributeError\n"
        "run.named = named\n"
        "run.main()\n"
    )
    ended = run(cwd=tmp_path, code=code)
    assert (ended.returncode, ended.stdout + ended.stderr) == (128 + stop, f"stopped by {stop.name}.\n")


@pytest.mark.parametrize(
    ("chosen", "package"), [("slurm", "submitit"), ("ray_gpus", "ray"), ("submitit_local", "submitit")]
)
def test_a_launcher_that_is_not_installed_names_its_package(chosen, package, tmp_path):
    if find_spec("hydra_plugins") and find_spec(f"hydra_plugins.hydra_{package}_launcher"):
        pytest.skip("it is installed")
    ended = run("-m", "+strategy=clear,gco", f"hydra/launcher={chosen}", cwd=tmp_path)
    assert ended.returncode == 2, ended.stdout
    assert ended.stderr.endswith(f"is not installed: pip install hydra-{package}-launcher.\n")


NOT_MAPPED = "x.so: failed to map segment from shared object"
ENDINGS = {
    KeyboardInterrupt(): (130, "stopped by SIGINT."),  # a job says what it has saved
    KeyboardInterrupt(signal.SIGTERM): (143, "stopped by SIGTERM."),
    RuntimeError("Job 7\nhas not produced any output (state: FAILED)"): (2, "a job of the sweep was ended, as by scancel."),
    RuntimeError('Could not detect "srun", are you indeed'): (2, "hydra/launcher: there is no Slurm on this machine"),
    OSError(errno.ENOSPC, "No space", "x"): (3, "x: No space. Free space, or write elsewhere (hydra.run.dir=FOLDER"),
    OSError(errno.EROFS, "Read-only", "x"): (3, "x: Read-only. Write elsewhere (hydra.run.dir=FOLDER of a run, hydra."),
    PermissionError(errno.EACCES, "Not permitted", "x"): (3, "x: Not permitted. Allow access to it, or write elsewhere ("),
    MemoryError(): (2, "out of memory: Python had none left. Raise `ulimit -v` where it is set. Lower density.max_gaus"),
    ImportError(NOT_MAPPED): (2, f"{NOT_MAPPED}: memory is limited to too little (raise `ulimit -v`), or"),
    OSError("Broken pipe\n\nCOMMAND:\nffmpeg"): (3, "output: Broken pipe COMMAND: ffmpeg. Write elsewhere"),
}  # fmt: skip


@pytest.mark.parametrize(("error", "ending"), ENDINGS.items(), ids=repr)
def test_an_error_that_the_user_can_solve_is_one_line_and_an_exit_code(error, ending) -> None:
    code, message = exit_codes.describe(error)
    assert (code, message[: len(ending[1])]) == ending


def gone() -> TextIO:
    """The end of a pipe that nobody reads, as after `… | head`."""
    reads, writes = os.pipe()
    os.close(reads)
    return os.fdopen(writes, "w")


@pytest.mark.parametrize(
    "read", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("stdout", "stderr")), "neither"]
)
def test_a_run_trains_on_where_who_reads_its_output_has_left(read, tmp_path):
    with gone() as pipe, (tmp_path / "said").open("w") as said:
        streams = {name: said if name == read else pipe for name in ("stdout", "stderr")}
        arguments = ["-m", "clear_strategies.run", "+strategy=gco", *TINY, "hydra.run.dir=here", "-v"]
        code = Forked(*arguments, cwd=tmp_path, env=environment(tmp_path), **streams).wait()
    assert (code, (tmp_path / "here/metrics.json").is_file()) == (0, True), (tmp_path / "said").read_text()
    assert "done in" in (tmp_path / "here/run.log").read_text()


ASCII = (
    "import runpy, sys\n"
    "sys.stdout = sys.__stdout__ = open(1, 'w', encoding='ascii', closefd=False)\n"
    "sys.stderr = sys.__stderr__ = open(2, 'w', encoding='ascii', closefd=False)\n"
    "module = sys.argv.pop(1)\n"
    "sys.modules.pop(module, None)\n"
    "runpy.run_module(module, run_name='__main__', alter_sys=True)\n"
)
"""A program whose console has ascii alone: it runs the module that its first argument names."""
QUICK = {
    "clear_strategies.run": ["--help", "train nowhere-ü"], "clear_strategies.report": ["nowhere-ü"],
    "clear_strategies.bench": ["--help"], "integration.inria": ["nowhere-ü.py"],
}  # fmt: skip
LINES = [(module, line) for module, lines in QUICK.items() for line in lines]


def command(module: str, line: str, folder: Path, **streams: TextIO) -> tuple[int, str]:
    """The exit code of a command and what it says on the streams that are not given."""
    with (folder / "said").open("w") as said:
        streams = {"stdout": said, "stderr": said, **streams}
        code = Forked("-c", ASCII, module, *line.split(), cwd=folder, env=environment(folder), **streams).wait()
    return code, (folder / "said").read_text()


@pytest.mark.parametrize(("module", "line"), LINES, ids=map(" ".join, LINES))
def test_a_command_ends_as_always_on_a_console_without_its_letters_and_without_a_reader(module, line, tmp_path):
    with gone() as pipe:
        code, said = command(module, line, tmp_path, stdout=pipe)
    assert code == (0 if "--help" in line else 2), said
    assert said == "" if "--help" in line else "nowhere-\\xfc" in said
    assert "Traceback" not in said


def test_letters_that_the_console_lacks_are_escaped_and_an_error_that_nobody_reads_has_its_exit_code(tmp_path):
    assert "[setting=value \\u2026]" in command("clear_strategies.run", "--help", tmp_path)[1]
    with gone() as pipe:
        assert command("clear_strategies.run", "train nowhere-ü", tmp_path, stderr=pipe)[0] == 2


def test_a_run_on_an_ascii_console_writes_into_folders_of_any_letters_and_of_the_users(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    arguments = ["+strategy=gco", *TINY, "fit.iterations=3", "hydra.run.dir=~/ü"]
    process = started("-c", ASCII, "clear_strategies.run", *arguments, cwd=tmp_path, said=tmp_path / "said")
    assert process.wait() == 0, (tmp_path / "said").read_bytes()
    assert (tmp_path / "home/ü/metrics.json").is_file()
    assert b"home/\\xfc/contact_sheet.jpg" in (tmp_path / "said").read_bytes()
    assert not (tmp_path / "~").exists()


def test_a_program_that_was_started_without_stdout_ends_as_always(tmp_path):
    shell = ["sh", "-c", f"exec {sys.executable} -m clear_strategies.run --help >&-"]
    ended = subprocess.run(shell, cwd=tmp_path, env=environment(tmp_path), stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_what_a_full_disk_takes_of_the_output_is_told(tmp_path):
    with Path("/dev/full").open("w") as full:
        words = [sys.executable, "-m", "clear_strategies.run", "--help"]
        assert subprocess.run(words, cwd=tmp_path, env=environment(tmp_path), stdout=full, check=False).returncode == 3
