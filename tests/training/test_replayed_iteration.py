"""Replayed iterations: the bits of the live ones, and every reason to be live."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import clear_strategies as cs
import rasterizers
from clear_strategies.core import work_log
from clear_strategies.core.step import Step
from clear_strategies.core.view import Photo, View
from clear_strategies.data.scene import Scene
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.density.mcmc import MCMC
from clear_strategies.merging import replay
from clear_strategies.merging.replay import LIVE, _stored_by
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.training import checkpoint, loop
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import LearningRates
from clear_strategies.training.replayed_iteration import replayed, replays_for
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers import replays
from rasterizers.recording import Recording, running
from rasterizers.replays import ReplayKey, Replays, shapes_of
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.short_run import SCENE, tensors, with_depth
from tests.training.test_resume import without_time

pytestmark = needs("warp")
ROUND = 12  # iterations between changes of the structure
FIRST = "the first of its kind"
FAILED = "a recording failed"


@pytest.fixture(autouse=True)
def device(recorded_on, monkeypatch) -> None:
    """Live iterations, too, run as on CUDA."""
    monkeypatch.setattr("tests.training.test_replayed_iteration.DEVICE", recorded_on)


DEVICE = torch.device("cpu")


def start(
    *more: cs.Strategy, iterations: int = 120, density: bool = True, scene: Scene = SCENE, rises_at: int | None = None,
    degree_every: int = 36, scores_from: int = 1, reconciles: cs.Strategy | None = None, **of_svs: Any,
) -> TrainState:  # fmt: skip
    """A training of everything that `best` is made of, over which λ_HR rises and falls, and with an anchor."""
    from clear_strategies.kernels.gaussian_step.warp import WarpGaussianStep

    if rises_at is None:
        rises_at = 10 if density else 1  # HR takes part from the second iteration on, by its score or by its gradient
    objective = cs.Objective(
        lambda_hr=WarmupDecay(final=0.1, start=rises_at, full=30, decay_from=96, end=120), kernels="warp"
    )
    defaults = {"dropout": Ramp(full=48), "anchor_start": 72, "anchor_weights": {"means": 1.0}}
    svs = cs.SVS(looks=0, anchor_strength=0.01, **(defaults | of_svs))
    conductor = cs.Conductor(reconciles or cs.GCO(), cs.P2G(), svs, *more, objective=objective, statistics_from=1)
    state = TrainState.start(
        with_depth(scene).to(DEVICE), conductor,
        settings=FitSettings(iterations=iterations, scale_schedule=False, degree_every=degree_every, seed=5),
        density=DensitySettings(
            start=1, stop=72 if density else 2, statistics_from=scores_from, every=ROUND, reset_every=30, threshold=1e-5,
            max_gaussians=80,
        ),
        rates=LearningRates(means=LogLinear(end=120), detail_decay=0.01, cool_from=108, end=120),
        mip=MipFilter(every=15, last=1),
    )  # fmt: skip
    state.compiled_step = CompiledStep(conductor, state.optimizer, passes=WarpGaussianStep)
    return state


def trained(state: TrainState, *, replayed: bool, until: int) -> TrainState:
    rasterizer = rasterizers.load("warp", device=DEVICE.type)
    if replayed and state.replays is None:
        state.replays = replays_for(state, rasterizer)
    while state.t <= until:
        loop.iterate(state, rasterizer)
    return state


def both(make: Callable[[], TrainState], until: int) -> TrainState:
    """The replayed training, after a comparison with the live one."""
    live, replayed = (trained(make(), replayed=r, until=until) for r in (False, True))
    require_same(replayed, live)
    assert live.conductor.work_log.state_dict().keys().isdisjoint({"replayed", LIVE})
    return replayed


def require_same(found: TrainState, expected: TrainState) -> None:
    of_both = tensors(found), tensors(expected)
    assert of_both[0].keys() == of_both[1].keys()
    assert not [name for name, x in of_both[0].items() if not torch.equal(x, of_both[1][name])]
    assert without_time(found.history_as_floats()) == without_time(expected.history_as_floats())
    assert skipped(found) == skipped(expected)


def skipped(state: TrainState) -> dict[str, dict[str, int]]:
    entries = state.conductor.work_log.entries.items()
    return {stage: entry.skipped for stage, entry in entries if entry.skipped and stage != LIVE}


def replays_of(state: TrainState) -> int:
    return state.conductor.work_log.entries["replayed"].runs


def live_in(state: TrainState) -> dict[str, int]:
    return state.conductor.work_log.entries[LIVE].skipped


@pytest.mark.slow
@pytest.mark.parametrize(("moves", "until", "replays"), [("density", 120, 100), ("mcmc", 78, 50)])
def test_a_whole_training_of_replays_has_the_bits_of_a_live_one(moves, until, replays):
    """Of MCMC until after its last move; what comes later is the same in both."""

    def best():
        more = [cs.PseudoViews(count=8, reach=0.1), cs.FadingOpacity(rate=0.002), cs.RandomBackground(until=1_350)]
        return start(*more, *([MCMC(start=ROUND, stop=72, every=ROUND, per_point=3.0)] if moves == "mcmc" else []))

    replayed = both(best, until)
    assert replays_of(replayed) > replays  # of as many views as iterations, and half as many extra views
    assert len(replayed.field) > 12
    assert live_in(replayed).keys() <= {FIRST, "the recorded lists of pairs are too short"}


def test_replays_have_the_bits_of_live_iterations_also_after_resuming(tmp_path):
    replayed = both(lambda: start(density=False), 12)
    # Nothing is dropped at t=1, t=2 is live, and t=3 is recorded.
    assert (replays_of(replayed), live_in(replayed)) == (12 - 3, {FIRST: 2})
    path = checkpoint.save(tmp_path, replayed.checkpoint({}))
    resumed, live = start(density=False), trained(start(density=False), replayed=False, until=20)
    resumed.restore(checkpoint.load(path), path)
    require_same(trained(resumed, replayed=True, until=20), live)


def cropped(view: View, columns: int) -> View:
    """The view without its last LR columns."""

    def cut(photo, n):
        width = photo.camera.width - n
        return replace(photo, camera=replace(photo.camera, width=width), image=photo.image[:, :width].contiguous())

    return replace(view, lr=cut(view.lr, columns), hr=cut(view.hr, columns * view.factor), truth=None)


def masked(view: View, rows: int) -> View:
    """The view without its first LR rows; without a mask for 0."""
    if not rows:
        return view
    shown = torch.ones(view.lr.image.shape[:2], dtype=torch.bool)
    shown[:rows] = False
    return view.hiding(shown)


@dataclass(frozen=True)
class Late(Ramp):
    """Dropout that begins at t=6."""

    def __call__(self, t: int) -> float:
        return 0.2 if t >= 6 else 0.0


@dataclass(frozen=True)
class Pulls(cs.Strategy):
    """Moves all bands in iterations from `first` to `last`, with nothing stored that tells."""

    first: int
    last: int

    def regularize(self, params, t):
        return cs.Grads({"shN": 1e-3 * (1 + params["shN"])}) if self.first <= t <= self.last else None


@dataclass(frozen=True)
class ByTime(cs.Strategy):
    """Decides by what is another one in a replay."""

    reads: str = "t"

    def reconcile(self, products, step):
        t = step.t
        keep = {
            "a milestone": lambda: 0.5 if t > 8 else 1.0, "periods": lambda: 0.5 if -(-t // 5) >= 2 else 1.0,
            "every second": lambda: 0.5 if t % 2 else 1.0, "a number": lambda: 1 / float(t),
            "the name": lambda: 0.5 if step.view.name.endswith("1") else 1.0,
        }  # fmt: skip
        return cs.Weights(keep=keep[self.reads]() if self.reads in keep else 1.0)

    def regularize(self, params, t):
        return cs.Grads({"means": params["means"] / t}) if self.reads == "an anchor" else None


@dataclass(frozen=True)
class ByMemory(cs.Strategy):
    """Decides by what it has stored beside its state."""

    stores: str = "a count"

    def reconcile(self, products, step):
        last, q = self.cache.get("last"), step.evidence.reliability
        if self.stores == "a count":
            self.cache["count"] = self.cache.get("count", 0) + 1
            return cs.Weights(keep=0.5 if self.cache["count"] % 4 == 0 else 1.0)
        if self.stores == "what it was given":
            self.cache["last"] = q
            return cs.Weights() if last is None else cs.Weights(keep=(1 + last - q).clamp(0, 1))
        return cs.Weights(keep=self.cache.get("weight", 1.0))

    def after_step(self, params, step):
        if self.stores == "a number after the step":
            self.cache["weight"] = 1 / (1 + step.t // 5)


@dataclass(frozen=True)
class ByMean(cs.Strategy):
    """Keeps of HR what a running mean says, a number of the run."""

    in_place: bool = True

    def on_fit_start(self, n_views, seed):
        self.state["mean"] = torch.ones(())

    def reconcile(self, products, step):
        return cs.Weights(keep=self.state["mean"].double())

    def after_step(self, params, step):
        if step.evidence is not None:
            mean = 0.9 * self.state["mean"] + 0.1 * step.evidence.reliability.mean()
            self.state["mean"] = self.state["mean"].copy_(mean) if self.in_place else mean


@dataclass(frozen=True)
class Remembers(cs.Strategy):
    """Moves opacities by how the evidence has changed since the last iteration, whose tensors it has stored."""

    def after_step(self, params, step):
        if (last := self.cache.get("last")) is not None:
            change = step.evidence.reliability - last.evidence.reliability
            params["opacities"].add_(0.1 * change + 0.1 * (step.visible ^ last.visible))
        self.cache["last"] = None if step.evidence is None else step


def fixed(*more: cs.Strategy, **settings: Any) -> Callable[[], TrainState]:
    """A training without density control."""
    return lambda: start(*more, density=False, **settings)


def by(strategy: cs.Strategy) -> Callable[[], TrainState]:
    """A training that this strategy reconciles from the second iteration on."""
    return fixed(reconciles=strategy, rises_at=2)


OF_TWO_SIZES = replace(SCENE, train=tuple(cropped(v, 2 * (k == 1)) for k, v in enumerate(SCENE.train)))
MASKED = replace(SCENE, train=tuple(masked(v, 3 * k) for k, v in enumerate(SCENE.train)))
BESIDE = cs.PseudoViews(count=8, reach=0.1)
KINDS = {
    "masks": (fixed(scene=MASKED), 14),
    "size of the photos": (fixed(scene=OF_TWO_SIZES), 14),
    "robust": (fixed(toy.Shows(lambda views, t: [toy.again(views[0].lr, robust=t % 3 == 0)])), 14),
    "degree": (fixed(degree_every=5), 14),
    "background": (fixed(cs.RandomBackground(until=1_350), cs.FadingOpacity(rate=0.002)), 14),
    "dropout": (fixed(dropout=Late()), 14),
    "λ_HR > 0": (fixed(rises_at=6), 14),
    "scores are collected": (lambda: start(scores_from=6), 14),
    "bands that an extra view moves": (fixed(Pulls(8, 99), BESIDE), 14),
    "bands that have momentum when a photo of another size comes": (fixed(Pulls(9, 9), scene=OF_TWO_SIZES), 18),
    "an anchor, and an extra view": (fixed(BESIDE, anchor_start=5, anchor_weights=cs.SVS().anchor_weights), 16),
    **{f"GCO {settings}": (by(cs.GCO(**settings)), 12) for settings in (
        {"groups": ("means", "sh0")}, {"whole": True}, {"drop": True}
    )},
    "a milestone": (by(ByTime("a milestone")), 14),
    "periods": (by(ByTime("periods")), 14),
    "a number after the step": (by(ByMemory("a number after the step")), 16),
    "a number of the run that is written in place": (by(ByMean()), 12),
    "what a strategy keeps of an iteration": (fixed(Remembers(), rises_at=2), 12),
}  # fmt: skip


@pytest.mark.parametrize("differs", KINDS)
def test_what_differs_between_iterations_is_copied_or_decides_which_recording_is_replayed(differs):
    make, until = KINDS[differs]
    replayed = both(make, until)
    assert replays_of(replayed) >= 7
    assert live_in(replayed).keys() == {FIRST}


@pytest.mark.parametrize("reads", ["every second", "a number", "the name", "an anchor"])
def test_a_strategy_that_reads_the_iteration_or_the_view_is_live(reads, caplog):
    """tests/rasterizers/test_guards.py has more ways to read them."""
    replayed = both(by(ByTime(reads)), 16)
    assert live_in(replayed)[FAILED] >= 2
    assert "must not read the" in caplog.text or "decides by the iteration" in caplog.text


def test_of_a_view_a_strategy_may_read_in_a_recording_what_every_replay_copies(monkeypatch):
    """The images, unless a background that changes shows through them."""

    def transparent(photo: Photo) -> Photo:
        return replace(photo, transparency=1 - photo.image.mean(dim=2))

    monkeypatch.setattr("clear_strategies.merging.conductor.running", lambda: SimpleNamespace(guards=[]))
    monkeypatch.setattr("rasterizers.guards.running", lambda: SimpleNamespace(guards=[]))
    view = with_depth(SCENE).train[0]
    step = Step(3, replace(view, lr=transparent(view.lr), disagreement=torch.zeros_like(view.lr.image)))
    changing, plain = (cs.Conductor(*s)._told(step).view for s in ([cs.RandomBackground()], []))
    refused = {
        "name": lambda v: v.name[0], "sr_source": lambda v: v.sr_source == "made", "camera": lambda v: v.hr.camera.cx,
        "depth": lambda v: v.depth.confidence, "disagreement": lambda v: v.disagreement.mean(),
        "truth": lambda v: v.truth.mean(), "transparency": lambda v: v.lr.transparency.mean(),
    }  # fmt: skip
    for what, read in refused.items():
        for shown in (changing, plain):
            with pytest.raises(RuntimeError, match=f"must not read the {what} of the view"):
                read(shown)
    with pytest.raises(RuntimeError, match="must not read the transparent image of the view"):
        changing.lr.image.mean()
    assert torch.equal(plain.lr.image, step.view.lr.image)
    assert torch.equal(changing.hr.image, view.hr.image)
    assert (changing.lr.image.shape, changing.lr.camera.width) == (view.lr.image.shape, view.lr.camera.width)


@pytest.mark.parametrize("stores", ["a count", "what it was given"])
def test_what_a_strategy_decides_by_what_it_stores_in_python_is_live(stores, caplog):
    both(by(ByMemory(stores)), 16)
    require_one_line(caplog, 13)
    assert "by what it stores" in caplog.text


def test_a_number_of_the_run_that_is_another_tensor_each_time_is_live():
    assert "replayed" not in both(by(ByMean(in_place=False)), 12).conductor.work_log.entries


@pytest.mark.parametrize(
    ("stores", "changes"),
    [
        (lambda s: s.cache.setdefault("list", []), lambda x: x.append(1)),
        (lambda s: s.cache.setdefault("own", SimpleNamespace(count=0)), lambda x: setattr(x, "count", 1)),
        (lambda s: s.cache.setdefault("of tensors", [torch.ones(3)]), lambda x: x.__setitem__(0, torch.ones(3))),
        (lambda s: s.state["mean"], lambda x: x.mul_(0.5)),
    ],
    ids=["a list", "an attribute of its own class", "a new tensor", "a number of the run that the host reads"],
)
def test_what_a_strategy_stores_in_python_is_compared_by_what_it_holds(stores, changes, monkeypatch):
    monkeypatch.setattr(replay, "can_record", lambda device: False)
    strategy = ByMean()
    strategy.on_fit_start(1, 0)
    stored = stores(strategy)
    before = _stored_by(strategy)
    assert _stored_by(strategy) == before
    changes(stored)
    assert _stored_by(strategy) != before


def test_stages_are_timed_by_events_and_none_in_a_recording(monkeypatch):
    monkeypatch.setattr(work_log, "_BATCH", 2)
    state = start(cs.PseudoViews(count=8, reach=0.1), density=False)
    state.conductor.work_log.device = torch.device("cuda")
    entries = trained(state, replayed=True, until=8).conductor.work_log.entries
    assert live_in(state).keys() == {FIRST}
    assert all(entries[name].seconds > 0 for name in ("replayed", "render LR", "density and filter"))


def test_replays_are_counted_in_the_work_log_that_the_conductor_has_by_then():
    """As in `bench iteration`, where each turn has one of its own."""
    state = trained(start(density=False), replayed=True, until=8)
    state.conductor.work_log = work_log.WorkLog(DEVICE)
    assert replays_of(trained(state, replayed=True, until=12)) == 4


def test_where_lists_are_too_short_the_iteration_is_live_and_recorded_anew():
    live, replayed = start(density=False), start(density=False)
    for state in (live, replayed):
        state.field.scales.data -= 3.0
        trained(state, replayed=state is replayed, until=8)
        state.field.scales.data += 3.0
        trained(state, replayed=state is replayed, until=12)
    require_same(replayed, live)
    assert replays_of(replayed) == 5 + 1 + 2  # t=9 ends at the count, and t=10 is recorded
    assert live_in(replayed) == {FIRST: 2, "the recorded lists of pairs are too short": 1}


def test_kinds_beyond_the_most_are_live_and_counted(monkeypatch):
    monkeypatch.setattr(replays, "_MOST_RECORDINGS", 1)
    replayed = both(lambda: start(density=False, degree_every=6), 9)
    assert live_in(replayed) == {FIRST: 1, "more than 1 kinds": 8}


def test_recordings_of_an_earlier_structure_are_dropped():
    kept, made = Replays(DEVICE, ""), []

    def recorded():
        made.append(SimpleNamespace(holds_at=lambda t: True, replay=lambda _: True, outcome=lambda: "replayed"))
        return made[-1]

    for address in range(2 * replays._MOST_RECORDINGS):
        rows = 5 + address // 2
        key = ReplayKey(rows, (address,), shapes_of([torch.zeros(rows, 3)], rows), ())
        found = [kept.do(key, 1, [], live=lambda: "live", record=recorded) for _ in range(3)]
        assert found == ["replayed" if address else "live", "replayed", "replayed"]
        assert len(made) == address + 1


def test_recordings_are_dropped_at_the_end_of_training(monkeypatch):
    state, made, init = start(density=False, iterations=4), [], Recording.__init__
    monkeypatch.setattr(Recording, "__init__", lambda self, *args: made.append(weakref.ref(self)) or init(self, *args))
    state.settings = replace(state.settings, replay=True)
    loop.fit(state, SCENE.to(DEVICE), rasterizers.load("warp", device=DEVICE.type))
    assert made
    assert not [recording for recording in made if recording() is not None]


@pytest.mark.parametrize(("lasts", "pays"), [(1, False), (2, False), (3, True), (20, True)])
def test_work_is_recorded_anew_as_long_as_recordings_pay_off(lasts, pays):
    kept = Replays(DEVICE, "")

    def do(t: int) -> str:
        def record():
            return SimpleNamespace(
                holds_at=lambda now: now // lasts == t // lasts, replay=lambda _: True, outcome=lambda: "replayed"
            )

        return kept.do(ReplayKey(1, (), (), ()), t, [], live=lambda: "live", record=record)

    found = [do(t) for t in range(240)]
    assert found[1] == "replayed"
    assert found[-1] == ("replayed" if pays else "live")


def test_memory_that_is_new_in_each_iteration_is_told_and_not_recorded(caplog):
    kept = Replays(DEVICE, "")
    found = [kept.do(ReplayKey(1, (k,), (), ()), k, [], live=lambda: "live", record=fails) for k in range(30)]
    assert set(found) == {"live"}
    assert caplog.text.count("Write to Strategy.state in place") == 1


@dataclass(frozen=True)
class Logs(cs.Strategy):
    """Logs by every hook of an iteration."""

    def background(self, t):
        self.log("in_background", float(t))
        self.log("in_two_hooks", float(t))

    def reconcile(self, products, step):
        self.log("in_reconcile", step.t / 2)
        self.log("in_two_hooks", -step.t)
        return cs.Weights()

    def extra_views(self, t):
        self.log("in_extra_views", float(t))
        return ()

    def after_step(self, params, step):
        self.log("in_after_step", float(step.t))

    def may_densify(self, t):
        self.log("in_may_densify", float(t))
        return True


@dataclass(frozen=True)
class LogsToo(cs.Strategy):
    """Logs a name that another strategy logs in an earlier hook."""

    def after_step(self, params, step):
        self.log("in_reconcile", -1.0)


def test_what_any_hook_logs_is_in_the_row_of_its_iteration_and_of_two_values_the_later_one():
    replayed = both(lambda: start(LogsToo(), reconciles=Logs(), density=False, rises_at=2), 12)
    assert replays_of(replayed) >= 8
    for row in replayed.history_as_floats()[3:]:
        assert row["LogsToo.in_reconcile"] == -1
        assert {name: x for name, x in row.items() if name.startswith("in_")} == {
            "in_background": row["t"], "in_reconcile": row["t"] / 2, "in_extra_views": row["t"], "in_after_step": row["t"],
            "in_may_densify": row["t"], "in_two_hooks": -row["t"],
        }  # fmt: skip


def fails(*_: object) -> None:
    raise ValueError("of no kind that is expected\nand a second line")


@pytest.mark.parametrize("fault", [lambda x: x.tolist(), fails], ids=["reads numbers", "an error of another kind"])
def test_what_cannot_be_recorded_is_live_from_then_on_and_one_line_says_why(fault, monkeypatch, caplog):
    """tests/rasterizers/test_recording.py has everything that cannot be recorded."""
    learn = loop.learn.__wrapped__

    def faulty(s, rasterizer, given):
        learned = learn(s, rasterizer, given)
        if running() is not None:
            fault(s.field.means.data)
        return learned

    monkeypatch.setattr(loop, "learn", replayed(faulty))
    assert live_in(both(lambda: start(density=False), 8)) == {FIRST: 2, FAILED: 6}
    require_one_line(caplog, 3)


def test_where_a_replay_fails_iterations_are_live_from_then_on(monkeypatch, caplog):
    live, other = (trained(start(density=False), replayed=r, until=5) for r in (False, True))
    monkeypatch.setattr(Recording, "replay", fails)
    require_same(trained(other, replayed=True, until=8), trained(live, replayed=False, until=8))
    assert (replays_of(other), live_in(other)) == (3, {FIRST: 2, FAILED: 3})
    require_one_line(caplog, 6)


def require_one_line(caplog: pytest.LogCaptureFixture, t: int) -> None:
    (line,) = [r.getMessage() for r in caplog.records if "fit.replay" in r.getMessage()]
    assert line.startswith(f"fit.replay ends at t={t}, and iterations are live from now on: ")
    assert "\n" not in line


@dataclass(frozen=True)
class Routes(cs.P2G):
    """A P2G that somebody has changed."""

    def route(self, step):
        return super().route(step) * step.t


def has_only(hook: str, s: TrainState) -> None:
    s.conductor.strategies = (type(hook, (cs.Strategy,), {hook: fails})(),)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda s: setattr(s, "compiled_step", None), "the per-Gaussian step is not that of Warp"),
        (lambda s: setattr(s.conductor, "objective", cs.Objective(kernels="torch")), "losses are not those of Warp"),
        (lambda s: setattr(s.conductor, "strategies", (Routes(),)), "Routes does not state what it looks up of a view"),
        *((partial(has_only, hook), hook) for hook in ("observe", "route", "score")),
    ],
)
def test_what_cannot_be_recorded_is_live_and_the_log_says_why(change, reason, caplog):
    state = start()
    state.settings = replace(state.settings, replay=True)
    change(state)
    assert replays_for(state, rasterizers.load("warp", device=DEVICE.type)) is None
    assert reason in caplog.text


def test_other_rasterizers_are_not_recorded(caplog):
    caplog.set_level("INFO")
    assert replays_for(start(), rasterizers.load("torch")) is None
    assert "ReferenceRasterizer cannot be recorded; rasterizer=warp can" in caplog.text
