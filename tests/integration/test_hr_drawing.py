"""HR and extra views that this package draws beside a host's own LR: the same gradients, live and replayed."""

from dataclasses import dataclass, replace
from functools import partial
from weakref import WeakSet

import pytest
import torch

import clear_strategies as cs
import rasterizers
from clear_strategies import Conductor
from clear_strategies.merging import replay
from clear_strategies.merging.replay import LIVE, LoggedReplay
from clear_strategies.merging.skips import Skips
from clear_strategies.schedules import Ramp, WarmupDecay
from integration import hr_drawing, replayed_merge
from integration.autograd_shot import to_leaves
from rasterizers import replayed_drawing
from rasterizers.recording import running
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.gsplat_host import Host, attached, started
from tests.helpers.host_parts import HR_FROM_START

SCENE = toy.scene(20)
FIRST = "the first of its kind"
WARP = replace(HR_FROM_START, kernels="warp")


def two_photos(*, robust: bool = False) -> cs.Strategy:
    """Shows the field two of its photos again, so that two pictures of one kind are drawn before the first is stepped on; with
    `robust` one of them was invented in part.
    """

    def shown(views, t):
        return [toy.again(view.lr, 0.3 + 0.1 * t, robust=robust and k == 1) for k, view in enumerate(views[:2])]

    return toy.Shows(shown)


@dataclass(frozen=True)
class Sees(cs.GCO):
    """Logs and keeps what it is told of its iterations."""

    def reconcile(self, products, step):
        self.log("at", step.t)
        return super().reconcile(products, step)

    def after_step(self, params, step):
        e, seen = step.evidence, {"means": params["means"], "before": step.params["means"], "visible": step.visible}
        seen |= {} if e is None else {"reliability": e.reliability, "demand": e.demand}
        sums = {name: float(x.sum()) for name, x in seen.items() if x is not None}
        told = {"t": step.t, "view": int(step.view.name[-1]), **sums}
        self.cache.setdefault("told", []).append(told)


@dataclass(frozen=True)
class Vetoes(cs.Strategy):
    """Decides by number, and by the Gaussians that are seen and where they lie."""

    def correct(self, g_lr, g_hr, step):
        near = step.visible & (step.params["means"][:, 2] < 1)
        return cs.Grads({name: torch.where(g_lr[name] * g < 0, 0.0, g) for name, g in g_hr.items()}) * near.float()


@dataclass(frozen=True)
class Trusts(cs.Strategy):
    """Trusts HR by the factor of the view, and by a number of each Gaussian that is another one after some steps."""

    def looked_up(self, view):
        return view.lr.image.new_zeros(1)

    def observe(self, step, hr):
        trust = self.state.get("trust", torch.ones_like(hr.means2d[:, 0])) / step.view.factor
        return cs.Evidence(trust, trust)

    def route(self, step):
        return step.evidence.reliability

    def after_step(self, params, step):
        if step.t == 6:
            self.state["trust"] = params["opacities"].sigmoid()


def everything(*, robust: bool = False) -> list[cs.Strategy]:
    return [Sees(), cs.P2G(), cs.SVS(looks=0, dropout=Ramp(full=5), anchor_start=100), two_photos(robust=robust)]


def transparent(scene):
    """The scene where the background shows through its photos, on the right more than on the left."""

    def faded(photo):
        through = torch.linspace(0, 1, photo.image.shape[1], device=photo.image.device)
        return replace(photo, transparency=through.expand(photo.image.shape[:2]))

    return replace(scene, train=tuple(replace(v, lr=faded(v.lr), hr=faded(v.hr)) for v in scene.train))


def trained(
    hr_by, *, lr_by="torch", steps=6, strategies=None, scene=SCENE, objective=HR_FROM_START, skips=None, calls=({},),
    **settings
):  # fmt: skip
    """The host's parameters, the log of each step, and the attachment.

    Args:
        calls: what the host gives its rasterizer besides, one after the other.
    """
    host = Host(scene, rasterization=drawn_by(lr_by), **calls[0])
    strategies = everything() if strategies is None else strategies
    clear = attached(host, scene, Conductor(*strategies, objective=objective, skips=skips), hr_by=hr_by, **settings)
    host.degree = lambda step: 2 if step < 3 else 3
    names, logs = [view.name for view in scene.train], []

    def between():
        logs.append(clear.attachment.log)
        host.call |= calls[len(logs) % len(calls)]

    host.train([names[i % len(names)] for i in range(steps)], between=between)
    clear.remove()
    logs += [told for s in strategies if isinstance(s, Sees) for told in s.cache["told"]]
    return {name: p.detach().clone() for name, p in host.splats.items()}, logs, clear


def drawn_by(backend):
    """A function for the host's LR. Warp has one result on a GPU; torch adds in any order there."""
    return partial(rasterizers.rasterization, backend=backend)


def require_close(found, expected):
    for name, x in expected.items():
        torch.testing.assert_close(found[name], x, rtol=1e-3, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")


MASK = torch.ones(SCENE.train[0].lr.image.shape[:2])
MASK[:5] = 0


@pytest.mark.parametrize("differs", [
    {"masks": {view.name: MASK for view in SCENE.train},
     "calls": [{"backgrounds": torch.tensor([[0.2, 0.5, 0.7]])}, {"rasterize_mode": "antialiased"}, {"sh_fp16": True}]},
    {"detail": False, "strategies": []},
    {"scene": transparent(SCENE), "strategies": [*everything(), cs.RandomBackground()]},
], ids=lambda x: next(iter(x)))  # fmt: skip
def test_what_this_package_draws_has_the_gradients_of_the_hosts_function(differs):
    (found, logs, clear), (expected, their_logs, _) = (trained(hr_by, **differs) for hr_by in ("torch", "host"))
    require_close(found, expected)
    for log, theirs in zip(logs, their_logs, strict=True):
        assert log == pytest.approx(theirs, rel=1e-3, abs=1e-4, nan_ok=True)
    assert clear.attachment.counts["HR renders"] == 6


@pytest.mark.parametrize("frozen", [False, True], ids=["apart", "alone"])
def test_an_offset_of_the_colours_learns_the_same_in_a_pass_of_its_own(frozen):
    def gradient(*passes):
        host, _, render = started(cs.GCO(), scene=SCENE)
        offset = torch.nn.Parameter(torch.full((1, 1, 3), 0.1))
        function, gaussians = host.rasterization, list(host.splats.values())
        host.rasterization = lambda m, q, s, o, c, *more, **call: function(m, q, s, o, c + offset, *more, **call)
        for p in gaussians:
            p.requires_grad_(not frozen)
        loss = (render()[0] - SCENE.train[0].lr.image).abs().mean()
        for one in passes:
            one(loss, gaussians, offset)
        return offset.grad

    whole = gradient(lambda loss, *_: loss.backward())
    first = torch.autograd.grad if frozen else torch.autograd.backward
    apart = gradient(
        lambda loss, gaussians, offset: first(loss, inputs=[offset] if frozen else gaussians, retain_graph=True),
        lambda loss, _, offset: loss.backward(inputs=[offset]),
    )
    torch.testing.assert_close(apart, whole)
    of_lr = gradient(lambda loss, _, offset: setattr(offset, "grad", torch.autograd.grad(loss, offset)[0]))
    assert float((whole - of_lr).norm()) > 0.1 * float(of_lr.norm())


def test_small_gradients_pass_through_half_precision_by_the_scale_of_the_loss():
    offset, scale = torch.nn.Parameter(torch.ones(5, 3)), 2.0**16
    half, g = offset.half().float(), torch.full((5, 3), 1e-9)
    _, ((leaf, found),) = to_leaves(cs.Grads({"colors": g}), {"colors": half}, {}, scale)
    assert leaf is offset
    torch.testing.assert_close(found, g, rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ({"radius_clip": 0.0, "camera_model": "fisheye"}, "camera_model='fisheye'"),
        ({"sh_degree": None}, "spherical harmonics"),
    ],
)
def test_what_this_package_does_not_draw_is_refused_where_it_was_asked_to(call, reason):
    host, clear, render = started(scene=SCENE, hr_by="torch")
    function = host.rasterization
    if call.get("sh_degree", 3) is None:
        host.rasterization = lambda m, q, s, o, colors, *more, **call: function(m, q, s, o, colors[:, 0], *more, **call)
    with pytest.raises(ValueError, match=reason):
        render(**call)
    clear.remove()


needs_warp = needs("warp")


@pytest.fixture
def scene(recorded_on):
    return SCENE.to(recorded_on)


def record_nothing(monkeypatch):
    for module in (replay, replayed_drawing):
        monkeypatch.setattr(module, "can_record", lambda device: False)


def both(monkeypatch, **settings):
    """The replayed training, after a comparison with the live one: the same bits."""
    settings = {"objective": WARP, "lr_by": "warp", **settings}
    replayed = trained("warp", **settings)
    record_nothing(monkeypatch)
    live = trained("warp", **settings)
    assert not [name for name, x in live[0].items() if not torch.equal(x, replayed[0][name])]
    assert replayed[1] == live[1]
    entries = replayed[2].attachment.conductor.work_log.entries
    return entries["replayed"].runs, entries[LIVE].skipped


def masked(scene):
    """The mask of the first photo alone."""
    mask = torch.ones_like(scene.train[0].lr.image[..., 0])
    mask[:5] = 0
    return {scene.train[0].name: mask}


def of_two_factors(scene):
    """The first photo has half the size of the others, and its SR image the same."""
    first, *others = scene.train
    return replace(scene, train=(replace(first, lr=first.lr.reduced(2)), *others))


READS_VIEW = "state that HR does not read, and a merge by the view"
DIFFERS = {
    "mask": lambda s: {"masks": masked(s)},
    "background of the loop, without f_det": lambda s: {
        "calls": [{"backgrounds": s.train[0].hr.image.new_tensor([[x, 0.5, 0.7]])} for x in (0.1, 0.2, 0.9)], "detail": False
    },
    "background and robust views of strategies": lambda s: {
        "scene": transparent(s), "strategies": [*everything(robust=True), cs.RandomBackground()]
    },
    "rasterizer, and every second without HR": lambda s: {
        "calls": [{"rasterize_mode": mode} for mode in ("classic", "antialiased", "antialiased")],
        "skips": Skips(coarse_until=100, hr_every=2), "steps": 12,
    },
    "factor and state": lambda s: {"scene": of_two_factors(s), "strategies": [Trusts()], "steps": 12},
    READS_VIEW: lambda s: {"strategies": [cs.SplatSuRe(), cs.P2G()]},
    "weight of HR": lambda s: {
        "objective": replace(WARP, lambda_hr=WarmupDecay(final=0.2, start=2, full=6, decay_from=7, end=9)), "steps": 12
    },
    "anchor": lambda s: {"strategies": [cs.GCO(), cs.SVS(looks=0, anchor_start=4, anchor_strength=0.01)]},
    "correct": lambda s: {"strategies": [Vetoes()]},
}  # fmt: skip


@needs_warp
@pytest.mark.parametrize("differs", DIFFERS)
def test_what_differs_between_steps_is_copied_or_makes_their_work_of_two_kinds(monkeypatch, scene, differs):
    runs, live = both(monkeypatch, **{"scene": scene, "steps": 8, **DIFFERS[differs](scene)})
    assert live.keys() == {FIRST} | ({"a recording failed"} if differs == READS_VIEW else set())
    assert runs >= 3


@needs_warp
def test_a_step_sends_no_number_that_the_host_waits_for(strict_cuda):
    """Of a loop that densifies by P2G's score, with extra views, masks and random backgrounds behind transparent photos."""
    strategies = pytest.importorskip("gsplat.strategy")
    scene, names = transparent(toy.scene(20)), [view.name for view in SCENE.train]
    host = Host(scene, rasterization=drawn_by("warp"), strategy=strategies.DefaultStrategy(refine_stop_iter=99))
    conductor = Conductor(*everything(), cs.RandomBackground(), objective=WARP)
    clear = attached(host, scene, conductor, strategy=host.strategy, hr_by="warp")
    after = iter(["default"] * 2 + ["error"] * 6)
    host.train([names[i % len(names)] for i in range(8)], between=lambda: torch.cuda.set_sync_debug_mode(next(after)))
    assert clear.attachment.counts["scores written"] == clear.attachment.counts["HR renders"] == 8
    assert clear.attachment.counts["extra views"] == 2 * 8


def test_a_mask_is_sent_once(monkeypatch):
    enlarged, given = hr_drawing.enlarged_mask, []
    monkeypatch.setattr(hr_drawing, "enlarged_mask", lambda mask, factor: given.append(mask) or enlarged(mask, factor))
    trained("host", masks={view.name: torch.ones(16, 24, dtype=torch.bool) for view in SCENE.train})
    assert len(given) == 6
    assert len({*map(id, given)}) == 3


def test_a_mask_that_the_host_changes_or_adds_hides_from_then_on(monkeypatch):
    enlarged, shown = hr_drawing.enlarged_mask, []
    monkeypatch.setattr(
        hr_drawing, "enlarged_mask", lambda mask, factor: shown.append(bool(mask.any())) or enlarged(mask, factor)
    )
    first, second = (view for view in SCENE.train[:2])
    masks = {first.name: torch.ones(16, 24, dtype=torch.bool)}
    host, *_ = started(scene=SCENE, masks=masks)
    host.train([first.name])
    masks[first.name].zero_()
    host.train([first.name])
    masks |= {view.name: torch.ones(16, 24) for view in (first, second)}
    host.train([first.name, second.name])
    assert shown == [True, False, True, True]


@needs_warp
def test_replays_over_densification_resets_evaluation_and_resuming(monkeypatch, recorded_on):
    strategies = pytest.importorskip("gsplat.strategy")
    scene = toy.scene(40).to(recorded_on)
    names = [scene.train[i % 3].name for i in range(20)]
    living = WeakSet()

    class Seen(LoggedReplay):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            living.add(self)

    for module in (hr_drawing, replayed_merge):
        monkeypatch.setattr(module, "LoggedReplay", Seen)

    def begun(host):
        host.degree = lambda step: 3
        return attached(
            host, scene, Conductor(cs.GCO(), cs.P2G(), objective=WARP), strategy=host.strategy, hr_by="warp"
        )

    def run():
        torch.manual_seed(0)
        host = Host(scene, rasterization=drawn_by("warp"), extent=4.0, strategy=strategies.DefaultStrategy(
            refine_start_iter=2, refine_stop_iter=14, refine_every=6, reset_every=9, grow_grad2d=2e-4, prune_opa=0.02
        ))  # fmt: skip
        clear = begun(host)

        def evaluate():
            with torch.no_grad():
                host.render(scene.train[0].lr.camera)

        host.train(names, between=evaluate)
        logs = [clear.attachment.conductor.work_log]
        assert len(living) == (2 if replay.can_record(recorded_on) else 0)
        clear.remove()
        assert not living
        resumed = Host(scene, rasterization=drawn_by("warp"), extent=4.0)
        resumed.splats = {name: torch.nn.Parameter(p.detach().clone()) for name, p in host.splats.items()}
        resumed.optimizers = {name: torch.optim.Adam([p], lr=1e-3) for name, p in resumed.splats.items()}
        again = begun(resumed)
        again.attachment.load_state_dict(clear.attachment.state_dict())
        resumed.train(names[:5])
        logs.append(again.attachment.conductor.work_log)
        again.remove()
        return {name: p.detach() for name, p in resumed.splats.items()}, logs

    replayed, logs = run()
    record_nothing(monkeypatch)
    live, _ = run()
    assert len(live["means"]) not in (40, 0)
    assert not [name for name, x in live.items() if not torch.equal(x, replayed[name])]
    assert [log.entries["replayed"].runs >= n for log, n in zip(logs, (10, 3), strict=True)] == [True, True]
    assert {reason for log in logs for reason in log.entries[LIVE].skipped} <= {
        FIRST, "the recorded lists of pairs are too short"
    }  # fmt: skip


@needs_warp
@pytest.mark.parametrize(
    ("owner", "name", "what"), [(hr_drawing.AutogradShot, "gradients", "HR"), (cs.GCO, "reconcile", "the merge")]
)
def test_what_cannot_be_recorded_is_live_and_one_line_says_why(owner, name, what, monkeypatch, scene, caplog):
    original = getattr(owner, name)

    def reads(self, given, *more):
        if running() is not None:
            (given if isinstance(given, torch.Tensor) else given.dot).sum().item()
        return original(self, given, *more)

    with monkeypatch.context() as patched:
        patched.setattr(owner, name, reads)
        found = trained("warp", scene=scene, objective=WARP, strategies=[cs.GCO(), cs.P2G()])
    (line,) = [r.getMessage() for r in caplog.records if "the replay of" in r.getMessage()]
    assert line.startswith(f"the replay of {what} ends at t=")
    entries = found[2].attachment.conductor.work_log.entries
    assert entries[LIVE].skipped["a recording failed"] >= 4
    assert entries["replayed"].runs >= 2  # the other
    expected = trained("warp", scene=scene, objective=WARP, strategies=[cs.GCO(), cs.P2G()])
    assert found[1] == expected[1]
    assert not [name for name, x in expected[0].items() if not torch.equal(x, found[0][name])]
