"""Under which loss weights and settings a strategy changes nothing, and says why."""

import pytest

from clear_strategies import GCO, MCMC, P2G, SVS, FadingOpacity, PseudoViews, RandomBackground, SplatSuRe, SRStage
from clear_strategies.schedules import Ramp
from clear_strategies.strategies.base import Strategy

ALL = {"lambda_lr": 1.0, "lambda_hr": 1.0, "lambda_hf": 0.2}
NO_DROPOUT, NOTHING = Ramp(maximum=0.0), "it drops nothing and anchors nothing"


def overriding(*hooks):
    """A strategy of one's own that says nothing of its effect."""
    return type("Mine", (Strategy,), {hook: lambda self, *_: None for hook in hooks})()


@pytest.mark.parametrize(
    ("strategy", "zero", "reason"),
    [
        (GCO(), "lambda_lr", "lambda_LR is 0"), (GCO(), "lambda_hr", "lambda_HR is 0"), (GCO(), "lambda_hf", None),
        (P2G(), "lambda_hr", "lambda_HR is 0"), (P2G(), "lambda_hf", "lambda_HF is 0"), (P2G(), "lambda_lr", None),
        (PseudoViews(), "lambda_lr", "lambda_lr is 0"), (PseudoViews(), "lambda_hr", None),
        (SRStage(), "lambda_lr", "lambda_lr is 0"), (SRStage(), "lambda_hr", None),
        (SplatSuRe(), "lambda_hr", "lambda_HR is 0"), (SplatSuRe(), "lambda_lr", None),
        (FadingOpacity(rate=0.0), None, "its rate is 0"), (SVS(dropout=NO_DROPOUT), None, NOTHING),
        (SVS(dropout=NO_DROPOUT, anchor_strength=0.1, anchor_weights={"means": 0.0}), None, NOTHING),
        (SVS(dropout=NO_DROPOUT, anchor_strength=0.1), None, None),
        (overriding("correct"), "lambda_hr", "lambda_HR is 0"), (overriding("reconcile", "after_step"), "lambda_hr", None),
        (overriding("observe"), "lambda_hr", None),  # another strategy may score by it
        (overriding("route"), "lambda_hf", "lambda_HF is 0"), (overriding("route", "score"), "lambda_hf", None),
        (overriding("extra_views"), "lambda_lr", "lambda_lr is 0"), (overriding(), "lambda_hr", None),
        *((make(), None, None) for make in (GCO, P2G, SVS, FadingOpacity, PseudoViews, SplatSuRe, SRStage)),
        *((make(), name, None) for make in (SVS, MCMC, RandomBackground) for name in ALL),
    ],
)  # fmt: skip
def test_a_strategy_without_effect_says_why(strategy, zero, reason):
    found = strategy.without_effect(**{name: 0.0 if name == zero else value for name, value in ALL.items()})
    assert found is None if reason is None else reason in found
