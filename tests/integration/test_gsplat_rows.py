"""Which Gaussian came from which in a gsplat loop, whatever densifies it."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch

from clear_strategies import SVS, Conductor, Objective, Strategy
from clear_strategies.schedules import WarmupDecay
from integration import HostError
from integration.gsplat import attach
from integration.rows import ROWS
from tests.helpers import gsplat_host, toy
from tests.helpers.gsplat_host import Host

HR_FROM_START = WarmupDecay(start=0, full=1, decay_from=100, end=100)


@dataclass(frozen=True)
class Recorder(Strategy):
    """Records every change of structure."""

    changes: list = field(default_factory=list)

    def on_resize(self, parents):
        self.changes.append(parents)


@pytest.fixture
def gsplat_strategies(monkeypatch):
    strategies = pytest.importorskip("gsplat.strategy", reason="pip install gsplat")
    monkeypatch.setattr("gsplat.strategy.ops.compute_relocation", relocation)
    monkeypatch.setattr("gsplat.strategy.mcmc.inject_noise_to_position", lambda **_: None)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    return strategies


def relocation(opacities, scales, ratios, binoms, min_opacity=0.005):
    """Copies that together look like the old Gaussian, nearly: gsplat's own needs CUDA."""
    return 1 - (1 - opacities) ** (1 / ratios), scales * 0.9


def default(strategies):
    return strategies.DefaultStrategy(
        refine_start_iter=4, refine_stop_iter=24, refine_every=5, grow_grad2d=2e-4, prune_opa=0.02
    )


def mcmc(strategies):
    made = strategies.MCMCStrategy(
        refine_start_iter=4, refine_stop_iter=24, refine_every=5, min_opacity=0.1, noise_lr=0
    )
    start, step = made.initialize_state, made.step_post_backward
    made.initialize_state = lambda scene_scale: start()
    made.step_post_backward = lambda *args, packed: step(
        *args, lr=1e-4
    )  # the arguments that the host of these tests gives
    return made


@pytest.fixture(params=[default, mcmc])
def strategy(request, gsplat_strategies):
    return request.param(gsplat_strategies)


def trained(strategy, conductor, steps=30):
    torch.manual_seed(0)
    scene = toy.scene(40)
    host = Host(scene, extent=4.0, strategy=strategy)
    clear = attach(host.splats, host.optimizers, scene.train, conductor, strategy=strategy)
    clear.replace_everywhere(gsplat_host.rasterization)
    host.optimizers["sh0"].param_groups[0]["lr"] = 0.0  # colours stay, so that they identify Gaussians
    colors = host.splats["sh0"].detach().clone()
    try:
        host.train([scene.train[i % 3].name for i in range(steps)])
    finally:
        clear.remove()
    return host, clear, colors


def test_parents_are_where_each_gaussian_came_from(strategy):
    recorder = Recorder()
    host, _, colors = trained(strategy, Conductor(recorder))
    assert len(recorder.changes) >= 3
    for parents in recorder.changes:
        colors = colors[parents]
    assert torch.equal(colors, host.splats["sh0"].detach())
    assert len(colors) > 40


def test_an_anchor_is_taken_once_mcmc_has_ended(gsplat_strategies):
    anchored = SVS(anchor_start=26, anchor_strength=0.01)
    host, clear, _ = trained(mcmc(gsplat_strategies), Conductor(anchored, objective=Objective(lambda_hr=HR_FROM_START)))
    assert len(clear.attachment.conductor.state_dict()) > 0
    assert {len(p) for p in host.splats.values()} == {len(host.splats["means"])}


def test_a_densifier_that_forgets_a_parameter_is_an_error():
    scene = toy.scene(20)
    host = Host(scene)
    clear = attach(host.splats, host.optimizers, scene.train, Conductor())
    rasterization = clear.wrap(gsplat_host.rasterization)
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN", "detail"):
        host.splats[name] = torch.nn.Parameter(host.splats[name].detach()[1:])
    with pytest.raises(HostError, match=rf"from 20 to 19 without the parameter {ROWS}"):
        rasterize(rasterization, host, scene.train[0].lr.camera)


def test_the_state_of_gsplat_1_4_carries_the_rows_and_must_know_their_origin():
    scene, state, recorder = toy.scene(20), {}, Recorder()
    host = Host(scene)
    clear = attach(host.splats, host.optimizers, scene.train, Conductor(recorder), state=state)
    rasterization, camera = clear.wrap(gsplat_host.rasterization), scene.train[0].lr.camera
    assert ROWS not in host.splats
    for name, p in host.splats.items():
        host.splats[name] = torch.nn.Parameter(p.detach()[1:])
    state[ROWS] = state[ROWS][1:]
    rasterize(rasterization, host, camera)
    assert torch.equal(recorder.changes[0], torch.arange(1, 20))
    state[ROWS] = torch.zeros_like(state[ROWS])
    with pytest.raises(HostError, match="does not say where relocated Gaussians come from"):
        rasterize(rasterization, host, camera)


def test_checkpoints_and_later_loops_know_nothing_of_the_rows():
    scene = toy.scene(20)
    host = Host(scene)
    splats = torch.nn.ParameterDict(host.splats)
    clear = attach(splats, host.optimizers, scene.train, Conductor())
    assert ROWS in splats
    assert set(splats.state_dict()) == {*host.splats, "detail"}
    clear.remove()
    assert ROWS not in splats


def rasterize(rasterization, host, camera):
    p = host.splats
    return rasterization(
        p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat([p["sh0"], p["shN"]], 1),
        camera.world_to_camera[None], gsplat_host.intrinsics(camera), camera.width, camera.height, sh_degree=3,
    )  # fmt: skip
