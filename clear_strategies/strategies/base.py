"""The contract of a strategy. A strategy answers questions about one training iteration, whatever rasterizer draws.

The hooks are phases of an iteration, so their order needs no configuration. `Strategy` answers each as if there were no
strategy. At most one strategy may override each of the hooks with a single answer: densifier, background, gate, observe, route,
reconcile or correct, score.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from numbers import Real
from typing import Any, Final, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

import rasterizers
from clear_strategies.core.conflicts import Products, Weights
from clear_strategies.core.deferred import Deferred, Number
from clear_strategies.core.evidence import Evidence, PatchMaps
from clear_strategies.core.gradients import CONFLICT_GROUPS, Grads, ScreenGradients, Shot, gathered
from clear_strategies.core.step import Losses, Step
from clear_strategies.core.view import ExtraView, Photo, View
from clear_strategies.errors import AnswerError
from clear_strategies.kernels import reconcile
from clear_strategies.signatures import annotations_of
from rasterizers.interface import Camera, Color, Rasterizer, Splats
from rasterizers.native import empty_for

_ALIKE: Final = 0.85  # "regularise" to "regularize" 0.9, "densify" to "densifier" 0.75
_OWN_NAMES: Final = {
    "state",
    "run_state",
    "cache",
    "logs",
    "of_run",
    "device",
    "seed",
    "lambda_hr",
    "splats",
    "rasterizer",
}

ONE_ANSWER: Final = ("densifier", "background", "gate", "observe", "route", "reconcile", "score")
"""Hooks that one strategy of a run may override; `correct` may be overridden in place of `reconcile`."""
ALL_ANSWER: Final = ("compare", "regularize", "draw", "extra_views", "may_densify", "after_step")

Scale = Literal["lr", "hr"]

Logged = Number | Callable[[], Number]
"""A scalar, or a function that computes it."""


def _no_weight(t: int) -> float:
    return 0.0


def by_exp_and_sigmoid(params: Mapping[str, Tensor]) -> Splats:
    """Raw parameters, activated as 3DGS does."""
    scales, opacities = params["scales"].exp(), params["opacities"].sigmoid()
    return Splats(params["means"], params["quats"], scales, opacities, params["sh0"], params["shN"])


@dataclass(slots=True, eq=False)
class RunFacts:
    """What the trainer tells the strategies of a run; the properties and methods of `Strategy` give it.

    Args:
        seed: None before the run starts.
        lambda_hr: the schedule of the run's objective. splats: activates raw parameters as the run draws them.
        rasterizer: of the run; None: the trainer does not tell it.
    """

    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    seed: int | None = None
    lambda_hr: Callable[[int], float] = _no_weight
    splats: Callable[[Mapping[str, Tensor]], Splats] = by_exp_and_sigmoid
    rasterizer: Rasterizer | None = None


@dataclass(frozen=True)
class Strategy:
    """A frozen dataclass of settings, plus its state.

    Args:
        state: tensors [N, …] with a row for each Gaussian, which `on_resize` gathers, and scalar tensors. Checkpoints save them.
        run_state: other tensors, of any shape, such as parameters for each view. Checkpoints save them.
        cache: values that can be computed again (patch maps, keyed by view); never saved.
        logs: scalars of this iteration, see `log`.
        of_run: device, seed, λ_HR and activations of the run; all strategies of a run share the object.

    Random numbers must be a function of (seed, t), so that resuming needs no generator state. Hooks run without autograd. A copy
    or a pickle has only the settings, for another run.
    """

    state: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)
    run_state: dict[str, Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)
    cache: dict[Hashable, Any] = field(default_factory=dict, init=False, repr=False, compare=False)
    logs: dict[str, Logged] = field(default_factory=dict, init=False, repr=False, compare=False)
    of_run: RunFacts = field(default_factory=RunFacts, init=False, repr=False, compare=False)

    def __init_subclass__(cls, **arguments: Any) -> None:
        super().__init_subclass__(**arguments)
        of_all = {name for name in vars(Strategy) if name[0] != "_"} | _OWN_NAMES
        if taken := of_all & annotations_of(cls).keys():
            raise TypeError(
                f"{cls.__name__}: a setting must not be called {min(taken)}, which every strategy has already."
            )

    def __getstate__(self) -> dict[str, Any]:
        """The settings. What a strategy knows of its run may hold photos, the field and functions."""
        return {**vars(self), **vars(Strategy())}

    # ---- hooks, in the order in which this trainer calls them --------------------------------------------------------

    def densifier(self, field: Any, views: Sequence[View], seed: int) -> Any:
        """Once, before the first iteration: a `clear_strategies.training.densifier.Densifier`, which clones, moves and prunes
        Gaussians instead of `density`; None: `density` does. Other trainers keep their own density control, and never call this.

        Args:
            field: the initial Gaussians, a `clear_strategies.training.field.GaussianField`.
            views: all training views.
        """
        return None

    def on_fit_start(self, n_views: int, seed: int) -> None:
        """Start a run, or resume one. An override need not call `super()`."""
        self._forget(RunFacts(self.device, int(seed)))  # arithmetic with numpy's numbers overflows

    def on_views(self, views: Sequence[View]) -> None:
        """Look at all training views once, after `on_fit_start`.

        Args:
            views: on the device of the field; empty if the training loop does not have all of them at the start.
        """

    def gate(self, t: int, n: int) -> Float[Tensor, " N"] | Float[Tensor, "2 N"] | None:
        """Before render: which Gaussians take part? z >= 0 multiplies the opacities; None: all take part.  Eq. 15

        If `shares_gate` is false, z has two rows, for LR and for HR.
        """
        return None

    def background(self, t: int) -> Color | None:
        """Before render: over which colour are both scales and the extra views rendered? None: the scene's own."""
        return None

    def compare(
        self, scale: Scale, image: Float[Tensor, "H W 3"], photo: Photo, step: Step, losses: Callable[[Tensor], Losses]
    ) -> Losses:
        """After render: how is the image compared with its photo? Each strategy adds a loss, or changes the image.  Eq. 4, 5

        Other trainers call it for HR alone, unless they use `joint_loss`, since their LR loss is their own. Extra views are
        compared by the objective alone.

        Args:
            photo: the LR photo or the SR image, over the background of the iteration.
            step: without `visible` and evidence.
            losses: compares an image with the photo, by the strategies after this one and the objective. Call it once; the
                cotangents that it returns may be changed in place.
        """
        return losses(image)

    def observe(self, step: Step, hr: Shot) -> Evidence | None:
        """After render: what is I_HR worth for each Gaussian?  Eq. 9, 10

        Args:
            hr: the HR render of `step.view`.
        """
        return None

    def route(self, step: Step) -> float | Float[Tensor, " N"]:
        """How much of its high-frequency gradient does each Gaussian get? m >= 0; 1: all of it.  Eq. 12"""
        return 1.0

    def score(self, step: Step, screen: ScreenGradients) -> Float[Tensor, " N"] | None:
        """For densification: where is more structure needed? None: the ordinary statistic.  Eq. 14

        Only the order of the scores counts: they are averaged over the views that show a Gaussian, and as many Gaussians grow as
        would by the ordinary statistic, those with the largest means (`density.mode=quantile`). In other trainers the scores are
        scaled so that as many Gaussians pass the threshold.
        """
        return None

    def reconcile(self, products: Products, step: Step | None) -> Weights:
        """How to reconcile both gradients? ĝ_HR = keep · g_HR - remove · g_LR; g_LR is never changed.  Eq. 6, 7, 11

        Args:
            products: dot product and squared norms of the two gradients, for each Gaussian and attribute group.
            step: the iteration, with the evidence; None if `correct` was called without one.
        """
        return Weights()

    def correct(self, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], step: Step | None = None) -> Grads:
        """ĝ_HR, from two gradients by attribute. The default applies the weights of `reconcile`.

        A strategy that decides number by number overrides this hook instead of `reconcile`, and gets both gradients in full.

        Args:
            lr, hr: attribute -> gradient [N, …], any of `CONFLICT_GROUPS`. A group that only one of them has is not compared;
                None is left out.

        Raises:
            ValueError: both have gradients, but no group in common.
        """
        lr, hr = (Grads({name: g for name, g in grads.items() if g is not None}) for grads in (lr, hr))
        if not lr or not hr:
            return hr
        products = reconcile.products(lr, hr)
        out = {name: empty_for(g) for name, g in hr.items() if name in CONFLICT_GROUPS}
        reconcile.apply(out, lr, hr, self.reconcile(products, step), keeps_lr=False)
        return Grads({**hr, **out})

    def regularize(self, params: Mapping[str, Tensor], t: int) -> Grads | None:
        """Before the optimizer step: a gradient to add. Several strategies may answer.  Eq. 16"""
        return None

    def draw(self, t: int, means: Float[Tensor, "N 3"], enlarged: Callable[[Camera, int], Photo]) -> None:
        """Before the extra views of t: render the field, e.g. to make extra views of it. Other trainers never call this hook.

        Args:
            means: positions of the Gaussians.
            enlarged: renders the field by a camera, without f_det, and enlarges the picture by a whole factor, with the network
                of the prior or, if it has none, bicubically.
        """

    def extra_views(self, t: int) -> Sequence[ExtraView]:
        """Which other pictures should the field match at t? Several strategies may answer.

        Each is rendered once, without dropout and f_det, and gets an optimizer step of its own on the LR loss, after the step
        of the iteration's view. It has no part in evidence, conflicts, densification and regularization.
        """
        return ()

    def after_step(self, params: Mapping[str, Tensor], step: Step) -> None:
        """After the optimizer steps of an iteration: update `state`, e.g. take the anchor, or change `params` in place."""

    def may_densify(self, t: int) -> bool:
        """May the structure change at t? All strategies must agree."""
        return True

    def on_resize(self, parents: Int[Tensor, " M"]) -> None:
        """After the structure changed: row i of every per-Gaussian tensor now comes from row parents[i]."""
        for name, rows in self.state.items():
            if rows.dim() > 0:
                self.state[name] = gathered(rows, parents)

    def on_fit_end(self) -> None:
        """After the last iteration: release the memory that only training needs."""

    def _forget(self, run: RunFacts) -> None:
        for of_last_run in (self.state, self.run_state, self.cache, self.logs):
            of_last_run.clear()
        object.__setattr__(self, "of_run", run)

    # ---- facts about the strategy, for the plan, the pictures and recordings -------------------------------------------

    def summary(self) -> str | None:
        """A phrase for the plan that says what the strategy has prepared for this run; None: nothing."""
        return None

    def without_effect(self, *, lambda_lr: float, lambda_hr: float, lambda_hf: float) -> str | None:
        """Why the strategy changes nothing with these loss weights; None if it has an effect. The default looks at which hooks it
        overrides.

        Args:
            lambda_hr: the largest λ_HR(t) of the run.
            lambda_hf: the share of the high-frequency loss in it.
        """
        own = hooks_of(type(self))
        if own and lambda_hr == 0 and own <= {"route", "reconcile", "correct"}:
            return "lambda_HR is 0 throughout"
        if lambda_hf == 0 and own == {"route"}:
            return "lambda_HF is 0, and it routes the high-frequency loss alone"
        if lambda_lr == 0 and {"extra_views"} <= own <= {"extra_views", "draw"}:
            return "it is the LR loss that its pictures are trained by, and lambda_lr is 0"
        return None

    @property
    def shares_gate(self) -> bool:
        """True if `gate` answers for both scales at once."""
        return True

    def patch_maps(self, view: View) -> PatchMaps | None:
        """The patch evidence that the strategy works with for this view; None: it uses none.  Eq. 9"""
        return None

    def looked_up(self, view: View) -> Tensor | None:
        """All that `observe`, `route` and `score` read of a view, as one tensor, e.g. P2G's patch maps; None: they read the view.

        With such a tensor, iterations on a GPU can be replayed: a replay copies the tensor of its view to `Step.looked_up`, where
        the recorded hooks read it. A subclass that overrides one of the three hooks must override this one, too.
        """
        return None

    # ---- for subclasses ---------------------------------------------------------------------------------------------

    def log(self, name: str, value: Logged) -> None:
        """Log a scalar of this iteration, or a function that computes it.

        The function is called only if the log is read (in a host, in every hundredth iteration), and before the next iteration. A
        0-dim tensor on a device is read later, see `core.deferred`. If another strategy has logged the same name, the column is
        "<class>.<name>". Without a conductor, read the logs by `merging.logs.computed(self.logs)`.
        """
        is_number = value.dim() == 0 if isinstance(value, Tensor) else isinstance(value, (Real, Deferred))
        if not (is_number or callable(value)):
            found = f"a tensor {[*value.shape]}" if isinstance(value, Tensor) else f"{value!r:.80}"
            raise AnswerError(f"{type(self).__name__}.log({name!r}, …) takes one number, got {found}.")
        self.logs[name] = value

    def to(self, device: torch.device | str) -> None:
        """Move `state` and `run_state` to the device of the field; answers are expected there."""
        self.of_run.device = torch.device(device)
        for tensors in (self.state, self.run_state):
            tensors.update({name: x.to(device) for name, x in tensors.items()})

    @property
    def device(self) -> torch.device:
        """The device of the field."""
        return self.of_run.device

    def lambda_hr(self, t: int) -> float:
        """λ_HR(t) of the run's objective; 0 before the run starts."""
        return self.of_run.lambda_hr(t)

    def splats(self, params: Mapping[str, Tensor]) -> Splats:
        """Activate raw parameters of all Gaussians as the run does, without f_det. Differentiable.

        In this trainer, the 3D filter is applied; filters of other trainers are left out.
        """
        return self.of_run.splats(params)

    @property
    def rasterizer(self) -> Rasterizer:
        """What draws the run, for a strategy that renders by itself. In other trainers, it is not their own function, but the
        fastest rasterizer of this package, with its defaults.
        """
        if self.of_run.rasterizer is None:
            self.of_run.rasterizer = rasterizers.load(rasterizers.fastest(self.device))
        return self.of_run.rasterizer

    @property
    def seed(self) -> int:
        """The seed of the run; 0 before it starts."""
        return self.of_run.seed or 0


def stored(strategy: Strategy) -> list[Tensor]:
    """The tensors of a strategy that checkpoints save."""
    return [*strategy.state.values(), *strategy.run_state.values()]


def overrides(strategy: Strategy, hook: str) -> bool:
    """Return True if the strategy's class overrides `hook`."""
    return getattr(type(strategy), hook) is not getattr(Strategy, hook)


def hooks_of(cls: type[Strategy]) -> set[str]:
    """The hooks that a class answers."""
    return {hook for hook in (*ONE_ANSWER, "correct", *ALL_ANSWER) if getattr(cls, hook) is not getattr(Strategy, hook)}


def begin(s: Strategy, run: RunFacts, n_views: int) -> None:
    """Make a strategy forget its last run and start this one, whose facts other strategies share."""
    s._forget(run)
    s.on_fit_start(n_views, s.seed)
    object.__setattr__(s, "of_run", run)  # an override that calls `super()` has replaced it
    s.to(run.device)


def unused(cls: type[Strategy]) -> list[str]:
    """What nothing calls, in sentences: methods named nearly as a hook that the class lacks, and weights beside `correct`."""
    inherited = (name for name in vars(Strategy) if getattr(cls, name) is getattr(Strategy, name))
    hooks = [name for name in inherited if name not in _OWN_NAMES | {"log", "to"} and name[0] != "_"]
    own = cls.__name__
    found = [] if hooks_of(cls) else [f"{own} implements no hook; it has no effect."]
    for name, _ in inspect.getmembers(cls, inspect.isfunction):
        if name[0] != "_" and not hasattr(Strategy, name):
            near = get_close_matches(name, hooks, n=1, cutoff=_ALIKE)
            found += [f"{own}.{name}() is no hook: nothing calls it. There is {hook}()." for hook in near]
    both, code = {"correct", "reconcile"}, getattr(inspect.unwrap(cls.correct), "__code__", None)
    if both <= vars(cls).keys() and code and both.isdisjoint(code.co_names):  # nor by super().correct()
        found.append(f"{own}.correct() is called in place of {own}.reconcile(): keep one of them.")
    return found


def by_class(strategies: Sequence[Strategy]) -> dict[str, Strategy]:
    """Each strategy by the name of its class; a second one of a class as "<class>2"."""
    named: dict[str, Strategy] = {}
    for s in strategies:
        name = type(s).__name__
        same = sum(type(other).__name__ == name for other in named.values())
        named[name if same == 0 else f"{name}{same + 1}"] = s
    return named
