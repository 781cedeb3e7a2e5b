"""The fair table and the papers' protocols: every file composes, every baseline trains, every sweep is what it says."""

import itertools
import math
from collections.abc import Callable
from pathlib import Path

import pytest
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

import rasterizers
from clear_strategies import Conductor
from clear_strategies.compose import tree
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.hydra_app import readable
from clear_strategies.jobs.settings import settings_of
from clear_strategies.merging.skips import Skips
from clear_strategies.schedules import scaled
from clear_strategies.settings import CHANGES_NO_RESULT, build
from clear_strategies.training.loop import fit
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.command_line import TINY, run
from tests.helpers.configs import composed, jobs_of, loader, options


def jobs(*arguments: str) -> tuple[list[dict[str, str]], Callable[[dict[str, str]], DictConfig]]:
    """The jobs that Hydra's sweeper makes of a command line, and what composes one."""
    whole = loader().load_configuration("config", list(arguments), run_mode=RunMode.MULTIRUN)
    assert whole.hydra.mode == RunMode.MULTIRUN

    def composed_job(job: dict[str, str]) -> DictConfig:
        return loader().load_sweep_config(whole, [f"{key}={value}" for key, value in job.items()])

    return [dict(override.split("=", 1) for override in job) for job in jobs_of(whole, arguments)], composed_job


def pieces(config: DictConfig, stretch: float = 1.0):
    """What `run` builds of a configuration, without data."""
    values = OmegaConf.to_container(config)
    built = [build(values[key], key) for key in ("objective", "density", "optim", "mip", "fit")]
    strategies = build(OmegaConf.to_container(config.strategies, resolve=True), "strategies")
    return [scaled(s, stretch) for s in strategies.values()], *(scaled(thing, stretch) for thing in built[:-1])


@pytest.mark.parametrize("word", ["+method=[]", "+method=srgs,[]"])
def test_the_row_of_clear_can_be_chosen_as_those_of_the_methods(word):
    """As conf/experiment/table1.yaml says."""
    assert readable(word) == word


OF_ITS_OWN = ("binocular3dgs_srgs", "dropgaussian", "s2gaussian", "splatsure")  # strategies, one method of each
TRAINED = [(name, "auto") for name in options("method")]
TRAINED += [pytest.param(name, "off", marks=pytest.mark.slow) for name in OF_ITS_OWN]


@pytest.mark.parametrize(("name", "fused"), TRAINED)
def test_every_method_trains(name, fused):
    """Few iterations of a toy, through every phase; the loss that it is about falls."""
    # After a reset the loss has to fall anew; a toy that doubles its Gaussians in 32 iterations does not settle.
    config = composed(f"+method={name}", "density.reset_every=0", "density.threshold=1.5e-3")
    assert config.method == name
    hr = config.objective.lambda_hr  # what docs/how-to/baselines.md says that none has
    assert hr.peak == hr.final
    assert hr.peak == 0 or (hr.start, hr.full) == (0, 0)
    assert config.objective.lambda_hf == 0
    if "svs" in config.strategies:  # DropGaussian's dropout alone
        assert (config.strategies.svs.anchor_strength, config.strategies.svs.looks) == (0, 0)
    settings = FitSettings(iterations=32, max_degree=1, probe_every=0, checkpoint_every=0, fused=fused)
    strategies, objective, density, rates, mip = pieces(config, settings.stretch)
    scene = toy.scene()
    conductor = Conductor(*strategies, objective=objective, statistics_from=1)
    state = TrainState.start(
        scene, conductor, settings=scaled(settings, settings.stretch), density=density, rates=rates, mip=mip
    )
    compiled = state.compiled_step is not None
    assert not (compiled and fused == "off")
    fit(state, scene, rasterizers.load(rasterizers.fastest("cpu")))
    drawn = {stage for stage in conductor.work_log.entries if stage.startswith("render")}
    if (name.endswith("_lr") and name != "srgs_lr") or name in ("dropgaussian", "s2gaussian"):
        assert drawn == {"render LR", "render LR + HR"}  # the second one only as skipped
        assert conductor.work_log.entries["render LR + HR"].runs == 0
        told = "loss_lr"
    else:
        assert drawn == {"render HR"}
        told = "loss_base"
    losses = [row[told] for row in state.history]
    assert all(math.isfinite(loss) for loss in losses)
    assert sum(losses[-6:]) < sum(losses[:6])
    assert float(state.field.detail.data.abs().max()) == 0  # no baseline has the detail feature


def test_a_method_is_the_same_whatever_strategies_are_named_before_it():
    """The decorator of best would change the SR images of srgs, the λ_HR of readings=paper train 3dgs_lr on SR images."""
    assert list(composed("+strategy=clear", "+method=dropgaussian").strategies) == ["svs"]
    assert list(composed("+method=srgs", "+strategy=gco").strategies) == ["gco"]
    assert composed("+strategy=best", "+method=srgs") == composed("+method=srgs")
    for name in ("3dgs_lr", *OF_ITS_OWN):  # no detail feature: its rates have no effect
        printed, measured = (
            tree(composed(f"+method={name}", "skips=none", f"readings={r}")) for r in ("paper", "measured")
        )
        rates = {key: measured["optim"][key] for key in ("detail", "detail_decay", "detail_steps")}
        assert {**printed, "optim": {**printed["optim"], **rates}} == measured, name


SCENES = {
    "llff_x4": "fern flower fortress horns leaves orchids room trex",
    "llff_x4_quarter": "fern flower fortress horns leaves orchids room trex",
    "blender_x4": "chair drums ficus hotdog lego materials mic ship",
    "mip360_x4": "bicycle bonsai counter garden kitchen room stump",
}
CLEAR = ["gco", "p2g", "svs"]
ROWS = {
    "table5": {"baseline": [], "gco": ["gco"], "[gco,p2g]": ["gco", "p2g"], "clear": CLEAR},
    "ablation": {"baseline": [], "gco": ["gco"], "[gco,p2g]": ["gco", "p2g"], "clear": CLEAR},
    "leave_one_out": {"clear": CLEAR, "[p2g,svs]": CLEAR[1:], "[gco,svs]": ["gco", "svs"], "[gco,p2g]": CLEAR[:2]},
}


@pytest.mark.parametrize("experiment", [*SCENES, *ROWS])
def test_an_experiment_is_its_scenes_times_seeds_times_rows(experiment):
    found, composed_job = jobs(f"experiment={experiment}", "data.root=here")
    scenes = SCENES[experiment if experiment in SCENES else "llff_x4"].split()
    rows = ROWS.get(experiment, {"clear": CLEAR})
    expected = list(itertools.product(scenes, "012", rows))
    assert [(job["data.scene"], job["fit.seed"], job["+strategy"]) for job in found] == expected
    for job in found[: len(rows)] if experiment == "leave_one_out" else found[:1]:  # of the first scene and seed
        c = composed_job(job)
        assert list(c.strategies) == rows[job["+strategy"]]
        assert (c.fit.iterations, c.fit.seed, c.data.path) == (10_000, 0, f"here/{scenes[0]}")
        assert c.hydra.sweep.dir == f"multirun/{experiment}"
        assert c.hydra.sweep.subdir == f"+strategy={job['+strategy']},data.scene={scenes[0]},fit.seed=0"
        assert isinstance(build(OmegaConf.to_container(c.data.views)), ViewSettings)
        pieces(c)


EVIDENCE = {
    "evidence": (5 * 3 * 6, "Onnx"),
    "evidence_corrupted": (5 * 3 * 4, "Corrupted"),
    "evidence_baselines": (5 * 8, "Onnx"),
    "evidence_skips": (4 * 3 * 2, "Onnx"),
    "evidence_geometry": (5 * 3 * 2 * 2, "AutoPrior"),
    "conflict_by_views": (6 * 2, "Onnx"),
    "conflict_in_training": (4, "Onnx"),
    "training_time": (2 * 2, "Onnx"),
}


@pytest.mark.parametrize("experiment", EVIDENCE)
def test_the_evidence_differs_in_what_it_sweeps_alone(experiment):
    count, prior = EVIDENCE[experiment]
    found, composed_job = jobs(f"experiment={experiment}", "data.root=here")
    assert len(found) == count
    for job in (found[0], found[-1]):
        c = composed_job(job)
        assert c.fit.iterations == (1_500 if job["+scene"] in ("fern", "horns") else 3_000)
        assert c.prior._target_.endswith(prior)
        assert c.data.path == f"here/{job['+scene']}"
        assert c.fit.resume == "auto"
        skips = job.get("skips", "measured" if experiment == "evidence_geometry" else "none")
        assert (c.skips.coarse_until == 0) == (skips == "none")
        pieces(c)


METHODS = set(options("method")) - {"srgs_lr", "binocular3dgs_srgs"} | {"[]"}  # those are in no table
SHOWN = {"3dgs_lr", "srgs", "dropgaussian_srgs", "s2gaussian", "[]"}
PAPER = {  # scenes, seeds, and the values of what is swept beside these
    "table1": (8, 3, {"+strategy": {"clear"}, "+method": METHODS}),
    "table2": (8, 3, {"+strategy": {"clear"}, "+method": METHODS}),
    "table3": (7, 3, {"+strategy": {"clear"}, "+method": METHODS}),
    "table4": (8, 1, {"+strategy": {"clear"}, "+method": {"s2gaussian", "[]"}}),
    "table5": (8, 3, {"+strategy": {*ROWS["table5"]}}),
    "figure1b": (8, 3, {"+strategy": {"baseline", "clear"}, "data.views.train": set("2369")}),
    "figure1c": (4, 3, {"+strategy": {"clear"}, "+method": SHOWN}),
    "figure3": (8, 1, {"+strategy": {"clear"}, "+method": SHOWN}),
    "figure5": (8, 1, {"+strategy": {*ROWS["table5"]}}),
    "claims": (3, 2, {"+strategy": {"clear"}, "+claim": set(options("claim"))}),
}


@pytest.mark.parametrize(("experiment", "readings"), [("table5", "measured"), *((name, "paper") for name in PAPER)])
def test_every_table_and_figure_of_the_paper_is_a_command(experiment, readings):
    """Each row composes into settings, with the readings of what takes part; of rows that several tables share, once."""
    scenes, seeds, rows = PAPER[experiment]
    found, composed_job = jobs(f"experiment={experiment}", f"readings={readings}", "data.root=here")
    assert {key: {job[key] for job in found} for key in rows} == rows
    assert len(found) == scenes * seeds * math.prod(map(len, rows.values()))
    scene = "+scene" if "+scene" in found[0] else "data.scene"
    first = [job for job in found if (job[scene], job["fit.seed"]) == (found[0][scene], "0")]
    whole = readings == "paper" and experiment in ("table1", "table5", "figure1b", "claims")
    for job in first if whole else first[-1:]:
        c = composed_job(job)
        settings = settings_of(tree(OmegaConf.masked_copy(c, [key for key in c if key != "hydra"])))
        assert settings.skips == Skips()  # every iteration, every pixel
        assert f"readings={readings}" in c.hydra.sweep.subdir
        if (p2g := settings.strategies.get("p2g")) is not None:
            assert p2g.score_by == ("evidence" if readings == "paper" else "sum")


def test_the_rows_of_a_table_run_on_the_small_scenes_as_well():
    found, composed_job = jobs("experiment=table5", "protocol=scenes", "data.root=here", "readings=paper")
    assert {job["+scene"] for job in found} == {"fern", "horns", "lego", "real_room"}
    assert len(found) == 4 * 3 * 4
    c = composed_job(found[0])
    assert (c.data.path, c.fit.iterations, c.optim.geometry_steps, c.skips.hr_every) == ("here/fern", 1500, 0, 1)


def test_every_experiment_has_a_test():
    assert {*SCENES, *ROWS, *EVIDENCE, *PAPER, "smoke"} == set(options("experiment"))


HORNS = ("experiment=llff_x4", "data.root=here", "data.scene=horns")


def test_the_command_line_takes_the_place_of_what_an_experiment_sweeps_and_each_job_has_its_folder():
    (one,), composed_job = jobs(*HORNS, "fit.seed=7", "+strategy=[gco,p2g]")
    c = composed_job(one)
    assert (c.data.scene, c.fit.seed, list(c.strategies)) == ("horns", 7, ["gco", "p2g"])
    found, composed_job = jobs(*HORNS, "fit.seed=0", "+method=srgs,dropgaussian")
    for job, (method, strategies) in zip(found, (("srgs", []), ("dropgaussian", ["svs"])), strict=True):
        c = composed_job(job)
        assert (c.method, list(c.strategies)) == (method, strategies)
        assert c.hydra.sweep.subdir == f"+method={method},data.scene=horns,fit.seed=0"
    asked = ["experiment=leave_one_out", "~protocol", "fit.seed=0", "data=llff", "data.path=../../scenes/fern"]
    asked += [f"objective.lambda_hr.{name}=1.0" for name in ("peak", "final")]
    fields = ("start", "stop", "every", "statistics_from", "reset_every", "max_gaussians")
    found, composed_job = jobs(*asked, *(f"density.{name}=100" for name in fields))
    names = [composed_job(job).hydra.sweep.subdir for job in found]
    assert len(set(names)) == len(ROWS["leave_one_out"])
    for job, name in zip(found, names, strict=True):
        assert name.startswith(f"+strategy={job['+strategy']},data.path=.._.._scenes_fern,")
        assert len(name.encode()) <= 255


@pytest.mark.parametrize("rows", ["+strategy=clear", "+method=srgs"])
def test_a_setting_that_changes_no_result_changes_no_folders_name(rows):
    (one,), composed_job = jobs(*HORNS, "fit.seed=0", rows, *(f"{key}=1" for key in sorted(CHANGES_NO_RESULT)))
    assert composed_job(one).hydra.sweep.subdir == f"{rows},data.scene=horns,fit.seed=0"


@pytest.mark.slow
def test_one_command_runs_all_its_report_tells_the_rows_apart_and_a_rerun_trains_nothing(tmp_path: Path):
    tiny = ["experiment=table5", "readings=paper", "~protocol", "fit.seed=0", *TINY, "fit.iterations=3"]
    said = list[str]()
    for more in (["+strategy=baseline,clear"], ["+method=srgs"], ["+method=srgs", "-v", "fit.video=2"]):
        result = run(*tiny, *more, cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        said.append(result.stdout)
    jobs = [line.split(" done in ")[0] for line in said[0].splitlines() if " done in " in line]
    assert (jobs, "initial points" in said[0]) == (["job 0:", "job 1:"], False)  # a line each
    assert "nothing is trained" in result.stdout + result.stderr  # though more is said and shown
    (log,) = tmp_path.glob("multirun/table5/+method=srgs*/run.log")
    assert "strategies named before it take no part" in log.read_text()
    done = sorted(p.parent.name.split(",")[0] for p in tmp_path.glob("multirun/table5/*/metrics.json"))
    assert done == ["+method=srgs", "+strategy=baseline", "+strategy=clear"]
    swept = tmp_path / "multirun" / "table5"  # a sweep ends with its report
    table = (swept / "report.md").read_text()
    assert all(f"| {row} " in table for row in ("baseline", "clear", "srgs")), table
    assert (swept / "report.html").is_file()
