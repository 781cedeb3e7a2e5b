"""From conf/ to objects: names on the command line, the defaults' one owner, and what is refused."""

import os
import re
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import ConfigCompositionException

from clear_strategies import GCO, P2G, SVS, Conductor, FadingOpacity, RandomBackground, hydra_app, hydra_errors
from clear_strategies import compose as compose_module
from clear_strategies.compose import conductor, tree
from clear_strategies.data.priors import BackProjected, Bicubic
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.density.mcmc import MCMC
from clear_strategies.errors import SettingError
from clear_strategies.hydra_errors import not_composed
from clear_strategies.jobs.settings import settings_of
from clear_strategies.merging.detail import DetailRates
from clear_strategies.options import CONF, _ConfSource
from clear_strategies.schedules import Ramp
from clear_strategies.training.settings import FitSettings
from rasterizers.geometry import SH_C0
from tests.helpers import command_line
from tests.helpers.configs import composed, options

MINE = "tests.merging.test_conductor.Halve"


def names(c):
    return [type(s).__name__ for s in c.strategies]


def test_names_and_overrides_are_those_of_the_command_line_and_milestones_stretch_to_the_hosts_length():
    assert names(conductor("clear")) == ["GCO", "P2G", "SVS"]
    for said in ("gco, svs", "[gco,svs]", ["gco", "svs"]):
        assert names(conductor(said)) == ["GCO", "SVS"]
    assert names(conductor("baseline")) == []
    assert names(conductor("clear", "~strategies.p2g")) == ["GCO", "SVS"]
    assert conductor("clear", "~readings").strategies == conductor("clear").strategies
    c = conductor("gco", "strategies.gco.tolerance=0.2", "objective=lr_only")
    assert c.strategies[0].tolerance == 0.2
    assert c.objective.lambda_hr(5_000) == 0
    own = SVS(dropout=Ramp(0.3))
    c = conductor("clear", "~strategies.svs", own, iterations=30_000)
    assert (names(c), c.strategies[-1] is own) == (["GCO", "P2G", "SVS"], True)
    c = conductor("clear", iterations=30_000)
    assert c.strategies[2].anchor_start == 15_000
    assert (c.objective.lambda_hr.start, c.objective.lambda_hr.full) == (1_500, 9_000)
    with pytest.raises(ValueError, match="at least 1"):
        conductor("gco", iterations=0)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        (("nope",), "strategy=nope: there is no such option"),
        (("srgs",), r"strategy=srgs: there is no such option\. There are "),  # +method=srgs is for runs alone
        (
            ("baseline", f"+strategies.x._target_={MINE}", "strategies.x.share=1"),
            r"strategies.x.share: there is no such setting. Its class has it; a plus adds it: \+strategies.x.share=",
        ),
        (("gco", f"strategies.x._target_={MINE}"), r"A plus adds it: \+strategies\.x\._target_="),
        (("best", "strategies.gco.tolerence=1"), r"tolerence: there .* Did you mean strategies\.gco\.tolerance\?"),
        (("gco,gco",), "gco twice"),
        ((["gco", "[svs]"],), r"must be a name or a list of names, got \+strategy=\[gco,\[svs\]\]. Write "),
        (("best,svs",), "svs twice"),
        (("gco", "fit.iterations=3"), r"fit\.iterations: .* A conductor has settings of .*objective"),
        (("gco", "+strategies.p2g.floor=0"), r"strategies.p2g: has settings .*\+strategy=p2g"),
        (("gco", r"C:\my photos"), r"^C:\\my photos: is no setting\. A setting is written name=value"),
        (("gco", "~strategies.[gco]"), r"^~strategies\.\[gco\]: is no setting\."),
        (("gco", 'strategies.gco.drop="x'), r'^strategies\.gco\.drop: its value "x cannot be read\. Quotation marks'),
        (("gco", "=3"), r"^=3: names no setting\. A setting is written name=value"),
        (("gco", "+readings=paper"), r"\+readings=paper: .*: readings=paper\."),
    ],
)  # fmt: skip
def test_what_does_not_exist_is_named(said, named):
    with pytest.raises(SettingError, match=named):
        conductor(*said)


def test_a_list_of_settings_is_refused_with_the_remedy(tmp_path):
    """In a process without pytest's checks of annotations."""
    code = (
        "import clear_strategies\nfrom clear_strategies.compose import conductor\n"
        "for call in (conductor, clear_strategies.train):\n"
        "    try:\n        call('gco', ['a=b'])\n"
        "    except clear_strategies.ClearError as error:\n        print(error)\n"
    )
    told = command_line.run(cwd=tmp_path, code=code).stdout
    rule = "overrides: must be given one by one, each as text, got ['a=b']."
    assert [line.startswith(rule) and "*overrides" in line for line in told.splitlines()] == [True, True]


def test_a_setting_of_a_class_that_a_sweep_leaves_in_place_is_added_by_a_plus():
    words = ["experiment=llff_x4", f"+strategies.x._target_={MINE}", "strategies.x.share=1"]
    of_a_prior = ["prior._target_=clear_strategies.data.priors.Onnx", "prior.path=a.onnx"]  # options have a path, too
    for given, key in ((words, "strategies.x.share"), (of_a_prior, "prior.path")):
        with pytest.raises(SettingError, match=rf"a plus adds it: \+{re.escape(key)}="):
            compose_module.composed(given, "config")
    for key in ("strategies.x.share", "data.reader.share"):
        unknown = ConfigCompositionException(f"Could not override '{key}'.")
        from_a_folder = ["data=only_in_a_folder_of_config_dir", "+strategy=x", f"{key}=1"]
        assert f"a plus adds it: +{key}=" in str(not_composed(unknown, from_a_folder, "config"))


def test_the_options_that_have_a_setting_are_named_without_composing_each(monkeypatch):
    """A composition takes 0.2 s, and eleven options might have data.root."""
    composed_by_hydra, calls = hydra_errors.composed_by_hydra, []
    monkeypatch.setattr(hydra_errors, "composed_by_hydra", lambda *asked: calls.append(1) or composed_by_hydra(*asked))
    for key, having in {"data.root": "+protocol=blender_x4, ", "prior.path": "prior=images, "}.items():
        error = not_composed(ConfigCompositionException(f"Could not override '{key}'."), [f"{key}=a"], "config")
        assert f"{key}: there is no such setting without one of {having}" in str(error)
    assert len(calls) == 2


def test_readings_stand_beside_any_strategies_and_what_is_set_by_name_wins():
    """The ladder of the paper's table 5: each rung has the readings of what takes part, and nothing of the others."""
    whole = tree(composed("+strategy=clear_paper"))
    assert tree(composed("readings=paper", "+strategy=[gco,p2g,svs]")) == whole
    assert "readings" not in whole
    for rung in (["gco", "p2g"], ["gco"], []):
        values = tree(composed(f"+strategy=[{','.join(rung)}]" if rung else "+strategy=baseline", "readings=paper"))
        assert values["strategies"] == {name: whole["strategies"][name] for name in rung}
        assert {key: values[key] for key in ("objective", "skips", "optim")} == {
            key: whole[key] for key in ("objective", "skips", "optim")
        }
    ours, printed = conductor("clear").strategies, conductor("clear", "readings=paper").strategies
    assert ours != printed == conductor("clear_paper").strategies
    assert (printed[1].score_by, printed[2].anchor_weights["detail"]) == ("evidence", 0)
    assert compose_module.composed(["+strategy=clear_paper"]).skips.coarse_until == 0  # where a host's is skips=hosts
    (svs,) = conductor("svs", "readings=paper", "strategies.svs.anchor_weights.detail=2").strategies
    assert (svs.anchor_weights["detail"], svs.anchor_weights["means"], svs.looks) == (2, 1, 0)


def test_a_hydra_application_keeps_its_own_state():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        mine = GlobalHydra.instance().hydra
        conductor("gco")
        assert GlobalHydra.instance().hydra is mine
        assert compose("config").fit.seed == 0
    assert not GlobalHydra.instance().is_initialized()


@pytest.mark.parametrize(
    ("config", "words", "message"),
    [
        (
            "config",
            ["+strategy=gco", "strategies.gco=null"],
            r"^strategies\.gco: .*, got None\. ~strategies\.gco leaves it out",
        ),
        ("config", ["~rasterizer"], r"^rasterizer: is needed and missing\. Add \+rasterizer="),
        ("conductor", [], "^--config-name: must be a configuration of a run"),
    ],
)
def test_a_configuration_that_lacks_a_part_of_a_run_is_refused(config, words, message):
    with pytest.raises(SettingError, match=message):
        settings_of(tree(compose_module.composed(words, config)))


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


@pytest.mark.parametrize("chosen", [(), ("experiment=conflict_by_views", "data.root=here", "+scene=fern")], ids=str)
def test_printed_rates_are_those_of_3dgs(chosen):
    """3DGS's own: none falls but that of the means, and none is higher in a short run."""
    rates, published = (composed(*chosen, *said).optim for said in (("readings=paper",), ("optim=3dgs",)))
    ours = ("detail", "detail_steps", "detail_decay")  # 3DGS has no f_det
    assert {k: v for k, v in rates.items() if k not in ours} == {k: v for k, v in published.items() if k not in ours}
    assert rates.detail == pytest.approx(
        SH_C0 * rates.sh0, rel=1e-3
    )  # Eq. 3 adds f_det to the feature, not to its colour


GROUPS = ("strategy", "rasterizer", "data", "prior", "objective", "density", "optim", "skips")
NEEDED = {
    **{f"data={name}": "data.path=here" for name in ("blender", "colmap", "llff", "nerfstudio", "photos")},
    **{f"prior={name}": "prior.path=here" for name in ("images", "onnx")},
    "prior=corrupted": "prior.prior.path=here",
}


@pytest.mark.parametrize("group", GROUPS)
def test_every_option_composes_into_settings(group):
    for name in options(group):
        chosen = f"{'+' * (group == 'strategy')}{group}={name}"
        config = composed(chosen, *([NEEDED[chosen]] if chosen in NEEDED else []))
        assert isinstance(settings_of(tree(config)).conductor(1.0), Conductor), name


# A strategy, a method, and what the warning says first; empty where nothing is set aside.
ASIDE = {
    "+strategy=gco +method=srgs": "+strategy=gco has no effect: +method=srgs replaces",
    "+strategy=[gco,svs] +method=dropgaussian": "+strategy=[gco,svs] has no effect: +method=dropgaussian replaces",
    "+method=srgs +strategy=gco": "",
    "+strategy=baseline +method=srgs": "",
    "+strategy=gco +method=[]": "",
}


@pytest.mark.parametrize("overrides", ASIDE)
def test_a_strategy_that_a_method_sets_aside_is_told(overrides, caplog):
    compose_module.composed(overrides.split(), "config")
    said = [record.getMessage() for record in caplog.records]
    assert said == [] if not ASIDE[overrides] else said[0].startswith(ASIDE[overrides])


@pytest.mark.parametrize("behind", ["+strategy=clear", "+method=srgs"])
def test_a_claim_before_the_strategies_that_would_replace_it_is_refused(behind):
    with pytest.raises(SettingError, match=rf"Write \{behind} \+claim=dropped\."):
        compose_module.composed(["+claim=dropped", behind], "config")
    assert compose_module.composed(["+strategy=clear", "+claim=dropped"], "config").strategies.gco.drop


def test_a_tilde_is_the_users_folder_wherever_a_setting_is_a_path(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    paths = {"data.path": "~/photos", "prior.path": "~/sr", "fit.resume": "~/run", "data.save_lr": "~"}
    words = [hydra_app.readable(f"{key}={path}") for key, path in paths.items()]
    values = tree(composed("data=colmap", "prior=images", *words))
    assert values["data"]["reader"]["root"] == values["data"]["path"] == "/home/me/photos"
    assert (values["prior"]["path"], values["fit"]["resume"]) == ("/home/me/sr", "/home/me/run")
    assert values["data"]["save_lr"] == "/home/me"
    listed = [hydra_app.readable(f"+mine={value}") for value in ("[~/photos,~,~/a b/c,d]", "[a, ~]", "['~/x']")]
    lists = [tree(composed(word))["mine"] for word in listed]
    assert lists == [["/home/me/photos", "/home/me", "/home/me/a b/c", "d"], ["a", "/home/me"], ["/home/me/x"]]


def test_a_host_gets_the_strategies_the_decorators_and_the_rates_of_what_it_names():
    run = settings_of(tree(composed("+strategy=best")))
    best = conductor("best")
    assert [type(s).__name__ for s in run.conductor(1.0).strategies] == [
        "GCO", "P2G", "SVS", "PseudoViews", "FadingOpacity", "MCMC", "RandomBackground",
    ]  # fmt: skip
    assert [type(s) for s in best.strategies] == [type(s) for s in run.conductor(1.0).strategies][:-2]
    assert best.prior(Bicubic()) == run.conductor(1.0).prior(Bicubic()) == BackProjected(Bicubic())
    run = settings_of(tree(composed("+strategy=[p2g,back_projected]", "data.views.downsample=area")))
    assert run.strategies["p2g"].down == "area"
    assert run.conductor(1.0).prior(Bicubic()) == BackProjected(Bicubic(), down="area")
    assert conductor("clear", iterations=300).detail == DetailRates().of_run(300)
    assert conductor("clear_paper", iterations=300).detail == DetailRates(rate=7.05e-4, steps=0, decay=0.0)


def test_opacities_fade_to_a_bound_in_hosts_where_nothing_moves_what_has_faded():
    assert [s.most for s in conductor("best", "readings=paper").strategies if isinstance(s, FadingOpacity)] == [1_350]
    assert tree(compose_module.composed(("+strategy=best",), "config"))["strategies"]["fading_opacity"]["most"] == 0


def test_in_a_host_best_leaves_mcmc_and_random_backgrounds_out_and_says_so_once_unless_they_are_named(caplog):
    caplog.set_level("INFO")
    compose_module._say_left_out.cache_clear()
    without = [("best",), ("best",), ("best", "~strategies.random_background")]
    assert not any(isinstance(s, MCMC | RandomBackground) for names in without for s in conductor(*names).strategies)
    for names in ("best", "strategies.random_background.until=8000"), (["gco", "random_background"],):
        assert isinstance(conductor(*names).strategies[-1], RandomBackground)
    assert any(isinstance(s, MCMC) for s in conductor("[clear,mcmc]").strategies)
    assert (caplog.text.count("random_background is left out"), caplog.text.count("mcmc is left out")) == (1, 1)


def test_a_file_of_options_that_is_edited_is_read_again_and_what_is_made_of_it_is_a_copy(tmp_path: Path) -> None:
    source, file = _ConfSource("conf", f"clear://{tmp_path}"), tmp_path / "mine.yaml"
    for second, value in enumerate((1, 2)):
        file.write_text(f"# @package _global_\nfit:\n  seed: {value}\n")
        os.utime(file, (second, second))
        for _ in range(2):
            found = source.load_config("mine")
            assert (found.config.fit.seed, found.header["package"]) == (value, "_global_")
            found.config.fit.seed, found.header["package"] = 5, None
