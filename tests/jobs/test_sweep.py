"""Jobs that can be started again, and sweeps of several processes: what is done stays, what failed is told, all stop."""

import os
import re
import shutil
import signal
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hydra.types import RunMode
from omegaconf import OmegaConf, open_dict

from clear_strategies import hydra_app, signals
from clear_strategies.files import LOCK, HeldError, hold
from clear_strategies.hydra_app import FAILED, SweepCallback
from clear_strategies.jobs import device, sweep
from clear_strategies.training import checkpoint
from tests.helpers.command_line import TINY, read_by, run, started, stopped_by, times_of_files, wait_for
from tests.helpers.configs import composed, loader
from tests.helpers.finished_run import make_run

AUTO = ["fit.resume=auto", *TINY]
SWEEP = ["-m", "hydra.sweep.dir=all", "hydra.sweep.subdir=${hydra.job.num}", *AUTO]
DOOR = ["-m", "clear_strategies.run"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A run that nothing disturbed, of 40 iterations."""
    folder = tmp_path_factory.mktemp("whole")
    result = run("+strategy=clear", "hydra.run.dir=here", *AUTO, "fit.iterations=40", cwd=folder, drawn=True)
    assert result.returncode == 0, result.stderr
    return folder / "here"


def test_a_finished_run_is_not_trained_again(whole):
    before = times_of_files(whole)
    more = ["fit.iterations=40", "fit.keep=1", "fit.video=8"]
    again = run("+strategy=clear", "hydra.run.dir=here", *AUTO, *more, cwd=whole.parent)
    assert again.returncode == 0, again.stderr
    assert re.search("this run finished on .*; nothing is trained or written", again.stdout + again.stderr)
    assert times_of_files(whole) == before


def test_a_sweeps_job_that_is_refused_leaves_the_folder_of_a_finished_run_as_it_is(whole):
    before, sweep = times_of_files(whole), ["-m", "hydra.sweep.dir=.", "hydra.sweep.subdir=here", *AUTO]
    result = run("+strategy=clear", *sweep, "fit.iterations=-1", cwd=whole.parent)
    assert (result.returncode, "1 job failed: job 0: " in result.stdout) == (2, True), result.stdout
    assert times_of_files(whole) == before
    assert whole.with_name(f"here_{FAILED}").read_text().startswith("job 0: fit.iterations: must be")


LLFF = ["-m", "data=llff", "+strategy=clear,gco"]


@pytest.mark.parametrize(
    ("sweep", "reason"),
    [
        (["experiment=llff_x4"], "data.root: is needed and missing. Add data.root=…."),
        (LLFF, "data.path: is needed and missing. Add data.path=…."),
        ([*LLFF, "data.path=gone/fern,gone/horns"], "gone: data.path: is not there: correct the path"),
        (["-m", "+strategy=clear,gco", "prior=onnx", "prior.path=gone"], "gone: prior.path: is not there: correct the path"),
        (["experiment=table1", "data.root=gone"], "gone: data.root: is not there: correct the path"),
        (["experiment=llff_x4", "+hydra.sweeper.params.prior='auto,null'"],  # as of an experiment's file
         "prior=null: there is no such option. There are auto, bicubic, corrupted, demo, images, onnx, realesrgan, waifu2x."),
    ],
)  # fmt: skip
def test_a_sweep_whose_jobs_all_lack_the_same_is_refused_once_before_any_of_them_starts(sweep, reason, tmp_path):
    result = run(*sweep, cwd=tmp_path)
    assert (result.returncode, result.stdout + result.stderr) == (2, f"error: {reason}\n")
    assert not list(tmp_path.iterdir())


def test_jobs_that_choose_the_same_options_are_composed_once_to_be_checked(monkeypatch):
    """A composition takes 0.2 s, and table 1 has 216 jobs."""
    composed = list[list[str]]()
    load = loader().load_sweep_config
    monkeypatch.setattr(sweep.GlobalHydra, "instance", lambda: SimpleNamespace(config_loader=loader))
    monkeypatch.setattr(loader(), "load_sweep_config", lambda *asked: composed.append(asked[1]) or load(*asked))
    words = ["experiment=table1", "data.root=gone", "data.scene=fern,horns", "+method=srgs,splatsure"]
    config = loader().load_configuration("config", words, run_mode=RunMode.MULTIRUN)
    paths = {(job.data.path, job.fit.seed, job.method) for job in sweep._jobs(config)}
    assert paths == {
        (f"gone/{scene}", i, m) for scene in ("fern", "horns") for i in range(3) for m in ("srgs", "splatsure")
    }
    assert len(composed) == 2


@pytest.mark.parametrize(
    ("swept", "failed", "done"),
    [
        ([*LLFF, "data.path=gone,here"], 4, 0),
        (["-m", "prior=images,demo,onnx", *TINY], 2, 1),  # the job between those that fail
        (["-m", "prior=images", "prior.path=gone", "data.save_lr=lr", *TINY], 0, 0),  # the SR images are made of this
    ],
)
def test_a_sweep_whose_jobs_do_not_all_lack_the_same_begins_and_goes_on_after_a_bad_job(swept, failed, done, tmp_path):
    result = run(*swept, "hydra.sweep.dir=all", cwd=tmp_path)
    assert result.returncode == (2 if failed else 0), result.stdout
    assert (f"{failed} jobs failed" in result.stdout) == bool(failed)
    assert "Traceback" not in result.stdout + result.stderr
    assert len(list(tmp_path.glob("all/*/metrics.json"))) == done


@pytest.mark.parametrize(
    ("asked", "folders"),
    [
        (["-m"], ["defaults"]),
        (["fit.seed=0,1", "-m", "fit.verbose=true"], ["fit.seed=0", "fit.seed=1"]),
        (["+strategy=gco", "fit.threads=1,2"], ["+strategy=gco,fit.threads=1", "+strategy=gco,fit.threads=2"]),
        (["prior=onnx", "prior.path=../a,b/c"], ["prior.path=.._a,prior=onnx", "prior.path=b_c,prior=onnx"]),
        (
            ["experiment=table5", "protocol=scenes", "data.root=a,b", "+method=srgs", "+scene=fern", "fit.seed=0"],
            [f"+method=srgs,+scene=fern,data.root={root},fit.seed=0,protocol=scenes" for root in "ab"],
        ),
        (["fit.threads=1,2", "hydra.sweep.subdir=${hydra.job.num}"], ["0", "1"]),
        (
            ["experiment=table5", "+method=srgs,splatsure", "data.scene=room", "data.root=a", "fit.seed=0"],
            [f"+method={m},data.scene=room,fit.seed=0" for m in ("srgs", "splatsure")],
        ),
        (
            ["+method=srgs,splatsure", "+strategy=gco,svs"],
            [f"+method={m},+strategy={s}" for m in ("srgs", "splatsure") for s in ("gco", "svs")],
        ),
    ],
)
def test_the_folders_of_a_sweeps_jobs_are_named_by_all_in_which_they_differ(asked, folders, monkeypatch):
    monkeypatch.setattr(sweep.GlobalHydra, "instance", lambda: SimpleNamespace(config_loader=loader))
    config = loader().load_configuration("config", [w for w in asked if w != "-m"], run_mode=RunMode.MULTIRUN)
    sweep.leave_out_what_methods_set_aside(config)
    sweep.name_by_all_that_is_swept(config)
    named = list[str]()
    for number, overrides in enumerate(sweep._overrides_of_jobs(config)):
        job = loader().load_sweep_config(config, overrides)
        with open_dict(job):
            job.hydra.job.num = number
        named.append(job.hydra.sweep.subdir)
    assert sorted(map(str, named)) == sorted(folders)


@pytest.mark.slow
def test_a_killed_run_goes_on_from_the_newest_whole_checkpoint_and_ends_the_same(whole, tmp_path):
    """SIGKILL, then a damaged newest checkpoint: the one before it is taken; seconds and counts go on."""
    every = [*AUTO, "fit.iterations=40", "fit.checkpoint_every=2500", "+strategy=clear", "hydra.run.dir=here"]
    process = started(*DOOR, *every, cwd=tmp_path, said=tmp_path / "said")
    saved = tmp_path / "here" / "checkpoints"
    wait_for(lambda: len(checkpoint.saved(saved)) >= 2)
    process.kill()
    process.wait()
    (tmp_path / "here" / "metrics.json").unlink(missing_ok=True)  # on a fast machine it had ended before
    newest, before = checkpoint.saved(saved)[-1], checkpoint.saved(saved)[-2]
    newest.write_bytes(b"torn")
    result = run(*every, cwd=tmp_path)
    said = result.stdout + result.stderr
    assert result.returncode == 0, said
    assert "is no whole checkpoint" in said
    assert f"resumed from {before}" in said
    assert (tmp_path / "here" / "point_cloud.ply").read_bytes() == (whole / "point_cloud.ply").read_bytes()
    history = [line.split(",") for line in (tmp_path / "here" / "history.csv").read_text().splitlines()]
    seconds = [float(row[history[0].index("seconds")]) for row in history[1:]]
    assert len(seconds) == 40
    assert seconds == sorted(seconds)


def test_torch_and_kernels_divide_the_cores_among_the_jobs_whatever_an_earlier_job_has_set(monkeypatch):
    before, default = torch.get_num_threads(), device.threads(None)
    torch.set_num_threads(default[0] + 1)  # fit.threads of the job before, in this process
    later = device.threads(None)
    torch.set_num_threads(before)
    assert later == default
    monkeypatch.setattr(device, "_threads_of_torch", lambda: 16)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _pid: set(range(12)), raising=False)
    for jobs, each in zip((1, 2, 5, 12, 40, -1, -2), (12, 6, 2, 1, 1, 1, 1), strict=True):
        monkeypatch.setattr(device, "jobs_at_once", lambda jobs=jobs: jobs)
        assert device.threads(None)[0] == each
    monkeypatch.setattr(device, "jobs_at_once", lambda: 1)
    monkeypatch.setattr(device, "_threads_of_torch", lambda: 2)  # OMP_NUM_THREADS=2
    assert device.threads(None) == (2, "of 12 here")
    assert device.threads(3) == (3, "fit.threads")


@pytest.mark.slow
def test_a_job_that_another_process_is_at_is_left_to_it(tmp_path, monkeypatch):
    """So the same command, started several times, shares the work."""
    with hold(tmp_path / "all" / "1"):
        result = run(*SWEEP, "+strategy=baseline,gco", "fit.iterations=3", cwd=tmp_path)
    said = result.stdout + result.stderr
    assert result.returncode == 0, said
    assert "left to the other process" in said
    assert (tmp_path / "all" / "0" / "metrics.json").exists()
    assert not (tmp_path / "all" / "1" / "metrics.json").exists()


def test_strategies_stay_in_a_sweep_of_a_method_of_ones_own_that_keeps_them(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep.GlobalHydra, "instance", lambda: SimpleNamespace(config_loader=loader))
    (tmp_path / "method").mkdir()
    (tmp_path / "method/mine.yaml").write_text("# @package _global_\nfit:\n  keep: 2\n")
    words = [f"hydra.searchpath=[file://{tmp_path}]", "+strategy=baseline,gco,svs", "+method=mine"]
    config = loader().load_configuration("config", words, run_mode=RunMode.MULTIRUN)
    sweep.leave_out_what_methods_set_aside(config)
    jobs = sweep._overrides_of_jobs(config)
    assert [job[0] for job in jobs] == [f"+strategy={name}" for name in ("baseline", "gco", "svs")]


def test_a_sweep_in_which_one_method_of_several_sets_strategies_aside_is_refused(tmp_path):
    """Its jobs of this method would be one run in one folder."""
    words = ["-m", "+strategy=gco,svs", "+method=srgs,[]", *TINY]
    result = run(*words, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stdout.startswith("error: +method=srgs: sets strategies aside"), result.stdout
    assert not list(tmp_path.iterdir())


def test_a_sweep_that_is_stopped_between_two_jobs_tells_how_to_go_on(monkeypatch, caplog):
    def stopped(*_):
        hydra_app._begun.append("all")
        raise KeyboardInterrupt

    monkeypatch.setattr(hydra_app, "_run_hydra", stopped)
    with caplog.at_level("INFO"), pytest.raises(KeyboardInterrupt):
        hydra_app.main(["-m", "+strategy=gco,svs"])
    assert caplog.messages[-1] == GO_ON


def test_a_sweep_goes_on_after_a_job_with_a_bug_shows_its_traceback_and_reports_the_others(tmp_path):
    (tmp_path / "broken.py").write_text(
        "from dataclasses import dataclass\n\nfrom clear_strategies import Strategy, Weights\n\n\n"
        "@dataclass(frozen=True)\nclass Veto(Strategy):\n    fails: bool\n\n"
        "    def reconcile(self, products, step):\n        return Weights(keep=1 / (not self.fails))\n"
    )
    words = ["-m", "+strategies.x._target_=broken.Veto", "+strategies.x.fails=true,false", "hydra.sweep.dir=all", *TINY]
    ended = run(*words, cwd=tmp_path)
    assert ended.returncode == 2, ended.stdout + ended.stderr
    assert ended.stdout.count('broken.py", line') == 1
    assert ended.stdout.splitlines()[-1] == "error: 1 job failed: job 0: ZeroDivisionError: division by zero"
    assert len(list(tmp_path.glob("all/*/metrics.json"))) == 1
    assert (tmp_path / "all/report.md").exists()


GO_ON = "Go on with the sweep by the same command with hydra.sweep.dir=all fit.resume=auto."


def test_a_sweep_that_is_stopped_starts_no_other_job_and_tells_how_to_go_on(tmp_path):
    """The name of its folder is the time; a checkpoint, which its job names, is of no use to the others."""
    code = stopped_by(signal.SIGINT, after=5)
    every = ["-m", "+strategy=gco,svs", "hydra.sweep.dir=all", "hydra.sweep.subdir=${hydra.job.num}", *TINY]
    process = started("-c", code, *every, cwd=tmp_path, said=tmp_path / "said")
    assert process.wait() == 130
    *_, of_job, last = (tmp_path / "said").read_text().splitlines()
    assert re.fullmatch(r"stopped by SIGINT before iteration (\d+)\. It is saved: \S+/step_0*\1\.safetensors\.", of_job)
    assert last == GO_ON
    assert not (tmp_path / "all/1").exists()


joblib = pytest.mark.skipif(
    find_spec("hydra_plugins") is None or find_spec("hydra_plugins.hydra_joblib_launcher") is None,
    reason="hydra-joblib-launcher is not installed: pip install -e '.[sweeps]'",
)
JOBLIB = ["hydra/launcher=cores", "hydra.launcher.n_jobs=2"]


@pytest.mark.skipif(find_spec("submitit") is None, reason="pip install hydra-submitit-launcher")
@pytest.mark.slow
def test_a_job_that_submitit_preempts_is_handed_in_again_and_resumed(tmp_path):
    """As Slurm does before a time limit; hydra/launcher=slurm asks for the same, and for a GPU."""
    sweep = [*SWEEP, "hydra/launcher=submitit_local", "hydra.sweep.subdir=job", "+strategy=clear", "fit.iterations=900"]
    process = started(*DOOR, *sweep, cwd=tmp_path, said=tmp_path / "said")
    run_folder = tmp_path / "all" / "job"
    wait_for((run_folder / "cameras.json").exists)
    (controller,) = (path.name for path in (tmp_path / "all" / ".submitit").iterdir() if path.name.isdecimal())
    (job,) = Path(f"/proc/{controller}/task/{controller}/children").read_text().split()
    os.kill(int(job), signal.SIGUSR2)
    assert process.wait() == 0, (tmp_path / "said").read_text()
    log = (run_folder / "run.log").read_text()
    assert "resumed from" in log
    assert 1 < int(re.search(r"resumed from .*step_(\d+)", log)[1]) < 900
    assert (run_folder / "metrics.json").exists()
    assert (tmp_path / "all" / "report.md").exists()
    launcher = composed("hydra/launcher=slurm", hydra=True).hydra.launcher
    assert (launcher.gpus_per_node, launcher.max_num_timeout, launcher.timeout_min) == (1, 20, 240)


@joblib
@pytest.mark.slow
def test_a_stopped_joblib_sweep_saves_its_running_jobs_begins_no_other_and_leaves_no_worker(tmp_path):
    sweep = [*SWEEP, *JOBLIB, "+strategy=baseline,gco,p2g", "fit.iterations=100_000", "fit.checkpoint_every=10"]
    process = started(*DOOR, *sweep, cwd=tmp_path, said=tmp_path / "said", session=True)
    running = [tmp_path / "all" / job for job in ("0", "1")]
    wait_for(lambda: all(checkpoint.saved(folder / "checkpoints") for folder in running))  # they train
    process.send_signal(signal.SIGHUP)
    assert process.wait() == 128 + signal.SIGHUP, (tmp_path / "said").read_text()
    for folder in running:
        told = r"stopped by SIGHUP before iteration (\d+)\. It is saved: \S+/step_0*\1\.safetensors\."
        assert re.search(told, (folder / "run.log").read_text())
    assert not (tmp_path / "all" / "2").exists()

    def gone() -> bool:
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return True
        return False

    wait_for(gone, what="the workers to end")
    assert (tmp_path / "said").read_text().splitlines()[-1] == GO_ON
    assert "Traceback" not in (tmp_path / "said").read_text()


@joblib
@pytest.mark.slow
def test_a_sweep_whose_process_the_system_kills_ends_with_one_line_that_tells_how_to_go_on(tmp_path):
    """As the kernel does where memory runs out."""
    (tmp_path / "killed.py").write_text(
        "import os, signal\n\n\ndef read():\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    sweep = ["-m", "hydra.sweep.dir=all", *JOBLIB, *read_by("killed.read"), "fit.seed=0,1"]
    process = started(*DOOR, *sweep, cwd=tmp_path, said=tmp_path / "said")
    code, said = process.wait(), (tmp_path / "said").read_text()
    assert (code, "Traceback" in said) == (2, False), said
    assert "a process of the sweep was ended (SIGKILL(-9)" in said.splitlines()[-1]
    assert said.endswith("with fit.resume=auto and the same hydra.sweep.dir. Lower hydra.launcher.n_jobs.\n")


@joblib
def test_a_stopped_sweep_composes_none_of_its_remaining_jobs(monkeypatch):
    """Hydra's launcher, with joblib in this process: a signal comes while it hands out the first job."""
    from hydra_plugins.hydra_joblib_launcher import _core as launcher

    handed_out = list[int]()

    def parallel(**_):
        def run(jobs):
            for _, (number, *_), _ in jobs:
                handed_out.append(number)
                sweep.stop_workers(signal.SIGTERM, sys._getframe())
            return []

        return run

    monkeypatch.setattr(launcher, "configure_log", lambda *_: None)  # of this process
    monkeypatch.setattr(launcher, "Parallel", parallel)
    monkeypatch.setattr(sweep.multiprocessing, "active_children", lambda: [SimpleNamespace(pid=2**22 + 1)])
    monkeypatch.setattr(sweep.signal, "signal", lambda *_: None)
    monkeypatch.setattr(signals, "told", [])
    config = OmegaConf.create({"hydra": {"hydra_logging": None, "verbose": False, "sweep": {"dir": "."}}})
    asked = SimpleNamespace(
        config=config, task_function=len, hydra_context=SimpleNamespace(config_loader=None), joblib={}
    )
    launcher.launch(asked, [["fit.seed=0"], ["fit.seed=1"], ["fit.seed=2"]], 0)
    assert handed_out == [0]


def test_a_clusters_announcement_saves_before_its_handler_acts(tmp_path):
    """SIGUSR2, as submitit handles it: what it would do at once is done after the checkpoint."""
    handler = (
        "import signal, sys\n"
        "def hand_in_again(signum, frame):\n"
        "    from clear_strategies.training import checkpoint\n"
        "    from pathlib import Path\n"
        "    sys.exit(90 + len(checkpoint.saved(Path('here/checkpoints'))))\n"
        "signal.signal(signal.SIGUSR2, hand_in_again)\n"
    )
    code = handler + stopped_by(signal.SIGTERM, signal.SIGUSR2, after=5)  # some clusters send SIGTERM first
    every = ["+strategy=clear", "hydra.run.dir=here", *AUTO, "fit.checkpoint_every=0"]
    process = started("-c", code, *every, cwd=tmp_path, said=tmp_path / "said")
    assert process.wait() == 91, (tmp_path / "said").read_text()


def test_failed_jobs_are_told_by_their_own_sweep_and_their_notes_stay_until_the_job_begins_again(tmp_path):
    def sweep_of(*strategies: str, iterations: str) -> tuple[int, str]:
        words = [f"+strategy={','.join(strategies)}", *TINY, f"fit.iterations={iterations}", "fit.resume=auto"]
        folders = ["hydra.sweep.dir=all", "hydra.sweep.subdir=${hydra.runtime.choices.strategy}"]
        ended = run("-m", *words, *folders, cwd=tmp_path)
        return ended.returncode, ended.stdout.splitlines()[-1]

    failed = "error: 1 job failed: job 0: fit.iterations: must be a whole number of at least 1, got -1"
    assert sweep_of("gco", iterations="-1")[1].startswith(failed)
    (note,) = (tmp_path / "all").rglob(f"*{FAILED}")
    code, last = sweep_of("svs", iterations="2")
    assert (code, "failed" in last, note.is_file()) == (0, False, True), last
    assert sweep_of("gco", iterations="-1")[1].startswith(failed)  # the same job, again
    assert (sweep_of("gco", iterations="2")[0], note.is_file()) == (0, False)


def test_failed_jobs_are_told_where_the_report_cannot_be_written(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(signals, "handle", lambda _: None)  # else this process keeps the handlers of a sweep
    callback, choices = SweepCallback(), {"choices": {"hydra/sweeper": "optuna"}}
    config = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path), "subdir": "1"}, "runtime": choices}})
    make_run(tmp_path / "0")
    (tmp_path / "0" / FAILED).write_text("job 0: of an earlier sweep")
    callback.on_multirun_start(config)
    (tmp_path / "1").mkdir()
    (tmp_path / "1" / FAILED).write_text("job 1: no such photo\n")
    (tmp_path / "report.md").mkdir()
    with pytest.raises(SystemExit) as ended:
        callback.on_multirun_end(config)
    assert ended.value.code == 2
    assert "1 job failed: job 1: no such photo" in caplog.text
    assert "there is no report: [Errno" in caplog.text


# ---- one writer a folder; the tests above show that a living process is respected, and the folder of a killed one is free
def test_a_held_folder_is_refused_released_when_the_job_fails_and_may_be_removed_by_hand(tmp_path):
    folder = tmp_path / "run"
    with (
        hold(folder),
        pytest.raises(HeldError, match=r"run\.lock: lock: another run is at work .*: wait"),
        hold(folder),
    ):
        pass
    for _ in range(2):
        with pytest.raises(KeyError), hold(folder):
            raise KeyError
    with hold(tmp_path):
        (tmp_path / LOCK).unlink()
    with hold(tmp_path / "run"):
        shutil.rmtree(tmp_path / "run")
