"""`fit.minutes`: as many iterations as fit, SR images that fit, and a run that is late leaves iterations out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from clear_strategies.data.capture import Frame
from clear_strategies.data.priors import BackProjected, Bicubic, SelfEnsembled
from clear_strategies.errors import SettingError
from clear_strategies.jobs import budget as budgets
from clear_strategies.jobs.budget import Budget, Plan
from clear_strategies.jobs.settings import RunSettings
from clear_strategies.outputs import metrics
from clear_strategies.training.field import GaussianField
from clear_strategies.training.loop import fit
from clear_strategies.training.skips import SkipPolicy, Skips
from tests.helpers import command_line, planes
from tests.helpers.short_run import ITERATIONS, SCENE, start
from tests.helpers.toy import RASTERIZER


class Clock:
    """Takes the place of `time`; moves when it is told to."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now

    def takes(self, seconds: float) -> Callable[..., None]:
        """What takes so long."""

        def work(*_: object) -> None:
            self.now += seconds

        return work


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(budgets, "time", clock)
    monkeypatch.setattr(budgets, "iterate", clock.takes(0.1))
    monkeypatch.setattr(GaussianField, "render", clock.takes(0.01))
    return clock


def planned(seconds: float, *, iterations: int = 5_000, trainings: int = 1, frames: int = 0) -> Plan:
    budget, state = Budget(seconds, budgets.time.perf_counter()), start(("gco",), iterations)
    return budget.iterations(state, RASTERIZER, trainings=trainings, maps=0, frames=frames)


def test_the_iterations_fit_into_the_time_that_files_leave() -> None:
    plan = planned(20.0)
    assert plan.iterations == pytest.approx((20 - plan.files) / plan.each, rel=0.1)
    assert planned(20.0, trainings=2).iterations < 0.8 * plan.iterations
    assert planned(20.0, frames=2_000).files > 2 * plan.files


def test_there_are_no_more_than_asked_for_and_never_too_few_to_look_at() -> None:
    assert planned(1e6, iterations=30).iterations == 30
    short = planned(1.0)
    assert short.iterations == budgets._LEAST
    assert "longer than asked for" in short.description()
    assert "longer" not in planned(20.0).description()


def test_sr_images_get_no_larger_than_a_fifth_of_the_time_allows(clock: Clock) -> None:
    def slow(name: str, lr: torch.Tensor, factor: int) -> torch.Tensor:
        assert factor == 4  # the network knows no other
        clock.now += 0.05 * len(lr) / 96 if loaded else 5.0
        loaded.append(True)
        return lr.repeat_interleave(factor, 0).repeat_interleave(factor, 1)

    loaded: list[bool] = []
    slow.label, slow.files = "slow", ()  # as every network has
    frame = Frame("a", planes.camera(0, 120, 100), lambda: torch.rand(100, 120, 3))
    each = 0.05 / (384 * 384)
    found = Budget(100.0, clock.now).megapixels([frame] * 8, slow, 4)
    assert found == pytest.approx(0.2 * 100 / 8 / each / 1e6, rel=0.1)
    eight_times = BackProjected(SelfEnsembled(slow))
    assert Budget(100.0, clock.now).megapixels([frame] * 8, eight_times, 4) == pytest.approx(found / 8, rel=0.1)
    assert Budget(1e-3, clock.now).megapixels([frame] * 8, slow, 4) == budgets._LEAST_MEGAPIXELS
    assert Budget(100.0, clock.now).megapixels([frame] * 8, Bicubic(), 4) is None


@pytest.mark.parametrize(("seconds", "after"), [(1e6, 13), (0.0, 17)])
def test_a_run_that_is_late_goes_on_where_the_rates_fall(seconds: float, after: int, clock: Clock) -> None:
    state = start(("gco",))
    state.skip_policy = SkipPolicy(Skips(plateau_from=10, plateau_to=16))
    check = Plan(20, 0.1, 0.0, Budget(seconds, clock.now)).hurry(state)
    state.t, clock.now = 9, 0.1
    check()
    assert state.t == 9  # before there is anything to leave out
    state.t, clock.now, steps = 13, 0.2, state.optimizer.steps
    check()
    assert state.t == after
    assert state.optimizer.steps - steps == after - 13


def test_a_late_run_whose_rates_fall_after_its_end_makes_its_last_iteration_and_no_more() -> None:
    state = start(())
    state.skip_policy = SkipPolicy(Skips(plateau_from=8, plateau_to=50))
    check = Plan(ITERATIONS, 0.1, 0.0, Budget(-1.0, 0.0)).hurry(state)
    fit(state, SCENE, RASTERIZER, progress=lambda _: check())
    assert [int(row["t"]) for row in state.history] == [*range(1, 8), ITERATIONS]


def test_a_run_of_some_seconds_logs_what_was_chosen_and_keeps_the_number(tmp_path: Path) -> None:
    settings = [*command_line.TINY, "fit.iterations=40", "fit.minutes=0.001", "+strategy=gco", "hydra.run.dir=run"]
    ended = command_line.run("data=demo", *settings, cwd=tmp_path)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "0.001 minutes: " in ended.stdout
    saved = metrics.read(tmp_path / "run" / "metrics.json", "")
    assert (saved.iterations, saved.config["fit.iterations"], saved.config["fit.minutes"]) == (40, 40, None)
    with pytest.raises(SettingError, match="exclude each other"):
        RunSettings(minutes=1.0, resume="auto")
