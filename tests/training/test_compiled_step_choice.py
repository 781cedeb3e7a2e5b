"""Which runs get the compiled per-Gaussian step, and that a run which does not says why."""

from __future__ import annotations

from dataclasses import dataclass

from clear_strategies import GCO, P2G, SVS, Conductor
from clear_strategies.strategies.base import describes
from clear_strategies.training.compiled_step import compiled_step_for
from clear_strategies.training.optim import Adam, LearningRates
from rasterizers.interface import BackendUnavailable
from tests.helpers.compiled_step_cases import case


@dataclass(frozen=True)
class Tuned(GCO):
    """Other defaults, the same arithmetic."""

    tolerance: float = 0.2


@dataclass(frozen=True)
class Bolder(GCO):
    def correct(self, lr, hr, step=None):
        return super().correct(lr, hr, step) * 2.0


class Doubling:
    def correct(self, lr, hr, step=None):
        return hr * 2.0


@dataclass(frozen=True)
class Mixed(Doubling, GCO):
    pass


@dataclass(frozen=True)
class Known(GCO):
    """States anew that its correction is that of the rule."""

    def correct(self, lr, hr, step=None):
        return super().correct(lr, hr, step)

    def correction_rule(self):
        return super().correction_rule()


def test_a_class_that_changes_what_a_strategy_does_loses_its_kernel():
    assert all(describes(c(), "correction_rule") for c in (GCO, Tuned, Known))
    assert not any(describes(c(), "correction_rule") for c in (Bolder, Mixed, P2G))
    assert describes(SVS(), "anchor")


class OwnAdam(Adam):
    pass


def test_the_readable_path_is_taken_where_it_must_be_and_that_is_said_once(caplog, monkeypatch):
    field = case(4).fields[0]
    adam = Adam(field.raw(), LearningRates(), 1.0)
    double = Adam(field.double().raw(), LearningRates(), 1.0)
    cases = [
        ((Conductor(GCO(), P2G()), adam, "off"), "fit.fused=off"),
        ((Conductor(Bolder()), adam), "Bolder does not state its arithmetic as data"),
        ((Conductor(), OwnAdam(field.raw(), LearningRates(), 1.0)), "OwnAdam may compute something else than Adam"),
        ((Conductor(), double), "means is torch.float64 on cpu, not float32"),
    ]
    for arguments, reason in cases:
        caplog.clear()
        with caplog.at_level("DEBUG"):
            assert compiled_step_for(*arguments) is None
        assert [reason in message for message in caplog.messages] == [True]

    def missing(_):
        raise BackendUnavailable("the compiled kernels are not installed.")

    monkeypatch.setattr("clear_strategies.training.compiled_step.load_kernels", missing)
    caplog.clear()
    with caplog.at_level("DEBUG"):
        assert compiled_step_for(Conductor(), adam) is None
    path = "The per-Gaussian step takes the readable path, which is several times slower: "
    assert caplog.messages == [path + "the compiled kernels are not installed."]
