"""A conductor from the names on the command line."""

from __future__ import annotations

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra

from clear_strategies.compose import CONF, conductor
from clear_strategies.errors import DataError, StrategyConflict


def names(c):
    return [type(s).__name__ for s in c.strategies]


def test_names_are_those_of_the_command_line():
    assert names(conductor("clear")) == ["GCO", "P2G", "SVS"]
    assert names(conductor("gco, svs")) == ["GCO", "SVS"]
    assert names(conductor("baseline")) == []
    assert names(conductor("clear", "~strategies.p2g")) == ["GCO", "SVS"]


def test_overrides_reach_strategies_and_objective():
    c = conductor("gco", "strategies.gco.tolerance=0.2", "objective=lr_only")
    assert c.strategies[0].tolerance == 0.2
    assert c.objective.lambda_hr(5_000) == 0


def test_milestones_stretch_to_the_hosts_length():
    c = conductor("clear", iterations=30_000)
    assert c.strategies[2].anchor_start == 15_000
    assert (c.objective.lambda_hr.start, c.objective.lambda_hr.full) == (1_500, 9_000)


@pytest.mark.parametrize(
    ("said", "named"),
    [
        (("nope",), "strategy/nope"),
        (("gco", "strategies.gco.tau=1"), "strategies.gco.tau"),
        (("gco", "strategies.gco.tolerance=2"), "tolerance must lie in"),
    ],
)
def test_what_does_not_exist_is_named(said, named):
    with pytest.raises(DataError, match=named):
        conductor(*said)


def test_two_that_answer_one_question_are_refused():
    with pytest.raises(StrategyConflict):
        conductor("gco,splatsure")


def test_a_hydra_application_keeps_its_own_state():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        mine = GlobalHydra.instance().hydra
        conductor("gco")
        assert GlobalHydra.instance().hydra is mine
        assert compose("config").fit.seed == 0
    assert not GlobalHydra.instance().is_initialized()


def test_a_host_of_no_iterations_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        conductor("gco", iterations=0)
