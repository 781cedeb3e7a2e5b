"""From conf/ to objects: names on the command line, the defaults' one owner, and what is refused."""

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from clear_strategies import GCO, P2G, SVS, Conductor
from clear_strategies.compose import CONF, conductor, tree
from clear_strategies.data.priors import BackProjected, Bicubic
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.errors import SettingError
from clear_strategies.jobs import device
from clear_strategies.jobs.settings import settings_of
from clear_strategies.merging.detail import DetailRates
from clear_strategies.training.settings import FitSettings
from tests.helpers.configs import composed, options


def names(c):
    return [type(s).__name__ for s in c.strategies]


def test_names_and_overrides_are_those_of_the_command_line_and_milestones_stretch_to_the_hosts_length():
    assert names(conductor("clear")) == ["GCO", "P2G", "SVS"]
    for said in ("gco, svs", "[gco,svs]", ["gco", "svs"]):
        assert names(conductor(said)) == ["GCO", "SVS"]
    assert names(conductor("baseline")) == []
    assert names(conductor("clear", "~strategies.p2g")) == ["GCO", "SVS"]
    c = conductor("gco", "strategies.gco.tolerance=0.2", "objective=lr_only")
    assert c.strategies[0].tolerance == 0.2
    assert c.objective.lambda_hr(5_000) == 0
    c = conductor("clear", iterations=30_000)
    assert c.strategies[2].anchor_start == 15_000
    assert (c.objective.lambda_hr.start, c.objective.lambda_hr.full) == (1_500, 9_000)
    with pytest.raises(ValueError, match="at least 1"):
        conductor("gco", iterations=0)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        (("nope",), "strategy=nope: there is no such option"),
        (("gco", "strategies.gco.tau=1"), "strategies.gco.tau: there is no such setting"),
        (("best", "strategies.gco.tolerence=1"), r"tolerence: there .* Did you mean strategies\.gco\.tolerance\?"),
        (("gco", "strategies.gco.tolerance=2"), "tolerance: must lie in"),
        (("gco,gco",), "gco twice"),
        (("gco,clear",), "gco twice"),
        (("gco,best",), "gco twice"),
        (("best,svs",), "svs twice"),
        (("gco", "fit.iterations=3"), r"fit\.iterations: .* A conductor has settings of .*objective"),
        (("gco", "+readings=literal"), r"strategies.p2g: has settings .*\+strategy=p2g"),
    ],
)
def test_what_does_not_exist_is_named(said, named):
    with pytest.raises(SettingError, match=named):
        conductor(*said)


def test_a_hydra_application_keeps_its_own_state():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        mine = GlobalHydra.instance().hydra
        conductor("gco")
        assert GlobalHydra.instance().hydra is mine
        assert compose("config").fit.seed == 0
    assert not GlobalHydra.instance().is_initialized()


def test_clear_on_the_command_line_is_clear_in_python():
    """The defaults have one owner, the class: strategies, objective and all numbers are the same, field by field."""
    ours = Conductor(GCO(), P2G(), SVS())
    run = settings_of(tree(composed("+strategy=clear")))
    for theirs in (conductor("clear"), run.conductor(1.0)):
        assert theirs.strategies == ours.strategies
        assert theirs.objective == ours.objective
        assert theirs.statistics_from == ours.statistics_from
    kinds = {"optim": run.optim, "mip": run.mip, "cloud": run.data.cloud}
    assert kinds == {k: type(v)() for k, v in kinds.items()}
    assert run.data.views == ViewSettings(photos_are="hr")  # the demo's
    assert run.fit == FitSettings(iterations=850)  # the demo's


def test_the_two_sets_of_readings_differ_where_they_say():
    measured, literal = (settings_of(tree(composed(f"+strategy={name}"))) for name in ("clear", "clear_paper"))
    assert (measured.strategies["p2g"].score_by, literal.strategies["p2g"].score_by) == ("sum", "evidence")
    assert (measured.objective.lambda_hr.final, literal.objective.lambda_hr.final) == (1.0, 0.1)
    assert (measured.optim.detail_decay, literal.optim.detail_decay) == (0.002, 0.0)
    assert (measured.optim.geometry_steps, literal.optim.geometry_steps) == (30_000, 0)
    assert (measured.strategies["svs"].anchor_strength, literal.strategies["svs"].anchor_strength) == (0.0, 0.01)
    assert literal.strategies["svs"].anchor_weights["means"] == 1.0
    assert literal.strategies["svs"].anchor_weights["detail"] == 0.0
    assert literal.skips == type(literal.skips)(plateau_window=250)  # nothing is left out


@pytest.mark.parametrize(
    ("chosen", "steps"),
    [
        ((), 30_000), (("+strategy=best", "+scene=fern"), 30_000), (("optim=3dgs",), 0), (("+method=srgs",), 0),
        (("+method=dropgaussian_srgs", "optim=by_length"), 30_000), (("+protocol=llff_x4",), 0),
        (("+protocol=llff_x4", "+strategy=best", "optim=by_length"), 30_000), (("experiment=llff_x4",), 0),
        (("experiment=evidence",), 0),
    ],
    ids=str,
)  # fmt: skip
def test_what_was_published_keeps_its_rates(chosen, steps):
    assert composed(*chosen).optim.geometry_steps == steps


GROUPS = ("strategy", "rasterizer", "data", "prior", "objective", "density", "optim", "skips", "method")
NEEDED = {
    **{f"data={name}": "data.path=here" for name in ("blender", "colmap", "llff", "nerfstudio", "photos")},
    **{f"prior={name}": "prior.path=here" for name in ("images", "onnx")},
    "prior=corrupted": "prior.prior.path=here",
}


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_composes_into_settings(group):
    for name in options(group):
        chosen = f"{'+' * (group in ('strategy', 'method'))}{group}={name}"
        config = composed(chosen, *([NEEDED[chosen]] if chosen in NEEDED else []))
        assert isinstance(settings_of(tree(config)).conductor(1.0), Conductor), name


REFUSED = {
    "+fit.iteration=1": "Did you mean fit.iterations?",
    "+typo=1": "typo: clear_strategies.jobs.settings.JobSettings has no such setting",
    "objective.lambda_hr._target_=clear_strategies.schedules.Ramp": "clear_strategies.schedules.Ramp has no such setting",
    "rasterizer=torch rasterizer.memory=9": "unknown rasterizer setting 'memory'",
    "+strategy=gco +data.path=here": "data.path is of no use",
    "data=llff": "data.path: is needed and missing",
    "+scene=fern": "data.root: is needed and missing",
}


@pytest.mark.parametrize(("overrides", "message"), REFUSED.items(), ids=list(REFUSED))
def test_a_setting_that_cannot_be_used_is_named_by_its_key(overrides, message):
    with pytest.raises(SettingError) as refused:  # noqa: PT012
        settings = settings_of(tree(composed(*overrides.split())))
        device.drawing(settings.rasterizer, settings.fit.device)
    assert message in str(refused.value)


def test_a_host_gets_the_strategies_the_decorators_and_the_rates_of_what_it_names():
    run = settings_of(tree(composed("+strategy=best")))
    best = conductor("best")
    assert [type(s) for s in best.strategies] == [type(s) for s in run.conductor(1.0).strategies]
    assert [type(s).__name__ for s in best.strategies] == [
        "GCO", "P2G", "SVS", "PseudoViews", "FadingOpacity", "MCMC", "RandomBackground",
    ]  # fmt: skip
    assert best.prior(Bicubic()) == run.conductor(1.0).prior(Bicubic()) == BackProjected(Bicubic())
    run = settings_of(tree(composed("+strategy=[p2g,back_projected]", "data.views.downsample=area")))
    assert run.strategies["p2g"].down == "area"
    assert run.conductor(1.0).prior(Bicubic()) == BackProjected(Bicubic(), down="area")
    assert conductor("clear", iterations=300).detail == DetailRates().of_run(300)
    assert conductor("clear_paper", iterations=300).detail == DetailRates(steps=0, decay=0.0)
