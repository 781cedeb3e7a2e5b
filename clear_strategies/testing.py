"""The contract of a strategy, as checks that anyone can run over their own.

    from clear_strategies.testing import check_strategy
    check_strategy(lambda: Mine(strength=2))

Each check raises `ContractError` with what was expected and what was found.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Final, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from clear_strategies.core import deferred, images
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import ATTRIBUTES, Grads, screen_of
from clear_strategies.core.step import Step
from clear_strategies.core.view import Photo, View
from clear_strategies.errors import AnswerError, DivergedError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.merging.iteration import Update
from clear_strategies.merging.objective import Objective
from clear_strategies.schedules import WarmupDecay, scaled
from clear_strategies.strategies.base import Strategy, overrides
from clear_strategies.training.field import GaussianField
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.interface import Camera
from rasterizers.testing import ContractError, require

Make = Callable[[], Strategy]

_N: Final = 30
_STEPS: Final = 6
_FACTOR: Final = 4


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
    lr, hr, view, params = _situation(0)
    evidence = _evidence()
    shown: dict[str, list[Any]] = {
        "a gradient": [x for shot in (lr, hr) for g in shot.gradients for x in (*g.values(), screen_of(g))],
        "an image": [view.lr.image, view.hr.image, lr.image, hr.image],
        "a rendering's means2d or visible": [x for shot in (lr, hr) for x in (shot.means2d, shot.visible)],
        "a parameter": [*params.values()],
        "the evidence": [evidence.reliability, evidence.demand],
    }
    before = copy.deepcopy(shown)
    # Then g_HR is the shot's own tensor, and no sum of two.
    conductor = _conductor(make, lambda_hf=0.0, evidence=evidence, views=[view])
    for t in range(1, _STEPS):
        conductor.gate(t, _N)
        update = conductor.update(params, lr, hr, view, t)
        alone = Conductor(objective=conductor.objective).update(params, lr, hr, view, t)
        shown["screen.ordinary"], before["screen.ordinary"] = [update.ordinary], [alone.ordinary]
        for what, tensors in shown.items():
            same = all(map(torch.equal, tensors, before[what]))
            require(same, f"{what} was changed in place by a hook; only after_step() may change parameters")


def check_answers_have_their_shapes(make: Make) -> None:
    """Answers of the types and shapes that the conductor takes, gates and routes >= 0, evidence in [0, 1], finite gradients."""
    conductor = _conductor(make)
    lr, hr, view, params = _situation(1)
    for t in range(1, _STEPS):
        z, _ = conductor.gate(t, _N), conductor.background(t)
        require(z is None or bool((z >= 0).all()), "gate() must give numbers >= 0")
        update = conductor.update(params, lr, hr, view, t)
        for name, gradient in _grads(update).items():
            require(bool(gradient.isfinite().all()), f"the gradient of {name} is not finite")
        if (e := update.step.evidence) is not None:
            for q in (e.reliability, e.demand):
                require(bool(((q >= 0) & (q <= 1)).all()), "evidence must lie in [0, 1]")
        if (router := conductor.owner("route")) is not None:
            require(bool((torch.as_tensor(router.route(update.step)) >= 0).all()), "route() must give numbers >= 0")
        deferred.read([*update.logs.values()])
        _without_error("draw", f"at t={t}", conductor.draw, t, params["means"], _enlarged)
        conductor.extra_views(t)
        memory = {name: p.data_ptr() for name, p in params.items()}
        conductor.after_step(params, update.step)
        for name, p in params.items():
            rule = f"after_step() must change {name} in place, by {name}.copy_(…), {name} += … or {name}[…] = …"
            require(p.data_ptr() == memory[name], f"{rule}; its .data was assigned, which changes nothing")


def check_works_without_hr(make: Make) -> None:
    """While HR is not rendered the authentic gradient passes, whatever the strategy, and nothing else is asked of the view.

    A loop that loads its views one by one has none at the start.
    """
    conductor: Conductor = _without_error("on_views", "where there are no views yet", _conductor, make, views=[])
    for t in range(1, _STEPS):
        lr, _, view, params = _situation(2)
        conductor.gate(t, _N)
        update = conductor.update(params, lr, None, view, t)
        for name in ("means", "opacities"):
            require(bool(_grads(update)[name].isfinite().all()), f"the gradient of {name} is not finite without HR")
        _without_error("after_step", "in an iteration without HR", conductor.after_step, params, update.step)


def check_is_reproducible(make: Make) -> None:
    """The same seed and iteration give the same answers; nothing depends on global random state."""
    results = []
    for noise in (0, 1):
        torch.manual_seed(noise)
        results.append([*_trace(_conductor(make), 1, _STEPS)])
    for first, second in zip(*results, strict=True):
        require(torch.equal(first, second), "two runs with one seed differ; derive randomness from (seed, t)")


def check_state_is_all_there_is(make: Make) -> None:
    """A strategy given its state back goes on as if it had never stopped, from any iteration."""
    trace = [*_trace(_conductor(make, evidence=_evidence()), 1, _STEPS)]
    for cut in range(1, _STEPS):
        first, second = (_conductor(make, evidence=_evidence()) for _ in range(2))
        beginning = [*_trace(first, 1, cut)]
        second.load_state_dict(first.state_dict())
        rest = [*_trace(second, cut, _STEPS)]
        for a, b in zip(trace, [*beginning, *rest], strict=True):
            require(torch.equal(a, b), f"cut before t={cut}: resuming from `state` does not continue the run")


def check_state_follows_its_gaussians(make: Make) -> None:
    """A reordering takes the rows of `state` along; that each tensor has a row a Gaussian, the conductor asks after a step."""
    conductor = _conductor(make)
    for _ in _trace(conductor, 1, _STEPS):
        pass
    before = {name: rows.clone() for name, rows in conductor.state_dict().items()}
    order = torch.randperm(_N, generator=torch.Generator().manual_seed(0))
    conductor.on_resize(order)
    for name, rows in conductor.state_dict().items():
        followed = before[name][order] if rows.dim() > 0 else before[name]
        require(torch.equal(rows, followed), f"state {name!r} did not follow its Gaussians")


def check_goes_on_with_another_number_of_gaussians(make: Make) -> None:
    """Densification changes the number of Gaussians, in iterations with and without HR; nothing else has a row for each."""
    conductor, n = _conductor(make), _N
    for t, wanted in zip(range(1, _STEPS), (_N, _N + 7, _N - 5, _N - 2, _N - 3), strict=False):
        if conductor.may_densify(t):
            parents = torch.arange(wanted) % n
            _without_error("on_resize", f"from {n} Gaussians to {wanted}", conductor.on_resize, parents)
            n = wanted
        _without_error(
            "a hook", f"after the number of Gaussians has changed to {n}", list, _trace(conductor, t, t + 1, n)
        )


def check_densifier_takes_everything_along(make: Make) -> None:
    """A densifier of its own gathers field and optimizer alike and says how, keeps to its cap, is reproducible, and goes on from
    its `state_dict`.
    """
    trace, again = ([*_densified(make)] for _ in range(2))
    for a, b in zip(trace, again, strict=True):
        require(torch.equal(a, b), "two runs of a densifier with one seed differ; derive randomness from (seed, t)")
    for cut in range(2, _STEPS) if trace else ():
        for a, b in zip(trace, _densified(make, cut), strict=True):
            require(torch.equal(a, b), f"cut before t={cut}: a densifier's state_dict() does not continue the run")


def check_facts_can_be_asked(make: Make) -> None:
    """`summary` and `without_effect` give a text or None; the plan of a run has them."""
    conductor = _conductor(make)
    for s in conductor.strategies:
        for λ in (0.0, 1.0):
            effect = _without_error("without_effect", "", s.without_effect, lambda_lr=λ, lambda_hr=λ, lambda_hf=λ)
            for fact in (effect, _without_error("summary", "", s.summary)):
                require(
                    fact is None or isinstance(fact, str),
                    f"summary and without_effect give a text or None, got {fact!r}",
                )


def check_can_be_copied(make: Make) -> None:
    """Sweeps send strategies to other processes."""
    try:
        sent = ForkingPickler.dumps(make())
    except Exception as error:
        raise ContractError(f"a strategy cannot be sent to another process: {error}") from error
    require(ForkingPickler.loads(sent) == make(), "a strategy does not survive pickling")


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
)


@dataclass(slots=True, eq=False)
class StubShot:
    """A rendering with given gradients: what a strategy needs of one, without a rasterizer."""

    image: Float[Tensor, "H W 3"]
    means2d: Float[Tensor, "N 2"]
    visible: Bool[Tensor, " N"]
    gradients: list[Grads]

    def vjp(self, cotangents: Float[Tensor, "K H W 3"]) -> list[Grads]:
        return self.gradients[: len(cotangents)]


def random_params(n: int, g: torch.Generator) -> dict[str, Tensor]:
    """Raw parameters by attribute."""
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3), "detail": (3,),
    }  # fmt: skip
    return {name: 3 * torch.randn(n, *shapes[name], generator=g) for name in ATTRIBUTES}


def _without_error(hook: str, when: str, call: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    try:
        return call(*args, **kwargs)
    except AnswerError:
        raise
    except Exception as error:
        raise ContractError(f"{hook} fails {when} ({type(error).__name__}: {error})".replace("  ", " ")) from error


def _situation(seed: int, n: int = _N) -> tuple[StubShot, StubShot, View, dict[str, Tensor]]:
    g = torch.Generator().manual_seed(0)  # one view, whatever the seed: strategies may remember it by name
    camera = Camera(torch.eye(4, dtype=torch.float64), 40.0, 40.0, 20.0, 16.0, 40, 32)  # as the readers give poses
    hr_image = images.quantize(torch.rand(32, 40, 3, generator=g))
    lr_image = images.downsample(hr_image, _FACTOR)
    noisy = (hr_image + 0.1 * torch.randn(32, 40, 3, generator=g)).clamp(0, 1)
    view = View("checked", Photo(camera.scaled(1 / _FACTOR), lr_image), Photo(camera, noisy))
    g = torch.Generator().manual_seed(seed)
    visible = torch.rand(n, generator=g) < 0.8
    u = torch.rand(n, 2, generator=g) * torch.tensor([40.0, 32.0])

    def gradients(detail: bool) -> Grads:
        values = {name: 1e-6 * p * visible.view(-1, *[1] * (p.dim() - 1)) for name, p in random_params(n, g).items()}
        if not detail:
            del values["detail"]
        return Grads(values, screen=1e-6 * torch.randn(n, 2, generator=g))

    lr = StubShot(lr_image * 0.9, u / _FACTOR, visible, [gradients(False)])
    hr = StubShot(hr_image * 1.2 - 0.1, u, visible, [gradients(True), gradients(True)])
    return lr, hr, view, random_params(n, g)


@dataclass(frozen=True)
class _Observes(Strategy):
    """Has the evidence that another strategy may read."""

    evidence: Evidence

    def observe(self, step: Step, hr: Any) -> Evidence:
        return self.evidence


def _evidence() -> Evidence:
    q = torch.linspace(0, 1, _N)
    return Evidence(q, q.flip(0))


def _conductor(
    make: Make, *, lambda_hf: float = 0.2, evidence: Evidence | None = None, views: Sequence[View] | None = None,
    others: Sequence[Strategy] = (),
) -> Conductor:  # fmt: skip
    """Milestones are compressed, so that every phase falls inside the few steps of a check.

    Args:
        evidence: of another strategy, where this one has none. views: of the training, for `on_views`.
        others: that take part besides.
    """
    objective = Objective(WarmupDecay(start=0, full=1, decay_from=_STEPS, end=_STEPS), lambda_hf)
    strategy = scaled(make(), _STEPS / 2 / 5_000)
    if evidence is not None and not overrides(strategy, "observe"):
        others = [*others, _Observes(evidence)]
    conductor = Conductor(strategy, *others, objective=objective)
    conductor.on_fit_start(3, seed=11, views=[_situation(0)[2]] if views is None else views)
    return conductor


def _trace(conductor: Conductor, start: int, stop: int, n: int = _N) -> Any:
    """All answers of a conductor in the iterations from `start` to before `stop`."""
    for t in range(start, stop):
        lr, hr, view, params = _situation(100 + t, n)
        z = conductor.gate(t, n)
        yield torch.ones(n) if z is None else z
        yield torch.tensor(conductor.background(t) or (0.0, 0.0, 0.0))
        update = conductor.update(params, lr, hr, view, t)
        yield update.score
        grads = _grads(update)
        yield from (grads[name] for name in sorted(grads))
        for extra in conductor.extra_views(t):
            yield from (extra.photo.image, extra.weight)
        conductor.after_step(params, update.step)
        yield from params.values()


@dataclass(frozen=True)
class _Rows(Strategy):
    """Knows after a change of structure from which row each comes."""

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        self.state["row"] = torch.arange(float(len(params["means"])))


def _densified(make: Make, cut: int = 0) -> Iterator[Tensor]:
    """All parameters after each iteration of a run that is resumed before t=cut; nothing where the trainer densifies."""
    state = _begun(make)
    while state is not None and state.t < _STEPS:
        if state.t == cut:
            saved, state = state.checkpoint({}), cast(TrainState, _begun(make))
            state.restore(saved, Path("checkpoint"))
        t, field, density, conductor = state.t, state.field, state.density, state.conductor
        lr, hr, view, _ = _situation(100 + t, len(field))
        update = conductor.update(field.raw(), lr, hr, view, t)
        state.optimizer.step(field.raw(), _grads(update))
        if density.collects(t):
            stepped = replace(update, grads=None)  # as of the compiled step
            _without_error("a densifier's accumulate", f"at t={t}", density.accumulate, stepped, hr, t)
        conductor.after_step(field.raw(), update.step)
        state.optimizer.first["opacities"].copy_(torch.arange(1, len(field) + 1))
        if conductor.may_densify(t):
            _without_error("a densifier's step", f"at t={t}", state.restructure)
        momentum, n = state.optimizer.first["opacities"], len(field)
        came_from = conductor.state_dict()["_Rows.row"]
        follows = len(momentum) == n and bool(((momentum == came_from + 1) | (momentum == 0)).all())
        require(follows, f"a densifier's step must gather the optimizer as the field, by optimizer.take(…), at t={t}")
        most = n if density.cap is None else max(density.cap, _N)
        require(n <= most, f"a densifier's cap is {density.cap}, but the field has {n} Gaussians at t={t}")
        state.advance()
        yield from (p.clone() for p in field.raw().values())


def _begun(make: Make) -> TrainState | None:
    """A run before its first iteration; None where the strategy brings no densifier."""
    view, g = _situation(0)[2], torch.Generator().manual_seed(0)
    conductor = _conductor(make, others=[_Rows()], views=[view])
    if (owner := conductor.owner("densifier")) is None:
        return None
    field = GaussianField(random_params(_N, g))
    density = _without_error("densifier", "at the start", owner.densifier, field, [view], 11)
    if density is None:
        return None
    optimizer = Adam(field.raw(), LearningRates(), 1.0)
    return TrainState(field, conductor, optimizer, density, FitSettings(), MipFilter(), (view,))


def _enlarged(camera: Camera, factor: int) -> Photo:
    large = camera.scaled(factor)
    return Photo(large, torch.full((large.height, large.width, 3), 0.5))


def _grads(update: Update) -> Grads:
    """The merged gradient, which is there as no `Stepper` is used."""
    return update.grads or Grads()
