"""HR and extra views that this package draws beside a host's own LR: the same gradients, live and replayed."""

from dataclasses import dataclass, replace

import pytest
import torch

import clear_strategies as cs
from clear_strategies import Conductor
from clear_strategies.core.view import ExtraView
from clear_strategies.merging.replays import LIVE
from clear_strategies.schedules import Ramp
from integration import own_drawing
from rasterizers.recording import running
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.gsplat_host import Host, attached, drawn
from tests.helpers.host_parts import HR_FROM_START

SCENE = toy.scene(20)
FIRST = "the first of its kind"
WARP = replace(HR_FROM_START, kernels="warp")


@dataclass(frozen=True)
class TwoPhotos(cs.Strategy):
    """Shows the field two of its photos again, so that two pictures of one kind are drawn before the first is stepped on."""

    def extra_views(self, t):
        photos = [view.lr for view in self.__dict__["views"][:2]]
        return [ExtraView(photo, torch.full_like(photo.image[..., 0], 0.3 + 0.1 * t)) for photo in photos]

    def on_views(self, views):
        self.__dict__["views"] = views


def everything(**of_p2g) -> list[cs.Strategy]:
    return [cs.GCO(), cs.P2G(**of_p2g), cs.SVS(looks=0, dropout=Ramp(full=5), anchor_start=100), TwoPhotos()]


def trained(hr_by, *, steps=6, strategies=None, scene=SCENE, objective=HR_FROM_START, call=None, **settings):
    """The host's parameters, the log of each step, and the attachment."""
    host = Host(scene, **(call or {}))
    conductor = Conductor(*(everything() if strategies is None else strategies), objective=objective)
    clear = attached(host, scene, conductor, hr_by=hr_by, **settings)
    host.degree = lambda step: 2 if step < 3 else 3
    names, logs = [view.name for view in scene.train], []
    host.train([names[i % len(names)] for i in range(steps)], between=lambda: logs.append(clear.attachment.log))
    clear.remove()
    return {name: p.detach().clone() for name, p in host.splats.items()}, logs, clear


def require_close(found, expected):
    for name, x in expected.items():
        torch.testing.assert_close(found[name], x, rtol=1e-3, atol=1e-5, msg=lambda m, name=name: f"{name}: {m}")


@pytest.mark.parametrize(
    "differs",
    [
        {}, {"call": {"backgrounds": torch.tensor([[0.2, 0.5, 0.7]])}}, {"call": {"rasterize_mode": "antialiased"}},
        {"detail": False}, {"masks": True}, {"strategies": []},
    ],
    ids=lambda x: next(iter(x), "ordinary"),
)  # fmt: skip
def test_what_this_package_draws_has_the_gradients_of_the_hosts_function(differs):
    if differs.get("masks"):
        mask = torch.ones(SCENE.train[0].lr.image.shape[:2])
        mask[:5] = 0
        differs = {"masks": {view.name: mask for view in SCENE.train}}
    (found, logs, clear), (expected, their_logs, _) = (trained(hr_by, **differs) for hr_by in ("torch", "host"))
    require_close(found, expected)
    for log, theirs in zip(logs, their_logs, strict=True):
        assert log == pytest.approx(theirs, rel=1e-3, abs=1e-4, nan_ok=True)
    assert clear.attachment.counts["HR renders"] == 6


def test_an_offset_of_the_colours_gets_what_it_gets_of_the_hosts_function():
    """The colours are then no tensor of sh0 and shN side by side."""

    def gradients(hr_by):
        host = Host(SCENE)
        clear = attached(host, SCENE, Conductor(cs.GCO(), objective=HR_FROM_START), hr_by=hr_by)
        offset = torch.zeros(1, 1, 3, requires_grad=True)
        function = host.rasterization
        host.rasterization = lambda m, q, s, o, colors, *more, **call: function(
            m, q, s, o, colors + offset, *more, **call
        )
        image = drawn(host.rasterization, host.splats, SCENE.train[0].lr.camera)[0][0]
        (image - SCENE.train[0].lr.image).abs().mean().backward()
        clear.remove()
        return {name: p.grad for name, p in host.splats.items()} | {"offset": offset.grad}

    require_close(gradients("torch"), gradients("host"))


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        ({"radius_clip": 0.0, "camera_model": "fisheye"}, "camera_model='fisheye'"),
        ({"sh_degree": None}, "spherical harmonics"),
    ],
)
def test_what_this_package_does_not_draw_is_refused_where_it_was_asked_to(call, reason):
    host = Host(SCENE)
    clear = attached(host, SCENE, Conductor(objective=HR_FROM_START), hr_by="torch")
    function = host.rasterization
    if call.get("sh_degree", 3) is None:
        host.rasterization = lambda m, q, s, o, colors, *more, **call: function(m, q, s, o, colors[:, 0], *more, **call)
    with pytest.raises(ValueError, match=reason):
        drawn(host.rasterization, host.splats, SCENE.train[0].lr.camera, **call)
    clear.remove()


needs_warp = needs("warp")


@pytest.fixture
def scene(recorded_on):
    return SCENE.to(recorded_on)


def both(monkeypatch, scene, **settings):
    """The replayed training, after a comparison with the live one: the same bits."""
    replayed = trained("warp", scene=scene, objective=WARP, **settings)
    monkeypatch.setattr(own_drawing, "_RECORDING", set())
    live = trained("warp", scene=scene, objective=WARP, **settings)
    assert not [name for name, x in live[0].items() if not torch.equal(x, replayed[0][name])]
    assert replayed[1] == live[1]
    entries = replayed[2].attachment.conductor.work_log.entries
    return entries["replayed"].runs, entries[LIVE].skipped


@needs_warp
def test_replays_of_hr_and_of_extra_views_have_the_bits_of_live_ones(monkeypatch, scene):
    runs, live = both(monkeypatch, scene, steps=9)
    assert live.keys() == {FIRST}
    assert runs > 9


@needs_warp
@pytest.mark.parametrize("detail", [True, False])
def test_replays_over_masks_and_backgrounds(monkeypatch, scene, detail):
    mask = torch.ones(scene.train[0].lr.image.shape[:2], device=scene.train[0].lr.image.device)
    mask[:5] = 0
    runs, live = both(monkeypatch, scene, steps=6, masks={scene.train[0].name: mask}, detail=detail)
    assert live.keys() == {FIRST}
    assert runs > 4


@needs_warp
def test_replays_over_densification_resets_evaluation_and_resuming(monkeypatch, recorded_on):
    strategies = pytest.importorskip("gsplat.strategy")
    scene = toy.scene(40).to(recorded_on)
    names = [scene.train[i % 3].name for i in range(20)]

    def begun(host):
        host.degree = lambda step: 3
        return attached(
            host, scene, Conductor(cs.GCO(), cs.P2G(), objective=WARP), strategy=host.strategy, hr_by="warp"
        )

    def run():
        torch.manual_seed(0)
        host = Host(scene, extent=4.0, strategy=strategies.DefaultStrategy(
            refine_start_iter=2, refine_stop_iter=14, refine_every=6, reset_every=9, grow_grad2d=2e-4, prune_opa=0.02
        ))  # fmt: skip
        clear = begun(host)

        def evaluate():
            with torch.no_grad():
                host.render(scene.train[0].lr.camera)

        host.train(names, between=evaluate)
        logs = [clear.attachment.conductor.work_log]
        clear.remove()
        resumed = Host(scene, extent=4.0)
        resumed.splats = {name: torch.nn.Parameter(p.detach().clone()) for name, p in host.splats.items()}
        resumed.optimizers = {name: torch.optim.Adam([p], lr=1e-3) for name, p in resumed.splats.items()}
        again = begun(resumed)
        again.attachment.load_state_dict(clear.attachment.state_dict())
        resumed.train(names[:5])
        logs.append(again.attachment.conductor.work_log)
        again.remove()
        return {name: p.detach() for name, p in resumed.splats.items()}, logs

    replayed, logs = run()
    monkeypatch.setattr(own_drawing, "_RECORDING", set())
    live, _ = run()
    assert len(live["means"]) not in (40, 0)
    assert not [name for name, x in live.items() if not torch.equal(x, replayed[name])]
    assert [log.entries["replayed"].runs >= n for log, n in zip(logs, (10, 3), strict=True)] == [True, True]
    assert {reason for log in logs for reason in log.entries[LIVE].skipped} <= {
        FIRST, "the recorded lists of pairs are too short"
    }  # fmt: skip


@needs_warp
def test_what_cannot_be_recorded_is_live_and_one_line_says_why(monkeypatch, scene, caplog):
    original = own_drawing.AutogradShot.gradients

    def reads(self, cotangents):
        if running() is not None:
            cotangents.sum().item()
        return original(self, cotangents)

    monkeypatch.setattr(own_drawing.AutogradShot, "gradients", reads)
    trained("warp", scene=scene, objective=WARP, strategies=[cs.GCO(), cs.P2G()])
    (line,) = [r.getMessage() for r in caplog.records if "the replay of HR" in r.getMessage()]
    assert line.startswith("the replay of HR ends at t=")
