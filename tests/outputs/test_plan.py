"""What a run says of itself: the plan, the progress bar, the provenance."""

import json
import subprocess
from dataclasses import replace
from importlib import metadata
from typing import Any

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Grads, Objective, Strategy
from clear_strategies.outputs import plan
from clear_strategies.outputs.plan import progress_bar
from clear_strategies.outputs.provenance import provenance
from clear_strategies.schedules import WarmupDecay
from clear_strategies.training.loop import iterate
from clear_strategies.training.state import TrainState
from tests.helpers import toy

# ---- the plan names what a run does and skips
SCENE = toy.scene()


def started(*strategies: Strategy, **objective: Any) -> TrainState:
    return toy.started(*strategies, objective=Objective(kernels="torch", **objective))


def lines(state: TrainState, *names: str, method: str | None = None) -> dict[str, str]:
    chosen = plan.Chosen(method, names)
    found = [plan.describe_choices(chosen, state.conductor, "toy", 6, 0)]
    found += plan.describe(SCENE, state, chosen, {"rasterizer": "torch", "threads": "1"})
    split = (line.strip().partition("  ") for text in found for line in text.splitlines())
    return {label: words for label, _, words in split}


def test_the_plan_names_strategies_and_milestones_and_a_run_as_the_command_line_does() -> None:
    found = lines(started(GCO(), SVS(anchor_start=7)), "gco", "svs")
    assert found["strategies"].strip() == "gco (GCO), svs (SVS)"
    assert "SVS anchor_start 7" in found["milestones"]
    assert "(the paper's baseline)" in lines(started())["strategies"]
    assert "(the paper's baseline)" not in lines(started(), method="srgs")["strategies"]
    chosen = (["+strategy=best", "fit.seed=3"], ["+strategy=[gco,svs]"], ["+method=srgs", "+strategy=baseline"], None)
    titles = [plan.Chosen(None, ["gco", "p2g"], words).title for words in chosen]
    assert titles == ["best", "gco + svs", "srgs", "gco + p2g"]


class Quiet(Strategy):
    """Says when it has no effect."""

    def correct(self, lr: Grads, hr: Grads, evidence: object) -> Grads:
        return hr

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        return f"lambda_HR is at most {lambda_hr:g}" if lambda_hr < 2 else None


def test_a_strategy_without_effect_is_warned_of(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = started(Quiet(), lambda_hr=WarmupDecay(start=0, full=1))
    lines(state, "quiet")
    assert "Quiet has no effect: lambda_HR is at most 1." in caplog.text
    caplog.clear()
    lines(started(Quiet(), lambda_hr=WarmupDecay(peak=2, final=0, start=0, full=1)), "quiet")
    assert "no effect" not in caplog.text
    for idle in (WarmupDecay(start=state.settings.iterations), WarmupDecay(peak=0, final=0)):
        caplog.clear()
        found = lines(started(GCO(), P2G(), lambda_hr=idle), "gco", "p2g")
        for name in ("GCO", "P2G"):
            assert f"{name} has no effect: lambda_HR is 0 throughout." in caplog.text
    assert "HR from" not in found["milestones"]
    assert "HR scale until iteration 500 (lambda_HR = 0)" in found["skipped"]  # P2G's score needs it then
    assert "HR scale throughout (lambda_HR = 0)" in lines(started(GCO(), lambda_hr=idle), "gco")["skipped"]
    monkeypatch.setattr(type(state.density), "collects", lambda self, t: False)  # as MCMC, which reads no score
    assert "HR scale throughout (lambda_HR = 0)" in lines(started(P2G(), lambda_hr=idle), "p2g")["skipped"]


def test_the_progress_bar_counts_iterations(capsys: pytest.CaptureFixture[str]) -> None:
    state, steps = started(), []
    with progress_bar(state, lambda t: steps.append(t + 1)) as update:
        for _ in range(10):
            iterate(state, toy.RASTERIZER)
            update(state)
    assert steps == list(range(2, 12))
    lines = capsys.readouterr().err.splitlines()
    assert [line.split("|")[2].split()[0] for line in lines] == [f"{i}/10" for i in range(1, 11)]


def test_of_progress_that_goes_to_a_file_a_twentieth_is_a_line_and_jumps_are_followed(capsys):
    state = started()
    state.settings = replace(state.settings, iterations=200)
    state.history.append({"t": 1.0, "lambda_hr": 0.0, "loss_lr": 0.5, "n_gaussians": 9.0})
    with progress_bar(state, name="best") as update:
        for t in (*range(2, 52), *range(101, 202)):
            state.t = t
            update(state)
    lines = capsys.readouterr().err.splitlines()
    assert [int(line.split("%")[0].removeprefix("best:")) for line in lines] == [5, 10, 15, 20, 25, *range(50, 101, 5)]


# ---- provenance holds what can be found out, and never fails
def test_provenance_holds_versions_of_what_is_installed_machine_and_the_facts_of_the_run(monkeypatch):
    found = provenance(seed=3, backend="torch")
    assert torch.__version__.startswith(found["versions"]["torch"])  # which leaves out +cu130 in PyPI's wheel
    assert (found["seed"], found["backend"]) == (3, "torch")
    assert found["date"].endswith("+00:00")
    assert json.loads(json.dumps(found)) == found

    def absent(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", absent)
    assert provenance()["versions"] == {"clear-strategies": "source checkout"}


@pytest.mark.parametrize("failure", [FileNotFoundError("git"), subprocess.TimeoutExpired("git", 10)])
def test_without_git_the_commit_is_unknown(monkeypatch: pytest.MonkeyPatch, failure: Exception) -> None:
    def fails(*arguments: object, **options: object) -> None:
        raise failure

    monkeypatch.setattr(subprocess, "run", fails)
    assert provenance()["git"] in {"unknown", "no checkout"}
