"""The conductor: Eq. 8 and 13, exclusivity, and the strategies' contract."""

import copy
import inspect
import operator
import pickle
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

import clear_strategies
from clear_strategies import (
    GCO,
    P2G,
    SVS,
    Conductor,
    Evidence,
    ExtraView,
    Grads,
    Objective,
    Photo,
    Strategy,
    StrategyConflict,
    Weights,
)  # fmt: skip
from clear_strategies.core.seeds import dropout_mask
from clear_strategies.data.priors import BackProjected, Bicubic
from clear_strategies.errors import AnswerError, SettingError
from clear_strategies.kernels.losses import reference
from clear_strategies.merging.logs import computed
from clear_strategies.schedules import WarmupDecay
from clear_strategies.strategies.base import unused
from clear_strategies.testing import CHECKS, ContractError, check_strategy, given
from clear_strategies.training import loop
from clear_strategies.training.densifier import Densifier
from clear_strategies.training.field import GaussianField
from rasterizers import Splats, autograd
from tests.helpers import short_run, toy
from tests.helpers.compiled_step_cases import ALWAYS
from tests.helpers.host_parts import shot_of


@dataclass(frozen=True)
class Halve(Strategy):
    """A strategy of somebody else: half of every HR gradient."""

    share: float = 0.5

    def correct(self, lr, hr, step):
        return hr * self.share


@dataclass(frozen=True)
class Darker(Strategy):
    """Compares the render at half its brightness, which it learns: a parameter of its own."""

    rate: float = 0.0

    def compare(self, scale, image, photo, step, losses):
        gain = self.run_state.setdefault("gain", torch.full((3,), 0.5))
        found = losses(image * gain)
        slope = (found.cotangents[0] * image).sum((0, 1))
        found.cotangents.mul_(gain)
        gain -= self.rate * slope
        return found


@dataclass(frozen=True)
class Brightness(Strategy):
    """A loss of its own: the mean of what is compared."""

    def compare(self, scale, image, photo, step, losses):
        found = losses(image)
        found.cotangents[0] += 1 / image.numel()
        return found._replace(values={**found.values, f"mean_{scale}": float(image.mean())})


def anchoring() -> SVS:
    return SVS(anchor_strength=0.01)


def learning() -> Darker:
    return Darker(0.01)


PUBLIC = [found for name in clear_strategies.__all__ if isinstance(found := getattr(clear_strategies, name), type)]
OURS = [made for made in PUBLIC if issubclass(made, Strategy) and made is not Strategy]


@pytest.mark.parametrize(
    "make", [*OURS, anchoring, learning, Halve, Darker, Brightness, toy.RunningMean], ids=lambda make: make.__name__
)
@pytest.mark.parametrize("check", CHECKS, ids=lambda c: c.__name__)
def test_contract(make, check):
    check(make)


def answering(hook, answer, **facts):
    """A strategy with this answer, a value or a function of the hook's arguments."""

    def answered(self, *arguments):
        return answer(*arguments) if callable(answer) else answer

    return dataclass(frozen=True)(type("Mine", (Strategy,), {hook: answered, **facts}))


def distrusts(products, step):
    """Changes the evidence of another strategy."""
    return Weights() if step.evidence is None else Weights(keep=step.evidence.reliability.mul_(0.5))


def changing(hook, change, **others):
    """A strategy that changes what this hook is given, and gives no answer."""

    def changes(*arguments):
        change(*arguments)

    return answering(hook, changes, **others)


def NO_GATE(self, t, n):
    """A hook of a strategy that has to have one beside `on_views`."""


@dataclass(frozen=True)
class Secretive(Strategy):
    """Remembers outside `state`."""

    def score(self, step, screens):
        self.cache["calls"] = self.cache.get("calls", 0) + 1
        return screens.ordinary * self.cache["calls"]


@dataclass(frozen=True)
class SecretGain(Strategy):
    """Learns a gain of the image outside `run_state`."""

    def compare(self, scale, image, photo, step, losses):
        gain = self.cache["gain"] = self.cache.get("gain", 1.0) * 0.9
        return losses(image * gain)


@dataclass(frozen=True)
class Fixed(Strategy):
    """Has a row for each Gaussian where they do not follow."""

    def reconcile(self, products, step):
        return Weights(keep=self.cache.setdefault("rows", torch.ones(len(products.dot))))


@dataclass(frozen=True)
class Resizes(Strategy):
    """Changes what is not there yet."""

    def reconcile(self, products, step):
        return Weights(keep=self.state.setdefault("rows", torch.ones(len(products.dot))))

    def on_resize(self, parents):
        self.state["rows"] = self.state["rows"][parents]


@dataclass(frozen=True)
class OfTensors(Strategy):
    weights: torch.Tensor = field(default_factory=lambda: torch.ones(6))


@dataclass(frozen=True)
class OfFunctions(Strategy):
    weight: object = lambda t: 1.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (answering("correct", lambda lr, hr, step: hr | {"means": hr["means"].mul_(2)}), "a gradient was changed in place"),
        (answering("reconcile", distrusts), "the evidence was changed in place"),
        (changing("observe", lambda step, hr: step.view.hr.image.clamp_(0.2, 0.8)), "^an image was changed in place"),
        (changing("observe", lambda step, hr: hr.image.clamp_(0, 1)), "^an image was changed in place"),
        (changing("on_views", lambda views: views[0].lr.image.mul_(0.5), gate=NO_GATE), "^an image was changed in place"),
        (changing("observe", lambda step, hr: step.visible.logical_not_()), "^a rendering's means2d or visible was changed"),
        (changing("score", lambda step, screen: screen.ordinary.mul_(2)), "^screen.ordinary was changed in place"),
        (changing("regularize", lambda params, t: params["opacities"].clamp_(max=4)), "must not change opacities in place"),
        (answering("compare", lambda scale, image, photo, step, losses: losses(image.mul_(0.5))), "must not change the image in"),
        (answering("observe", lambda step, hr: Evidence(step.visible / step.visible, step.visible.float())),
         "the evidence of reliability is not finite"),
        (answering("gate", lambda t, n: (torch.rand(n) > 0.5).float()), "derive randomness"), (Secretive, "does not continue"),
        (SecretGain, "does not continue"),
        (answering("after_step", lambda p, step: step.visible.float()), "after_step fails in an iteration without HR"),
        (answering("on_views", lambda views: views[0].lr, gate=NO_GATE), "on_views fails where there are no views yet"),
        (Fixed, r"Fixed.reconcile\(\) must give .* \[37\]"),
        (Resizes, "on_resize fails from 30 Gaussians to 30"), (answering("summary", lambda: {}["prepared"]), "summary fails"),
        (OfTensors, "settings cannot be compared"), (OfFunctions, "cannot be sent to another process"),
    ],
)  # fmt: skip
def test_the_contract_can_fail(make, message):
    with pytest.raises(ContractError, match=message):
        check_strategy(make)


def nan_of_first(rows):
    return rows.index_fill(0, torch.tensor([3]), torch.nan)


ANSWERS = {
    "gate [N]": ("gate", lambda t, n: torch.ones(n + 1), "must give a tensor \\[30\\] or None, got a tensor \\[31\\]"),
    "gate": ("gate", 0.5, "must give a tensor .* or None, got 0.5"),
    "gate NaN": ("gate", lambda t, n: nan_of_first(torch.ones(n)), "must give finite numbers >= 0, but z has nan to nan"),
    "gate < 0": ("gate", lambda t, n: -torch.ones(n), "must give finite numbers >= 0, but z has -1 to -1"),
    "background": ("background", torch.zeros(3), "must give three numbers in \\[0, 1\\] or None"),
    "observe": ("observe", (1.0, 2.0), "must give an Evidence or None, got \\(1.0, 2.0\\)"),
    "evidence [N]": ("observe", lambda step, hr: Evidence(torch.ones(5), torch.ones(5)), "reliability is a tensor \\[30\\]"),
    "route": ("route", torch.tensor(0.5), "must give a number or a tensor \\[30\\], got a tensor \\[\\]"),
    "reconcile": ("reconcile", {"keep": 1.0}, "must give Weights\\(keep, remove\\), got {'keep': 1.0}"),
    "keep": ("reconcile", Weights(keep=None), "keep is a number or a tensor \\[30\\] or \\[30, 6\\], got None"),
    "keep, by group": (
        "reconcile", Weights(keep=torch.ones(6)),
        "\\[30, 6\\]; w.expand_as\\(products.dot\\) gives each Gaussian those of its groups, got a tensor \\[6\\]",
    ),
    "keep NaN": (
        "reconcile", lambda p, step: Weights(keep=nan_of_first(p.dot[:, 0])),
        "must give finite numbers, but keep is not finite for 1 Gaussian, first Gaussian 3",
    ),
    "keep, a number": ("reconcile", Weights(keep=float("nan")), "must give finite numbers, but keep is nan"),
    "keep, complex": (
        "reconcile", lambda p, step: Weights(keep=p.dot[:, 0] + 1j), "keep is a number or .*, got a complex tensor \\[30\\]"
    ),
    "keep, sparse": (
        "reconcile", lambda p, step: Weights(keep=p.dot.to_sparse()), "keep is a number or .*, got a tensor .* to_dense"
    ),
    "keep, meta": (
        "reconcile", lambda p, step: Weights(keep=p.dot[:, 0].to("meta")),
        "Weights whose keep is on cpu, as products.dot, not on meta; keep.to\\(.*\\) is there, got a meta tensor \\[30\\]",
    ),
    "keep, a number on another device": (
        "reconcile", lambda p, step: Weights(keep=torch.ones((), device="meta")), "Weights whose keep is on cpu"
    ),
    "regularize, meta": (
        "regularize", lambda p, t: {"means": p["means"].to("meta")}, "must give means as .* on cpu, not on meta, got a meta"
    ),
    "route NaN": ("route", float("nan"), "must give finite numbers, but m is nan"),
    "correct": ("correct", None, "must give Grads, or a mapping from attributes to tensors, got None"),
    "correct, names": ("correct", lambda lr, hr, step: {"mean": hr["means"]}, "must give attributes of g_HR, .*, got 'mean'"),
    "correct, rows": (
        "correct", lambda lr, hr, step: {"means": hr["means"][:5]}, "must give means as a tensor \\[30, 3\\], got .* \\[5, 3\\]"
    ),
    "regularize": ("regularize", torch.ones(30), "must give Grads, or a mapping"),
    "regularize, NaN": ("regularize", lambda p, t: {"means": nan_of_first(p["means"])}, "must give finite numbers, but means"),
    "score": ("score", 1.0, "must give a tensor \\[30\\] or None, got 1.0"),
    "score NaN": ("score", lambda step, screen: nan_of_first(screen.ordinary), "must give finite numbers, but S"),
    "extra_views": ("extra_views", None, "must give a sequence of ExtraView, got None"),
    "extra_views, views": ("extra_views", lambda t: [toy.scene().train[0]], "must give a sequence of ExtraView, got View"),
    "extra_views, weight": (
        "extra_views", lambda t: [ExtraView(toy.scene().train[0].lr, weight=torch.ones(3, 5))],
        "must give an ExtraView whose weight is a tensor \\[.*\\], as its photo, got a tensor \\[3, 5\\]",
    ),
    "extra_views, NaN": (
        "extra_views", lambda t: [ExtraView(photo := toy.scene().train[0].lr, weight=photo.image[..., 0] * torch.nan)],
        "must give finite numbers >= 0, but the weight has nan to nan",
    ),
}  # fmt: skip


@pytest.mark.parametrize("answer", ANSWERS)
def test_an_answer_that_a_hook_must_not_give_is_refused_by_the_name_of_both(answer):
    hook, given, message = ANSWERS[answer]
    with pytest.raises(ContractError, match=f"^Mine.{hook}\\(\\) .*{message}"):
        check_strategy(answering(hook, given))


@pytest.mark.parametrize("form", [Tensor.double, Tensor.half, Tensor.bool, lambda z: torch.stack((z, 1 - z), 1)[:, 0]])
def test_a_gate_of_any_type_and_strides_is_what_it_is_as_float32(form):
    def trained(form):
        state = short_run.start((), more=[answering("gate", lambda t, n: form((torch.arange(n) % 3 > 0).float()))()])
        loop.iterate(state, toy.RASTERIZER)
        return short_run.tensors(state)

    expected = trained(Tensor.clone)
    assert not [name for name, x in trained(form).items() if not torch.equal(x, expected[name])]


def test_a_gate_is_checked_without_a_comparison_of_each_number():
    """Ten times as slow, in every iteration."""
    conductor = Conductor(answering("gate", lambda t, n: torch.ones(n))())
    with toy.Operations() as operations:
        conductor.gate(1, 30)
        conductor.gate(1, 0)
    assert "aminmax" in operations.count
    assert not {"ge", "lt", "bitwise_and", "isfinite"} & operations.count.keys()


def test_a_colour_may_be_a_list_and_a_forgotten_answer_does_not_end_densification():
    assert Conductor(answering("background", [0.25, 0.5, 0])()).background(1) == (0.25, 0.5, 0)
    with pytest.raises(AnswerError, match=r"may_densify\(\) must give True or False, got None"):
        Conductor(answering("may_densify", None)()).may_densify(1)
    with pytest.raises(AnswerError, match="must give True or False, got 'no'"):
        Conductor(answering("may_densify", "no")()).may_densify(1)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("means", lambda params: setattr(params["means"], "data", params["means"] * 0.9)),
        ("means", lambda params: params["means"].resize_(3, 3)),
        ("means", lambda params: operator.setitem(params, "means", 2 * params["means"])),
        ("means", lambda params: params.pop("means")), ("mine", lambda params: params.update(mine=torch.ones(8))),
    ],
)  # fmt: skip
def test_a_parameter_that_after_step_replaces_or_gives_other_memory_is_refused(name, change):
    made = Conductor(answering("after_step", lambda params, step: change(params))())
    with pytest.raises(AnswerError, match=rf"after_step\(\) must change {name} in place"):
        made.after_step({"means": torch.ones(8, 3)}, toy.step())


def test_after_step_may_write_params_name_times_equals_a_number():
    def halve(params, step):
        params["means"] *= 0.5

    means = torch.ones(8, 3)
    Conductor(answering("after_step", halve)()).after_step({"means": means}, toy.step())
    assert torch.equal(means, torch.full((8, 3), 0.5))


class OfOnesOwn(Strategy):
    def __init__(self):
        """That of the dataclass makes `state`."""


def test_a_strategy_without_state_is_refused_at_once():
    with pytest.raises(SettingError, match=r"made by the __init__ of their dataclass, .* got OfOnesOwn\(\)"):
        Conductor(OfOnesOwn())


@dataclass(frozen=True)
class Misspells(Strategy):
    """Beside a hook of the right name."""

    def gate(self, t, n):
        return None

    def regularise(self, params, t):
        return Grads({"means": params["means"]})

    def on_resized(self, parents):
        self.gates(1)

    def gates(self, t):
        """A helper of `gate`."""

    def weights(self):
        """A helper that resembles nothing."""


def test_a_strategy_without_a_hook_is_told_and_a_method_whose_name_is_nearly_that_of_one(caplog):
    Conductor(Misspells(), answering("weights", None)())
    assert sorted(r.getMessage() for r in caplog.records) == [
        "Mine implements no hook; it has no effect.",
        "Misspells.on_resized() is no hook: nothing calls it. There is on_resize().",
        "Misspells.regularise() is no hook: nothing calls it. There is regularize().",
    ]
    with pytest.raises(ContractError, match=r"Misspells.regularise\(\) is no hook"):
        check_strategy(Misspells)
    ours = [cls for cls in Strategy.__subclasses__() if cls.__module__.startswith("clear_strategies.")]
    assert {cls.__name__ for cls in ours} >= {"GCO", "P2G", "SVS", "PseudoViews", "MCMC"}
    assert not [cls for cls in ours if unused(cls)]


@dataclass(frozen=True)
class DecidesTwice(Strategy):
    def reconcile(self, products, step):
        return Weights(keep=0.5)

    def correct(self, lr, hr, step=None):
        return hr


@dataclass(frozen=True)
class DecidesByWeights(DecidesTwice):
    def reconcile(self, products, step):
        return Weights(keep=0.5)

    def correct(self, lr, hr, step=None):
        return super().correct(lr, hr, step)


def test_weights_that_a_correct_of_the_same_class_leaves_unused_are_told(caplog):
    Conductor(DecidesByWeights())
    assert not caplog.records
    Conductor(DecidesTwice())
    assert caplog.messages == [
        "DecidesTwice.correct() is called in place of DecidesTwice.reconcile(): keep one of them."
    ]


def test_a_strategy_takes_part_in_one_run_at_a_time_and_a_copy_in_none():
    first = given.conductor(lambda: SVS(anchor_start=1, anchor_strength=0.01))
    next(trace := given.trace(first, 1, given.STEPS))
    second = Conductor(*first.strategies)
    second.on_fit_start(1, 0)
    copies = [copy.deepcopy(second), pickle.loads(pickle.dumps(second))]  # noqa: S301 - our own bytes
    for stopped in (trace, *(given.trace(one, 1, given.STEPS) for one in copies)):
        with pytest.raises(StrategyConflict, match="begun anew for another one since, or are copies"):
            list(stopped)
    copies[1].on_fit_start(1, 0)
    assert list(given.trace(copies[1], 1, given.STEPS))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])  # noqa: S301 - our own bytes
def test_a_copy_of_a_conductor_keeps_its_prior_and_says_nothing_again(copied, caplog):
    """The trainer enlarges renders by the network of `sr`; views that a copy trains on may have been made before."""
    conductor = Conductor(Misspells(), decorators=(BackProjected,))
    conductor.prior(Bicubic())
    conductor.on_fit_start(1, 0)
    caplog.clear()
    copied = copied(conductor)
    assert (copied.decorated, type(copied.sr)) == (True, Bicubic)
    assert not caplog.records


@dataclass(frozen=True)
class LogsShare(Strategy):
    share: float

    def regularize(self, params, t):
        self.log("share", self.share)
        return {"means": self.share * params["means"]}


def test_what_two_strategies_of_one_class_log_and_add_is_both_there_until_the_next_iteration():
    conductor, params = Conductor(LogsShare(0.25), LogsShare(torch.tensor(0.5))), {"means": torch.tensor([[4.0, 0, 0]])}
    conductor.gate(1, 1)
    assert conductor.regularized(params, 1)["means"].tolist() == [[3, 0, 0]]
    conductor.logs.keep()
    assert not any(s.logs for s in conductor.strategies)
    assert computed(conductor.logs.scalars()) == {"share": 0.25, "LogsShare2.share": 0.5}
    with pytest.raises(AnswerError, match="a strategy logs 'share', a column that the row has already"):
        conductor.logs.scalars({"t", "share"})  # else it would take the place of a loss, say
    conductor.regularized(params, 1)
    conductor.gate(1, 1)
    assert conductor.logs.scalars()
    conductor.gate(2, 1)
    assert not conductor.logs.scalars()
    conductor.regularized(params, 2)
    conductor.logs.keep()
    conductor.on_fit_start(1, 0)  # another run, which begins with the iteration in which this one ended
    conductor.gate(2, 1)
    assert not conductor.logs.scalars()
    with pytest.raises(AnswerError, match=r"LogsShare.log\('share', …\) takes one number, got a tensor \[2\]"):
        LogsShare(torch.ones(2)).regularize({}, 1)


def test_the_contract_shows_poses_in_the_type_that_the_readers_give_them():
    """A strategy that multiplies its float32 means by the pose would end the first iteration of every run."""

    def by_distance(step):
        pose = step.view.hr.camera.world_to_camera
        return (step.params["means"] @ pose[:3, :3].T + pose[:3, 3])[:, 2].abs()

    with pytest.raises(RuntimeError, match="same dtype"):
        check_strategy(answering("route", by_distance))


def test_hooks_run_without_autograd_so_that_state_keeps_no_graph():
    """In another trainer the rendering that `observe` sees is a part of the graph, and autograd is off in its backward pass."""
    answers = {"gate": None, "observe": None, "route": 1.0, "reconcile": Weights(), "regularize": None, "score": None}
    answers |= {"extra_views": (), "after_step": None, "on_views": None, "on_resize": None}
    on = []

    def hook(name):
        def asked(self, *arguments):
            on.extend([name] * torch.is_grad_enabled())
            if name == "observe":
                self.state["seen"] = arguments[1].image.mean()
            return answers[name]

        return asked

    s = type("Asked", (Strategy,), {name: hook(name) for name in answers})()
    field, view = field_and_view(torch.float32)
    leaves = {name: p.requires_grad_() for name, p in field.raw().items()}
    shots = [shot_of(leaves, photo.camera) for photo in (view.lr, view.hr)]
    conductor = Conductor(s, objective=Objective(lambda_hr=ALWAYS))
    conductor.on_fit_start(1, 0, views=[view])
    conductor.gate(1, len(field))
    update = conductor.update(field.raw(), *shots, view, 1)
    conductor.extra_views(1)
    conductor.after_step(field.raw(), update.step)
    conductor.on_resize(torch.arange(len(field)))
    assert shots[1].image.requires_grad
    assert not s.state["seen"].requires_grad
    assert not on


class Swaps(Densifier):
    """Moves one Gaussian a step onto the last."""

    name, settings = "swaps", None

    def __init__(self, *faults):
        self.faults, self.count = faults, 0

    def step(self, field, optimizer, t, resized):
        self.count += 1
        parents = torch.arange(len(field))
        parents[torch.randint(3, (1,)) if "random" in self.faults else self.count] = len(field) - 1
        field.take(parents)
        if "optimizer" not in self.faults:
            optimizer.take(parents, parents == len(field) - 1)
        resized(torch.arange(len(field)) if "told" in self.faults else parents)
        field.means.data += 0.01  # as noise does
        field.sh0.data[-1] += 0.01  # as no other's
        return True

    def state_dict(self):
        return {} if "saved" in self.faults else {"count": torch.tensor(self.count)}

    def load_state_dict(self, tensors):
        self.count = int(tensors.get("count", 0))


def test_a_strategy_knows_its_run_whatever_it_does_to_its_cache():
    @dataclass(frozen=True)
    class Balanced(Strategy):
        """0.25 l + 0.5 h, whatever λ_HR."""

        def on_resize(self, parents):
            super().on_resize(parents)
            self.cache.clear()  # it held a row for each Gaussian

        def reconcile(self, products, step):
            λ = self.lambda_hr(step.t)
            return Weights(keep=0.5 / λ, remove=0.75 / λ)

    field, view = field_and_view(torch.float32)
    lr, hr = field.render_scales(toy.RASTERIZER, view)
    assert Balanced().lambda_hr(5) == 0
    objective = Objective(WarmupDecay(start=0, full=10, decay_from=10, end=10), lambda_hf=0.0, kernels="torch")
    (g_lr,) = lr.vjp(objective.lr(lr.image, view.lr.image).cotangents)
    (g_hr,) = hr.vjp(objective.hr(hr.image, view.hr.image).cotangents)
    for t in (2, 7):
        conductor = Conductor(balanced := Balanced(), objective=objective)
        conductor.on_fit_start(1, 7, "meta")
        conductor.on_resize(torch.arange(3))
        assert (balanced.seed, balanced.device.type) == (7, "meta")
        merged = conductor.update(field.raw(), lr, hr, view, t).grads
        assert torch.allclose(merged["means"], 0.25 * g_lr["means"] + 0.5 * g_hr["means"], atol=1e-7)
    inspect.unwrap(Conductor.on_fit_start)(conductor, 1, np.int64(7))  # which only tests refuse, by its type
    assert torch.equal(dropout_mask(9, 0.5, balanced.seed, 1), dropout_mask(9, 0.5, 7, 1))


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("told", "where it moves Gaussians.* row 1 is now a copy of row 29, so parents.1. is 29"),
        ("optimizer", "step must gather the optimizer as the field"),
        ("random", "two runs of a densifier with one seed differ"),
        ("saved", "cut before t=2: a densifier's state_dict.. does not continue"),
    ],
)
def test_the_contract_of_a_densifier(fault, message):
    (check,) = (c for c in CHECKS if c.__name__ == "check_densifier_takes_everything_along")
    check(answering("densifier", lambda field, views, seed: Swaps()))
    with pytest.raises((AnswerError, ContractError), match=message):
        check(answering("densifier", lambda field, views, seed: Swaps(fault)))


@pytest.mark.parametrize(
    ("where", "stored", "message"),
    [
        ("state", lambda p: {"x": torch.zeros(5)}, "'x'.* a tensor with a row for each Gaussian, 30, or without .*, got .* .5."),
        ("state", lambda p: {"x": 0.5}, "'x'.* a tensor with a row for each Gaussian, 30, or without .*, got 0.5"),
        ("state", lambda p: {"x": p}, "'x'.* a tensor of its own, got the memory of a parameter"),
        ("state", lambda p: {"x": p[:, 2]}, "'x'.* a tensor of its own, got the memory of a parameter"),
        ("run_state", lambda p: {"x": p[:2]}, "'x'.* a tensor of its own, got the memory of a parameter"),
        ("state", lambda p: {"x": torch.ones(1).expand(len(p))}, "'x'.* a tensor of its own, .* or of other rows"),
        ("run_state", lambda p: dict.fromkeys("xy", torch.zeros(2)), "'y'.* a tensor of its own, .*of another tensor"),
        ("run_state", lambda p: {3: torch.zeros(2)}, "3.* must have a text as its key, which is what checkpoints keep"),
        ("run_state", lambda p: {"x": 0.5}, "'x'.* must be a tensor that requires no gradient, got 0.5"),
        ("run_state", lambda p: {"x": p[:2].requires_grad_()}, "'x'.* must be a tensor that requires no gradient"),
        ("state", lambda p: {"x": p.to_sparse()}, "'x'.* must be a tensor .*, got a tensor .* convert it by to_dense"),
    ],
)  # fmt: skip
def test_what_a_checkpoint_could_not_give_back_is_refused(where, stored, message):
    strategy, params = Darker(), {"means": torch.zeros(30, 3)}
    getattr(strategy, where).update(stored(params["means"]))
    with pytest.raises(AnswerError, match=rf"^Darker.{where}\[{message}"):
        Conductor(strategy).after_step(params, toy.step())


def test_settings_of_taken_names_are_refused():
    type("Mine", (Strategy,), {"__annotations__": {"begin": int}})
    for taken in ("seed", "gate", "log"):  # a number in place of a hook could not be called
        with pytest.raises(TypeError, match=f"a setting must not be called {taken}"):
            type("Mine", (Strategy,), {"__annotations__": {taken: int}})


def field_and_view(dtype=torch.float64, degree=1):
    scene = toy.scene()
    field = GaussianField.from_cloud(scene.cloud)
    g = torch.Generator().manual_seed(3)
    for value in field.raw().values():
        value.add_(torch.randn(value.shape, generator=g), alpha=0.05)
    field.degree = degree
    field.update_filter([v.hr.camera for v in scene.train], 0.2)
    view = scene.train[1]
    lr, hr = (Photo(photo.camera, photo.image.to(dtype)) for photo in (view.lr, view.hr))
    return field.to(dtype), replace(view, lr=lr, hr=hr)


@pytest.fixture(scope="module")
def drawn():
    """A field, a view, and both scales of it."""
    field, view = field_and_view()
    return field, view, *field.render_scales(toy.RASTERIZER, view)


@pytest.mark.parametrize("dtype", [torch.bool, torch.int32, torch.float64])
@pytest.mark.parametrize("hook", ["correct", "regularize", "score"])
def test_an_answer_of_another_type_counts_as_its_numbers(hook, dtype):
    """A kernel of float32 would read other memory than that of the answer."""
    field, view = field_and_view(torch.float32)
    of_float32 = field, view, *field.render_scales(toy.RASTERIZER, view)

    def positive(form):
        def each(gradients):
            return {name: form(g > 0) for name, g in gradients.items()}

        answers = {
            "correct": lambda lr, hr, step: each(hr), "regularize": lambda params, t: each(params),
            "score": lambda step, screen: form(screen.ordinary > screen.ordinary.median()),
        }  # fmt: skip
        return updated(of_float32, answering(hook, answers[hook])())

    found, expected = positive(lambda x: x.to(dtype)), positive(Tensor.float)
    assert not [name for name, g in expected.grads.items() if not torch.equal(found.grads[name], g)]
    assert found.score.dtype == torch.float32
    assert torch.equal(found.score, expected.score)


def test_half_precision_loses_no_small_number_of_an_answer():
    """A host's gradients are merged in float32."""
    pull, out = torch.full((4, 3), 1e-8), {"means": torch.empty(4, 3)}
    made, none = Conductor(answering("regularize", {"means": pull})()), Grads({"means": torch.zeros(4, 3)})
    made.merge({"means": torch.zeros(4, 3, dtype=torch.float16)}, none, Grads(), None, 1, out)
    assert torch.equal(out["means"], pull)


def test_a_comparison_that_leaves_out_a_loss_keeps_its_value(drawn):
    made = answering("compare", lambda scale, image, photo, step, losses: losses(image)._replace(values={"mine": 1.0}))
    assert updated(drawn, made()).losses.keys() == {"lr", "base", "hf", "mine"}


def test_a_shot_of_ones_own_need_not_sum(drawn):
    field, view, lr, hr = drawn
    mine = type("Mine", (SimpleNamespace,), {"vjp": lambda self, cotangents: hr.vjp(cotangents)})
    shot = mine(image=hr.image, means2d=hr.means2d, visible=hr.visible)
    found, expected = (updated((field, view, lr, x), P2G()).grads for x in (shot, hr))
    assert found.keys() == expected.keys()
    for name, g in expected.items():
        torch.testing.assert_close(found[name], g, rtol=1e-4, atol=1e-8, msg=name)


def updated(drawn, *strategies, **objective):
    field, view, lr, hr = drawn
    return Conductor(*strategies, objective=Objective(lambda_hr=ALWAYS, **objective)).update(
        field.raw(), lr, hr, view, 5
    )


def autograd_of_the_summed_loss(field: GaussianField, view, objective: Objective, λ: float) -> Grads:
    """The same loss, told to autograd: every step from raw parameters to images by torch's own derivatives."""
    raw = {name: value.clone().requires_grad_() for name, value in field.raw().items()}
    scales = torch.hypot(raw["scales"].exp(), field.filter_3d[:, None])
    opacities = raw["opacities"].sigmoid() * (raw["scales"].exp() / scales).prod(-1)
    bands = (field.degree + 1) ** 2 - 1

    def draw(camera, *inputs):
        return autograd.draw(toy.RASTERIZER, Splats(*inputs), camera).image

    class Loss(torch.autograd.Function):
        @staticmethod
        def forward(ctx, kernel, x, y):
            value, ctx.gradient = kernel(x, y)
            return value

        @staticmethod
        def backward(ctx, cotangent):
            return None, cotangent * ctx.gradient, None

    def photometric(x: Tensor, y: Tensor) -> Tensor:
        return 0.8 * Loss.apply(reference.l1, x, y) + 0.2 * (1 - Loss.apply(reference.ssim, x, y))

    common = (raw["means"], raw["quats"], scales, opacities, raw["sh0"], raw["shN"][:, :bands])
    zero = torch.zeros_like(raw["detail"])
    hr = draw(view.hr.camera, *common, raw["detail"])
    if objective.lr_from == "hr":
        lr = torch.nn.functional.avg_pool2d(hr.permute(2, 0, 1), view.factor).permute(1, 2, 0)
    else:
        lr = draw(view.lr.camera, *common, zero)
    loss = objective.lambda_lr * photometric(lr, view.lr.image.double()) + λ * (
        photometric(hr, view.hr.image.double())
        + objective.lambda_hf * Loss.apply(reference.haar_l1, hr, view.hr.image.double())
    )
    gradients = torch.autograd.grad(loss, list(raw.values()))
    return Grads(dict(zip(raw, gradients, strict=True)))


@pytest.mark.parametrize("lr_from", ["lr", "hr"])
@pytest.mark.parametrize(("hf", "lambda_lr"), [(0.2, 1.0), (0.0, 1.0), (0.2, 0.6), (0.0, 0.0)])
def test_without_strategies_it_is_autograd_of_the_summed_loss(hf, lambda_lr, lr_from):
    field, view = field_and_view()
    objective = Objective(lambda_hr=ALWAYS, lambda_hf=hf, lambda_lr=lambda_lr, lr_from=lr_from)
    conductor = Conductor(objective=objective)
    lr, hr = field.render_scales(toy.RASTERIZER, view, lr=conductor.wants_lr, hr=conductor.wants_hr(5))
    assert (lr is None) == (lr_from == "hr" or lambda_lr == 0)
    result = conductor.update(field.raw(), lr, hr, view, 5).grads
    expected = autograd_of_the_summed_loss(field, view, objective, 1.0)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        scale = float(expected[name].abs().max())
        assert torch.allclose(result[name], expected[name], atol=1e-9 * scale, rtol=1e-7), name


def test_a_reduced_lr_image_counts_for_densification_in_ndc_as_a_drawn_one_does(drawn):
    """∇_u in NDC does not depend on the pixels that it was pulled through: two routes to one blurred picture agree."""
    field, view, lr, hr = drawn
    seen = {}
    for lr_from in ("lr", "hr"):
        conductor = Conductor(objective=Objective(lambda_hr=WarmupDecay(peak=0, final=0), lr_from=lr_from))
        seen[lr_from] = conductor.update(field.raw(), lr, hr, view, 5).ordinary
    ratio = seen["hr"].sum() / seen["lr"].sum()
    assert 0.5 < float(ratio) < 2  # in pixels of their own image it would be 4 times off


def test_without_lr_photos_only_the_reference_moves_gaussians(drawn):
    field, view, _, hr = drawn
    update = updated((field, view, None, hr), lambda_hf=0.0, lambda_lr=0.0)
    (g_base,) = hr.vjp(Objective(lambda_hr=ALWAYS, lambda_hf=0.0).hr(hr.image, view.hr.image).cotangents)
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        assert torch.allclose(update.grads[name], g_base[name], rtol=1e-12, atol=0)
    assert update.losses["lr"] > 0  # measured, for the log


def test_cotangents_take_the_memory_of_earlier_ones_of_their_shape_alone(drawn):
    _, view, _, hr = drawn
    objective = Objective(lambda_hr=ALWAYS)
    fresh = objective.hr(hr.image, view.hr.image).cotangents
    for held, reused in ((torch.full_like(fresh, torch.nan), True), (fresh[:1].float(), False)):
        again = objective.hr(hr.image, view.hr.image, reuse=held).cotangents
        assert torch.equal(again, fresh)
        assert (again.data_ptr() == held.data_ptr()) == reused


def test_an_objective_of_ones_own_gives_a_cotangent_for_each_loss(drawn):
    class Third(Objective):
        def hr(self, image, target, shown=None, reuse=None):
            losses = super().hr(image, target, shown, reuse)
            return losses._replace(cotangents=torch.cat((losses.cotangents, losses.cotangents[:1])))

    field, view, lr, hr = drawn
    for hf, rule in ((0.2, "2 cotangents, of L_base and of L_HF, got 3"), (0.0, "1 cotangents, of L_base, got 2")):
        with pytest.raises(ValueError, match=rf"Third.hr\(\) must give {rule}"):
            Conductor(objective=Third(lambda_hr=ALWAYS, lambda_hf=hf)).update(field.raw(), lr, hr, view, 5)


def test_a_scale_that_the_objective_needs_is_asked_for_and_hr_only_while_it_has_a_use(drawn):
    field, view, lr, hr = drawn
    with pytest.raises(ValueError, match="needs the HR scale"):
        Conductor(objective=Objective(lr_from="hr")).update(field.raw(), lr, None, view, 5)
    with pytest.raises(ValueError, match="needs the LR scale"):
        Conductor().update(field.raw(), None, hr, view, 5)
    facts = {name: getattr(lr, name) for name in ("image", "means2d", "visible")}
    with pytest.raises(ValueError, match=r"must set .screen on every Grads"):
        Conductor().update(field.raw(), SimpleNamespace(**facts, vjp=lambda c: [*map(Grads, lr.vjp(c))]), None, view, 5)
    with pytest.raises(ValueError, match="L_base must act from the first iteration"):
        Objective(lambda_lr=0.0)
    objective = Objective(lambda_hr=WarmupDecay(start=10, full=20, decay_from=30, end=40))
    plain = Conductor(objective=objective, statistics_from=5)
    assert [plain.wants_hr(t) for t in (5, 6, 10, 11)] == [False, False, False, True]
    assert plain.work_log.entries["render LR + HR"].skipped == {"lambda_HR = 0": 3}
    scoring = Conductor(P2G(), objective=objective, statistics_from=5)
    assert [scoring.wants_hr(t) for t in (5, 6, 10, 11)] == [False, True, True, True]
    never = Conductor(objective=Objective(lambda_hr=WarmupDecay(peak=0, final=0)))
    assert not any(never.wants_hr(t) for t in range(0, 10_000, 100))
    assert [c.uses_hr for c in (plain, scoring, never)] == [True, True, False]
    late = Conductor(objective=Objective(lambda_hr=WarmupDecay(peak=0, final=1)), statistics_from=5)
    assert [c.hr_from() for c in (plain, scoring, late, never)] == [10, 5, 5_000, None]
    assert scoring.hr_from(scored=False) == 10
    assert [scoring.wants_hr(t, scored=False) for t in (6, 10, 11)] == [False, False, True]
    assert all(
        Conductor(*s, objective=replace(never.objective, lr_from=f)).uses_hr for s, f in [([P2G()], "lr"), ([], "hr")]
    )


def test_routing_weighs_the_high_frequency_gradient_only(drawn):
    """By which alone the detail feature moves."""
    field, view, lr, hr = drawn
    objective, p2g = Objective(lambda_hr=ALWAYS), P2G()
    update = updated(drawn, p2g)
    assert torch.equal(update.step.params["means"], field.raw()["means"])
    (g_lr,) = lr.vjp(objective.lr(lr.image, view.lr.image).cotangents)
    g_base, g_hf = hr.vjp(objective.hr(hr.image, view.hr.image).cotangents)
    m = p2g.route(update.step)[:, None]
    expected = g_lr["means"] + g_base["means"] + 0.2 * m * g_hf["means"]
    assert torch.allclose(update.grads["means"], expected, rtol=1e-6, atol=1e-15)
    for strategies in ((p2g,), (GCO(), p2g)):
        moved = updated(drawn, *strategies).grads["detail"]
        assert torch.allclose(moved, 0.2 * m * g_hf["detail"], rtol=1e-6, atol=1e-15)
    assert "detail" not in updated(drawn, lambda_hf=0.0).grads


def test_one_route_for_all_gaussians_is_that_of_each(drawn):
    one, each = (answering("route", m)() for m in (0.25, torch.full((len(drawn[0]),), 0.25)))
    g, same, whole = (updated(drawn, *strategies).grads for strategies in ([one], [each], []))
    for name in g:
        assert torch.equal(g[name], same[name])
        assert not torch.equal(g[name], whole[name])


def test_two_owners_of_one_question_are_refused_and_the_order_does_not_matter(drawn):
    with pytest.raises(StrategyConflict, match=r"GCO and Halve both implement reconcile\(\) or correct\(\)"):
        Conductor(GCO(), Halve())
    one, other = (updated(drawn, *s).grads for s in ((GCO(), P2G(), SVS()), (SVS(), P2G(), GCO())))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_conflict_is_measured_before_correction_and_what_was_logged_belongs_to_its_iteration(drawn):
    plain, corrected = (updated(drawn, *strategies).conflict for strategies in ((), (GCO(),)))
    assert plain == corrected
    assert set(plain) == {"means", "sh0", "shN", "opacities", "scales", "quats", "gaussian"}
    assert 0 < max(plain.values()) < 1
    field, view, lr, hr = drawn
    conductor = Conductor(P2G(), objective=Objective(lambda_hr=ALWAYS))
    conductor.update(field.raw(), lr, hr, view, 5)
    assert {"mean_q", "mean_w"} <= conductor.logs.scalars().keys()
    conductor.update(field.raw(), lr, None, view, 6)
    assert not conductor.logs.scalars()
    assert conductor.work_log.entries["backward HR"].skipped == {"HR was not drawn": 1}


def test_two_strategies_of_one_class_keep_their_states_apart():
    first, second = (Conductor(LogsShare(1.0), LogsShare(2.0)) for _ in range(2))
    for s in first.strategies:
        s.state["kept"] = torch.full((3,), s.share)
    second.load_state_dict(first.state_dict())
    assert [s.state["kept"][0].item() for s in second.strategies] == [1.0, 2.0]


def test_comparisons_change_the_image_and_add_losses_each_around_the_next(drawn):
    """As one objective of both would: what comes first sees the render, and what follows sees what that passes on."""
    _, view, lr, hr = drawn
    plain, darker, outside, inside = (
        updated(drawn, *strategies)
        for strategies in ((), (Darker(),), (Brightness(), Darker()), (Darker(), Brightness()))
    )
    dark = Objective(lambda_hr=ALWAYS).lr(lr.image * 0.5, view.lr.image)
    assert darker.losses["lr"] == pytest.approx(dark.values["lr"])
    torch.testing.assert_close(darker.cotangents_lr, dark.cotangents * 0.5)
    assert plain.losses["lr"] != darker.losses["lr"] == outside.losses["lr"] == inside.losses["lr"]
    for found, seen in ((outside, 1.0), (inside, 0.5)):
        for scale, shot in (("lr", lr), ("hr", hr)):
            assert found.losses[f"mean_{scale}"] == pytest.approx(seen * float(shot.image.mean()), rel=1e-5)
        torch.testing.assert_close(found.cotangents_lr, darker.cotangents_lr + seen / lr.image.numel())
        assert not torch.equal(found.grads["means"], darker.grads["means"])


def test_an_error_for_want_of_autograd_says_how_to_turn_it_on(drawn):
    def regularize(params, t):
        return {"scales": torch.autograd.grad(params["scales"].exp().sum(), params["scales"])[0]}

    with pytest.raises(RuntimeError, match="does not require grad") as told:
        updated(drawn, answering("regularize", regularize)())
    (note,) = told.value.__notes__
    assert "compute under torch.enable_grad()" in note


def test_cotangents_that_a_strategy_stores_are_its_own(drawn):
    field, view, lr, hr = drawn
    stored = []

    def compare(scale, image, photo, step, losses):
        found = losses(image)
        stored.append(2 * found.cotangents.mT.contiguous().mT)
        return found._replace(cotangents=stored[-1])

    conductor = Conductor(answering("compare", compare)(), objective=Objective(lambda_hr=ALWAYS))
    for t in (1, 2):
        conductor.update(field.raw(), lr, hr, view, t)
    assert torch.equal(stored[1], stored[3])


def test_a_comparison_must_pass_on_the_losses_of_one_image(drawn):
    def not_finite(scale, image, photo, step, losses):
        found = losses(image)
        found.cotangents[0, 3, 2] = float("nan")
        return found

    twice = "must call losses.image. once, but calls it again"
    faults = {
        "must give the Losses that losses": lambda scale, image, photo, step, losses: losses(image).values,
        "must give the Losses": lambda scale, image, photo, step, losses: None,
        twice: lambda scale, image, photo, step, losses: losses(image) and losses(image),
        "must give Losses whose cotangents are a tensor": lambda scale, image, photo, step, losses: losses(
            image
        )._replace(cotangents=torch.zeros(3, *image.shape)),
        "must give finite cotangents, but at LR its gradient of the image is not finite at 1 pixel, first": not_finite,
    }
    for message, compare in faults.items():
        with pytest.raises(AnswerError, match=rf"compare\(\) {message}"):
            updated(drawn, answering("compare", compare)())


def test_tensors_of_the_run_have_any_shape_stay_when_the_structure_changes_and_are_given_back():
    first, second = Conductor(Darker()), Conductor(Darker())
    kept = first.strategies[0].run_state["gain"] = torch.rand(5, 3)
    first.strategies[0].run_state.update(none=torch.zeros(0), nothing=torch.zeros(0, 3))
    first.on_resize(torch.arange(2))
    first.after_step({"means": torch.zeros(30, 3)}, toy.step())
    second.strategies[0].state["of another"] = second.strategies[0].run_state["of another"] = torch.zeros(2)
    second.load_state_dict(first.state_dict())
    assert torch.equal(second.strategies[0].run_state["gain"], kept)
    assert not second.strategies[0].state
    assert "of another" not in second.strategies[0].run_state
    first.on_fit_start(1, 0)
    assert not first.strategies[0].run_state


def test_a_strategy_draws_raw_parameters_as_the_run_does_and_gets_their_gradients():
    """Also after a checkpoint, which brings another field."""
    strategy = Darker()
    state = short_run.start((), more=[strategy])
    for _ in range(4):
        loop.iterate(state, toy.RASTERIZER)
    resumed = short_run.start((), more=[other := Darker()])
    resumed.restore(state.checkpoint({}), Path("checkpoint"))
    shot = state.field.shot(toy.RASTERIZER, view := state.views[0].lr.camera)
    assert state.field.filter_3d.min() > 0
    for s in (strategy, other):
        leaves = {name: p.clone().requires_grad_() for name, p in state.field.raw().items()}
        found = autograd.draw(toy.RASTERIZER, s.splats(leaves), view)
        torch.testing.assert_close(found.image, shot.image)
        cotangent = torch.rand(shot.image.shape, generator=torch.Generator().manual_seed(0))
        (expected,) = shot.vjp(cotangent[None])
        names = [name for name in leaves if name != "detail"]
        gradients = torch.autograd.grad(found.image, [leaves[name] for name in names], cotangent)
        for name, gradient in zip(names, gradients, strict=True):
            torch.testing.assert_close(gradient, expected[name], rtol=1e-4, atol=1e-6)
    state.conductor.on_fit_end()
    assert not state.conductor.views
    leaves = state.field.raw()
    Conductor(in_host := Darker()).on_fit_start(1, 0)
    for s in (strategy, in_host):  # without the field, whose memory is free
        splats = s.splats(leaves)
        assert torch.equal(splats.scales, leaves["scales"].exp())
        assert torch.equal(splats.opacities, leaves["opacities"].sigmoid())
