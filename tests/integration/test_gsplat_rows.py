"""gsplat's own densifiers with CLEAR attached: which Gaussian came from which, and what follows them."""

import copy
from contextlib import nullcontext
from dataclasses import dataclass, field

import pytest
import torch

from clear_strategies import GCO, P2G, SVS, Conductor, SplatSuRe, Strategy, Weights
from clear_strategies.schedules import Ramp
from integration import HostError
from integration.gsplat import attach
from integration.gsplat.rows import ROWS
from tests.helpers import gsplat_host, toy
from tests.helpers.gsplat_host import Host
from tests.helpers.host_parts import HR_FROM_START


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


@pytest.fixture(params=[lambda _: None, mcmc], ids=["default", "mcmc"])
def strategy(request, gsplat_strategies):
    return request.param(gsplat_strategies)


def test_parents_are_where_each_gaussian_came_from(strategy):
    recorder = toy.Recorder()
    host, _ = gsplat_host.densified(Conductor(recorder), strategy, colors_stay=True)
    colors = Host(toy.scene(40)).splats["sh0"].detach()
    assert len(recorder.changes) >= 3
    for parents in recorder.changes:
        colors = colors[parents]
    assert torch.equal(colors, host.splats["sh0"].detach())
    assert len(colors) > 40


def test_all_parameters_and_states_follow_the_densifier_in_a_packed_loop_as_in_another(gsplat_strategies):
    followed = GCO(), P2G(patch=4), SVS(dropout=Ramp(full=50), anchor_start=25, anchor_strength=0.01)
    (one, of_one), (packed, of_packed) = (
        gsplat_host.densified(Conductor(*copy.deepcopy(followed), objective=HR_FROM_START), packed=packed)
        for packed in (False, True)
    )
    n = len(one.splats["means"])
    assert n > 40
    assert {len(p) for p in one.splats.values()} == {n}
    assert ROWS not in one.splats
    for counts in (of_one.attachment.counts, of_packed.attachment.counts):
        assert counts["structure changes"] >= 3
        assert counts["scores written"] == counts["merges"] == 30
    assert float(one.splats["detail"].abs().max()) > 0
    for name, p in one.splats.items():
        assert torch.equal(packed.splats[name], p), name


def test_a_densifier_that_forgets_a_parameter_is_an_error():
    host, _, render = gsplat_host.started()
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN", "detail"):
        host.splats[name] = torch.nn.Parameter(host.splats[name].detach()[1:])
    with pytest.raises(HostError, match=rf"from 20 to 19 without the parameter {ROWS}"):
        render()


def test_the_state_of_gsplat_1_4_carries_the_rows_and_must_know_their_origin():
    state, recorder = {}, toy.Recorder()
    host, _, render = gsplat_host.started(recorder, SplatSuRe(), state=state)
    assert ROWS not in host.splats
    host.prune(1)
    state[ROWS] = state[ROWS][1:]
    render()
    assert torch.equal(recorder.changes[0], torch.arange(1, 20))
    for i in range(3):  # until something is stored of each Gaussian
        render(i).mean().backward()
    state[ROWS] = torch.zeros_like(state[ROWS])
    with pytest.raises(HostError, match="does not say where relocated Gaussians come from"):
        render()


@pytest.mark.parametrize(
    "strategies", [(), (toy.RunningMean(),), (SplatSuRe(),)], ids=["nothing is stored", "a number", "something of each"]
)
def test_gaussians_that_come_from_no_other_are_added_where_nothing_is_stored_of_each(strategies):
    recorder = toy.Recorder()
    host, _, render = gsplat_host.started(recorder, *strategies)
    for i in range(3):
        render(i).mean().backward()
    for name, p in host.splats.items():  # as a loop adds rows to whatever it finds among its parameters
        rows = torch.cat((p.detach(), torch.zeros_like(p[:2])))
        host.splats[name] = torch.nn.Parameter(rows, requires_grad=p.requires_grad)
    if any(isinstance(s, SplatSuRe) for s in strategies):
        with pytest.raises(HostError, match=rf"2 new Gaussians come from no other, but SplatSuRe.*parameter {ROWS}"):
            render()
    else:
        render().mean().backward()
        assert recorder.changes[0].tolist() == [*range(20), 0, 0]


def test_the_signals_of_a_scene_carry_the_rows_and_may_change_in_place():
    """A scene of gsplat 1.6 replaces them where Gaussians are added or removed, and writes into them where one is moved."""
    signal, recorder = {}, toy.Recorder()
    _, _, render = gsplat_host.started(recorder, state=signal)
    signal[ROWS][2] = signal[ROWS][7]
    render()
    assert recorder.changes[0].tolist() == [0, 1, 7, *range(3, 20)]
    render()
    assert len(recorder.changes) == 1


def test_checkpoints_and_later_loops_know_nothing_of_the_rows():
    host = Host()
    splats = torch.nn.ParameterDict(host.splats)
    clear = attach(splats, host.optimizers, host.scene.train, Conductor())
    assert ROWS in splats
    stored = {name: p.clone() + 1 for name, p in splats.state_dict().items()}
    assert set(stored) == {*host.splats, "detail"}
    splats.load_state_dict(stored)
    assert torch.equal(splats["means"], stored["means"])
    clear.remove()
    assert ROWS not in splats


@pytest.mark.parametrize(
    ("change", "refused"),
    [(lambda p, mean: p.copy_(mean.mul_(0.999).add_(p, alpha=0.001)), False), (lambda p, _: p.add_(0.3), True),
     (lambda p, _: p.mul_(2), True)],
    ids=["an average", "noise", "a scale"],
)  # fmt: skip
def test_a_loop_may_average_all_parameters_and_is_refused_where_it_changes_the_rows(change, refused):
    recorder = toy.Recorder()
    host, _, render = gsplat_host.started(recorder)
    with torch.no_grad():
        means = {name: p.clone() for name, p in host.splats.items()}
        for _ in range(100):
            for name, p in host.splats.items():
                change(p, means[name])
    with pytest.raises(HostError, match=f"{ROWS} must hold row numbers") if refused else nullcontext():
        render()
    assert not recorder.changes


def test_a_loop_that_loads_other_gaussians_is_attached_again():
    host, clear, render = gsplat_host.started()
    other = Host(toy.scene(23))
    for name, p in other.splats.items():
        host.splats[name], host.optimizers[name] = p, other.optimizers[name]
    with pytest.raises(HostError, match=r"from 20 to 23 without .* remove\(\) and attach again"):
        render()
    clear.remove()
    host.rasterization = other.rasterization
    with pytest.raises(
        ValueError, match=r"each of the 23 Gaussians, got \[20, 3\]. If other Gaussians were loaded, delete it"
    ):
        gsplat_host.started(host=host)
    del host.splats["detail"], host.optimizers["detail"]
    host, clear, render = gsplat_host.started(host=host)
    render().mean().backward()
    assert clear.attachment.counts["merges"] == 1


@pytest.mark.parametrize("stopped_at", [1, 2, 3])
def test_a_resumed_loop_takes_the_anchor_as_if_it_had_not_stopped(stopped_at):
    scene = toy.scene(20)

    def program(steps, splats=None, state=None):
        host = Host(scene)
        for name, p in (splats or {}).items():
            host.splats.setdefault(name, torch.nn.Parameter(p)).data = p
        _, clear, _ = gsplat_host.started(SVS(anchor_start=2, anchor_strength=0.01), host=host, scene=scene)
        if state is not None:
            clear.attachment.load_state_dict(state)
        host.train([scene.train[t % 3].name for t in steps])
        clear.remove()
        return host.splats, clear.attachment

    _, whole = program(range(4))
    splats, first = program(range(stopped_at))
    stored = {name: p.detach().clone() for name, p in splats.items()}
    _, resumed = program(range(stopped_at, 4), stored, first.state_dict())
    assert resumed.t == whole.t
    assert set(resumed.conductor.state_dict()) == set(whole.conductor.state_dict()) != set()


def test_a_resumed_loop_tells_strategies_what_its_last_step_has_seen():
    def told(state=None):
        _, clear, render = gsplat_host.started(SplatSuRe(), P2G())
        if state is not None:
            clear.attachment.load_state_dict(state)
        render(1 if state is None else 2).mean().backward()  # `after_step` of the step before comes first
        return clear.attachment

    first = told()
    whole, resumed = copy.deepcopy(first.state_dict()), told(first.state_dict())
    assert whole["step"].keys() == {"visible", "reliability", "demand"}
    ((name, rates),) = resumed.conductor.state_dict().items()
    assert name == f"SplatSuRe.{whole['view']}"
    assert rates.any()


def test_a_loop_goes_back_to_a_checkpoint_with_another_number_of_gaussians():
    recorder = toy.Recorder()
    host, clear, render = gsplat_host.started(recorder, SplatSuRe())
    for i in range(3):
        render(i).mean().backward()
    state = copy.deepcopy(clear.attachment.state_dict())
    stored = {name: p.detach().clone() for name, p in host.splats.items() if name != ROWS}
    host.prune(5)
    render(0).mean().backward()
    host.splats.update({name: torch.nn.Parameter(p) for name, p in stored.items()})
    clear.attachment.load_state_dict(state)
    render(1).mean().backward()
    assert len(recorder.changes) == 1
    assert {rows.shape for rows in clear.attachment.conductor.state_dict().values()} == {(20,)}


@dataclass(frozen=True)
class Reads(Strategy):
    """Keeps what it is shown of each Gaussian."""

    seen: list = field(default_factory=list)

    def reconcile(self, products, step):
        self.seen.append(({name: p.clone() for name, p in step.params.items()}, step.visible))
        return Weights()

    def after_step(self, params, step):
        self.seen.append((step.params, step.visible))


def test_a_strategy_sees_the_raw_parameters_until_the_structure_changes_and_which_gaussians_are_visible():
    reads = Reads()
    host, clear, render = gsplat_host.started(reads)
    host.splats["means"].data[5] += 1_000
    before = {name: p.detach().clone() for name, p in clear.params().items()}
    render(0).mean().backward()
    host.prune(1)
    render(1)
    (merging, visible), (stepped, still_visible) = reads.seen
    assert merging.keys() == before.keys()
    assert all(torch.equal(merging[name], p) for name, p in before.items())
    assert not stepped
    assert visible.tolist() == [i != 5 for i in range(20)]
    assert torch.equal(still_visible, visible[1:])


@pytest.mark.parametrize("last", [4, 5])
def test_gaussians_that_a_host_adds_in_the_step_of_the_anchor_are_there_before_it_is_taken(last):
    """As with DefaultStrategy's refine_stop_iter at half of the steps, where SVS's anchor is."""
    host, clear, render = gsplat_host.started(SVS(anchor_start=5, anchor_strength=0.01))
    for t in range(1, 7):
        render(t % 3).mean().backward()
        host.step()
        if t == last:
            host.prune(1)
    assert clear.attachment.conductor.state_dict()["SVS.means"].shape == (19, 3)


def test_a_loop_that_converts_all_its_parameters_keeps_the_rows_or_is_refused():
    """`splats.half()` has whole numbers up to 2,048 alone."""
    scene, recorder = toy.scene(3_000), toy.Recorder()
    host, _, render = gsplat_host.started(recorder, scene=scene)
    for halved_after_a_render in (True, False):
        for p in host.splats.values():
            p.data = p.data.half() if p is host.splats[ROWS] else p.data
        if halved_after_a_render:
            render()
        host.prune(1)
        refused = pytest.raises(HostError, match=r"must be float64, got torch\.float16")
        with nullcontext() if halved_after_a_render else refused:
            render()
    assert torch.equal(recorder.changes[0], torch.arange(1, 3_000))
