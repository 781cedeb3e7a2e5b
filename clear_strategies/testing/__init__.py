"""The contract of a strategy, as checks that anyone can run over their own.

    from clear_strategies.testing import check_strategy
    check_strategy(lambda: Mine(strength=2))

Each check raises `ContractError` with what was expected and what was found.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import fields
from multiprocessing.reduction import ForkingPickler
from typing import Any, Final

import torch

from clear_strategies.core import deferred
from clear_strategies.core.gradients import screen_of
from clear_strategies.errors import AnswerError, DivergedError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.logs import computed
from clear_strategies.schedules import scaled
from clear_strategies.strategies.base import Strategy, unused
from clear_strategies.testing import given
from clear_strategies.testing.densifier import check_densifier_takes_everything_along
from clear_strategies.testing.given import Make, StubShot, without_error
from rasterizers.testing import ContractError, require

__all__ = ["CHECKS", "ContractError", "StubShot", "check_strategy"]


def check_strategy(make: Make) -> None:
    """Run every check.

    Args:
        make: builds the strategy, the same one each time.

    Raises:
        ContractError: the first promise that does not hold.
    """
    for check in CHECKS:
        try:
            check(make)
        except (AnswerError, DivergedError) as error:
            raise ContractError(str(error)) from error


def check_is_frozen_settings(make: Make) -> None:
    """A frozen dataclass with a repr that names its settings, and milestones that can be stretched."""
    strategy = make()
    require(isinstance(strategy, Strategy), f"{type(strategy).__name__} is no Strategy")
    name = type(strategy).__name__
    require("__dataclass_fields__" in vars(type(strategy)), f"write @dataclass(frozen=True) above class {name}")
    require(hasattr(strategy, "state"), f"{name} has no state: its __init__ must be that of the dataclass")
    settings = [f.name for f in fields(strategy) if f.init]
    if settings:
        try:
            setattr(strategy, settings[0], getattr(strategy, settings[0]))
        except AttributeError:
            pass
        else:
            raise ContractError("settings can be assigned; declare the dataclass frozen")
    require(all(name in repr(strategy) for name in settings), f"repr does not show every setting: {strategy!r}")
    try:
        equal = bool(strategy == make())
    except Exception as error:
        raise ContractError(f"settings cannot be compared, as tensors cannot ({error}): {strategy!r}") from error
    require(equal, "two strategies with the same settings are not equal")
    require(scaled(strategy, 1.0) == strategy, "stretching milestones by 1 changes the strategy")


def check_what_is_shown_is_left_alone(make: Make) -> None:
    """What a strategy is shown is not changed in place: others read it, and photos are shown again."""
    lr, hr, view, params = given.situation(0)
    evidence = given.evidence()
    shown: dict[str, list[Any]] = {
        "a gradient": [x for shot in (lr, hr) for g in shot.gradients for x in (*g.values(), screen_of(g))],
        "an image": [view.lr.image, view.hr.image, lr.image, hr.image],
        "a rendering's means2d or visible": [x for shot in (lr, hr) for x in (shot.means2d, shot.visible)],
        "a parameter": [*params.values()],
        "the evidence": [evidence.reliability, evidence.demand],
    }
    before = copy.deepcopy(shown)
    # Then g_HR is the shot's own tensor, and no sum of two.
    conductor = given.conductor(make, lambda_hf=0.0, evidence=evidence, views=[view])
    for t in range(1, given.STEPS):
        conductor.gate(t, given.N)
        update = conductor.update(params, lr, hr, view, t)
        alone = Conductor(objective=conductor.objective).update(params, lr, hr, view, t)
        shown["screen.ordinary"], before["screen.ordinary"] = [update.ordinary], [alone.ordinary]
        for what, tensors in shown.items():
            same = all(map(torch.equal, tensors, before[what]))
            require(same, f"{what} was changed in place by a hook; only after_step() may change parameters")


def check_answers_have_their_shapes(make: Make) -> None:
    """Answers that the conductor takes (types, shapes, gates >= 0, finite gradients), routes >= 0, and evidence in [0, 1]."""
    conductor = given.conductor(make)
    lr, hr, view, params = given.situation(1)
    for t in range(1, given.STEPS):
        conductor.gate(t, given.N)
        conductor.background(t)
        update = conductor.update(params, lr, hr, view, t)
        if (e := update.step.evidence) is not None:
            for q in (e.reliability, e.demand):
                require(bool(((q >= 0) & (q <= 1)).all()), "evidence must lie in [0, 1]")
        if (router := conductor.owner("route")) is not None:
            require(bool((torch.as_tensor(router.route(update.step)) >= 0).all()), "route() must give numbers >= 0")
        deferred.read([*computed(conductor.logs.scalars()).values()])
        without_error("draw", f"at t={t}", conductor.draw, t, params["means"], given.enlarged)
        conductor.extra_views(t)
        conductor.after_step(params, update.step)


def check_works_without_hr(make: Make) -> None:
    """While HR is not rendered the authentic gradient passes, whatever the strategy, and nothing else is asked of the view.

    A loop that loads its views one by one has none at the start.
    """
    conductor: Conductor = without_error("on_views", "where there are no views yet", given.conductor, make, views=[])
    for t in range(1, given.STEPS):
        lr, _, view, params = given.situation(2)
        conductor.gate(t, given.N)
        update = conductor.update(params, lr, None, view, t)
        without_error("after_step", "in an iteration without HR", conductor.after_step, params, update.step)


def check_is_reproducible(make: Make) -> None:
    """The same seed and iteration give the same answers; nothing depends on global random state."""
    results = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        results.append([*given.trace(given.conductor(make), 1, given.STEPS)])
    for first, second in zip(*results, strict=True):
        require(torch.equal(first, second), "two runs with one seed differ; derive randomness from (seed, t)")


def check_state_is_all_there_is(make: Make) -> None:
    """A strategy given its state back goes on as if it had never stopped, from any iteration."""
    whole = [*given.trace(given.conductor(make, evidence=given.evidence()), 1, given.STEPS)]
    for cut in range(1, given.STEPS):
        first, second = (given.conductor(make, evidence=given.evidence()) for _ in range(2))
        beginning = [*given.trace(first, 1, cut)]
        second.load_state_dict(first.state_dict())
        rest = [*given.trace(second, cut, given.STEPS)]
        for a, b in zip(whole, [*beginning, *rest], strict=True):
            require(torch.equal(a, b), f"cut before t={cut}: resuming from `state` does not continue the run")


def check_state_follows_its_gaussians(make: Make) -> None:
    """A reordering takes the rows of `state` along, and leaves `run_state` as it is. That each tensor of `state` has a row a
    Gaussian, the conductor asks after a step.
    """
    conductor = given.conductor(make)
    for _ in given.trace(conductor, 1, given.STEPS):
        pass
    (strategy,) = conductor.strategies
    before, of_run = copy.deepcopy((strategy.state, strategy.run_state))
    order = torch.randperm(given.N, generator=torch.Generator().manual_seed(0))
    conductor.on_resize(order)
    for name, rows in strategy.state.items():
        followed = before[name][order] if rows.dim() > 0 else before[name]
        require(torch.equal(rows, followed), f"state {name!r} did not follow its Gaussians")
    for name, x in strategy.run_state.items():
        require(torch.equal(x, of_run[name]), f"run_state {name!r} changed with the structure")


def check_goes_on_with_another_number_of_gaussians(make: Make) -> None:
    """Densification changes the number of Gaussians, in iterations with and without HR; nothing else has a row for each."""
    conductor, n = given.conductor(make), given.N
    for t, more in zip(range(1, given.STEPS), (0, 7, -5, -2, -3), strict=True):
        wanted = given.N + more
        if conductor.may_densify(t):
            parents = torch.arange(wanted) % n
            without_error("on_resize", f"from {n} Gaussians to {wanted}", conductor.on_resize, parents)
            n = wanted
        without_error(
            "a hook", f"after the number of Gaussians has changed to {n}", list, given.trace(conductor, t, t + 1, n)
        )


def check_facts_can_be_asked(make: Make) -> None:
    """`summary` and `without_effect` give a text or None; the plan of a run has them."""
    conductor = given.conductor(make)
    for s in conductor.strategies:
        for λ in (0.0, 1.0):
            effect = without_error("without_effect", "", s.without_effect, lambda_lr=λ, lambda_hr=λ, lambda_hf=λ)
            for fact in (effect, without_error("summary", "", s.summary)):
                require(
                    fact is None or isinstance(fact, str),
                    f"summary and without_effect give a text or None, got {fact!r}",
                )


def check_can_be_copied(make: Make) -> None:
    """Sweeps send strategies to other processes, also after a run."""
    conductor = given.conductor(make)
    list(given.trace(conductor, 1, given.STEPS))
    try:
        sent = ForkingPickler.dumps(conductor.strategies[0])
    except Exception as error:
        raise ContractError(f"a strategy cannot be sent to another process: {error}") from error
    require(ForkingPickler.loads(sent) == conductor.strategies[0], "a strategy does not survive pickling")


def check_all_of_it_is_called(make: Make) -> None:
    """It has a hook, none of a misspelled name, and not `reconcile` beside a `correct` that takes its place."""
    require(not (never := unused(type(make()))), " ".join(never))


CHECKS: Final[Sequence[Callable[[Make], None]]] = (
    check_is_frozen_settings,
    check_what_is_shown_is_left_alone,
    check_answers_have_their_shapes,
    check_works_without_hr,
    check_is_reproducible,
    check_state_is_all_there_is,
    check_state_follows_its_gaussians,
    check_goes_on_with_another_number_of_gaussians,
    check_densifier_takes_everything_along,
    check_facts_can_be_asked,
    check_can_be_copied,
    check_all_of_it_is_called,
)
