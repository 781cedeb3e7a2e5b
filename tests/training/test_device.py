"""Training on a device, as far as it can be seen without one.

torch's device "meta" holds shapes and no numbers: whoever reads one there fails. A state that lies on meta therefore shows
that nothing crosses over to the host while iterating; and with meta as the *default* device of a state that lies on the CPU,
a tensor that forgets where it belongs cannot be reckoned with.
"""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.weak import TensorWeakRef

from clear_strategies import P2G, SVS, Conductor, Grads, SplatSuRe
from clear_strategies.core import deferred
from clear_strategies.density.mcmc import MCMC, Sampler
from clear_strategies.merging.skips import SkipPolicy, Skips
from clear_strategies.strategies.p2g import _LookedUp
from clear_strategies.training import checkpoint
from clear_strategies.training.loop import iterate
from clear_strategies.training.state import TrainState
from rasterizers.interface import Rendering, SplatGradients, Traits
from rasterizers.torch_internals import version
from tests.helpers import toy
from tests.helpers.short_run import SCENE, SUBSETS, start, tensors

STEADY = (8, 12, 13)  # HR coarse; the anchor is taken; all there is
COARSE = Skips(coarse_until=9)


@dataclass
class Drawn:
    """A picture of the right shapes, made where the splats lie."""

    image: Tensor
    alpha: Tensor
    means2d: Tensor
    visible: Tensor
    like: Tensor
    bands: int
    depth: None = None

    def vjp(self, cotangents: Tensor) -> SplatGradients:
        k, n = len(cotangents), len(self.like)
        means, quats, scales, screen, rgb = (self.like.new_zeros(k, n, width) for width in (3, 4, 3, 2, 3))
        basis = self.like.new_zeros(n, self.bands + 1)
        return SplatGradients(means, quats, scales, self.like.new_zeros(k, n), screen, rgb, basis)


class Blank:
    """Draws nothing, anywhere."""

    traits = Traits(frozenset({"cpu", "meta"}), frozenset({torch.float32}))

    def __call__(self, splats, camera) -> Rendering:
        like, n = splats.means, len(splats)
        image = like.new_zeros(camera.height, camera.width, 3)
        visible = like.new_ones(n, dtype=torch.bool)
        return Drawn(image, image[..., 0], like.new_zeros(n, 2), visible, like, splats.shN.shape[1])

    def render_scales(self, jobs) -> list[Rendering]:
        return [self(splats, camera) for splats, camera in jobs]


class Crossings(TorchDispatchMode):
    """Operations with tensors of two devices: one of them was carried over, and somebody waited."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, operation, types, arguments=(), keywords=None):
        answer = operation(*arguments, **(keywords or {}))
        devices = {x.device.type for x in tree_leaves((arguments, keywords, answer)) if isinstance(x, Tensor)}
        if len(devices) > 1:
            self.found.append(str(operation))
        return answer


class Written(TorchFunctionMode):
    """Tensors written from Python's numbers: on a device they are carried over, and somebody waits."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_function__(self, function, types, arguments=(), keywords=None):
        answer = function(*arguments, **(keywords or {}))
        if function in (torch.tensor, torch.as_tensor, Tensor.new_tensor) and answer.device.type != "cpu":
            self.found.append(function.__name__)
        return answer


class Generator(torch.Generator):
    """Meta has none of its own."""

    def __new__(cls, device="cpu"):
        return super().__new__(cls, "cpu" if str(device) == "meta" else device)


@pytest.fixture
def no_data(monkeypatch):
    """What is made once, from the data, is there already."""
    monkeypatch.setattr(torch, "Generator", Generator)
    monkeypatch.setattr(TrainState, "refilter", lambda self: None)
    monkeypatch.setattr("clear_strategies.training.state.fingerprints", lambda views: {})


def cache_evidence(state: TrainState) -> None:
    """P2G's evidence is computed once a view, at either size of its SR image; here it is there already."""
    for p2g in (s for s in state.conductor.strategies if isinstance(s, P2G)):
        for view in (v for whole in state.views for v in (whole, state.conductor.skips.view(whole, 1))):
            images = [(TensorWeakRef(photo.image), version(photo.image)) for photo in (view.lr, view.hr)]
            p2g.cache[view.name, view.factor] = _LookedUp(images, None, view.lr.image.new_zeros(2, 2, 2))


def on_meta(monkeypatch, names: tuple[str, ...]) -> TrainState:
    """A run in its middle, of which all lies on meta but the cameras."""
    monkeypatch.setattr("tests.helpers.short_run.SCENE", SCENE.to("meta"))
    state = start(names)
    state.conductor.skips = SkipPolicy(COARSE)
    cache_evidence(state)
    state.compiled_step = None
    # Statistics are gathered; a round reads, and does not come.
    state.density.settings = replace(state.density.settings, start=90, stop=100, statistics_from=1)
    return state


def steadily(state: TrainState) -> None:
    """Iterations between changes of structure."""
    for t in STEADY:
        for s in state.conductor.strategies:
            if isinstance(s, SVS):
                s.cache["extent"] = s.state.get("means"), 1.0  # of the anchor, read once
        state.t = t
        with Crossings() as crossings, Written() as written:
            iterate(state, Blank())
        assert not crossings.found, f"t={t}"
        assert not written.found, f"t={t}"


def lying(state: TrainState) -> dict[str, Tensor]:
    """Everything that a checkpoint would hold, unread."""
    strategies, moments = state.conductor.state_dict(), state.optimizer.state_dict()
    return {**state.field.raw(), "filter": state.field.filter_3d, **moments, **state.density.state_dict(), **strategies}


# GCO reconciles in another way where no strategy has evidence.
ONE_AND_ALL = pytest.mark.parametrize("names", [("gco",), SUBSETS[-1]], ids="+".join)


@ONE_AND_ALL
def test_an_iteration_reads_nothing_and_carries_nothing_over(names, no_data, monkeypatch):
    state = on_meta(monkeypatch, names)
    steadily(state)
    assert {x.device.type for x in lying(state).values()} == {"meta"}
    assert all(not isinstance(row["loss_lr"], float) for row in state.history)


def splatsure(state: TrainState) -> None:
    state.conductor = Conductor(SplatSuRe(), objective=state.conductor.objective, statistics_from=1)
    state.conductor.on_fit_start(len(SCENE.train), 0, "meta")
    for view in state.views:  # whose poses are sent once
        state.conductor.strategies[0]._pose(view.name, view.lr.camera)
    state.conductor.skips = SkipPolicy()


def clamped(state: TrainState) -> None:
    state.conductor.objective = replace(state.conductor.objective, clamp_render=True)


def low_from_high(state: TrainState) -> None:
    state.conductor.objective = replace(state.conductor.objective, lr_from="hr", lambda_lr=0.6)


def noise_between_two_rounds_of_sampling(state: TrainState) -> None:
    state.density = Sampler(MCMC(stop=0), len(state.field), seed=0)


@pytest.mark.parametrize("change", [splatsure, clamped, low_from_high, noise_between_two_rounds_of_sampling])
def test_other_settings_read_nothing_either(change, no_data, monkeypatch):
    state = on_meta(monkeypatch, SUBSETS[-1] if change in (clamped, low_from_high) else ("p2g",))
    change(state)
    steadily(state)


class Elsewhere(SVS):
    def gate(self, t, n):
        return torch.ones(n, device="cpu")


class Writing(SVS):
    def regularize(self, params, t):
        return Grads({"opacities": params["opacities"] * params["opacities"].new_tensor(0.5)})


@pytest.mark.parametrize("careless", [Elsewhere, Writing])
def test_carrying_over_and_writing_would_be_seen(careless, no_data, monkeypatch):
    state = on_meta(monkeypatch, ())
    state.conductor = Conductor(careless(), objective=state.conductor.objective)
    state.conductor.on_fit_start(len(SCENE.train), 0, "meta")
    with pytest.raises(AssertionError, match="t=8"):
        steadily(state)


def test_a_read_would_be_seen(no_data, monkeypatch):
    state = on_meta(monkeypatch, ())
    state.t = 15
    monkeypatch.setattr(deferred, "is_immediate", lambda x: True)
    with pytest.raises(TypeError, match="meta"):
        iterate(state, Blank())


@pytest.mark.slow
@ONE_AND_ALL
def test_every_tensor_is_made_where_the_field_lies_and_late_numbers_are_the_same(names, tmp_path, monkeypatch):
    """Density, resets, anchor, skips and a resumption included."""

    def begun() -> TrainState:
        state = start(names)
        state.conductor.skips, state.compiled_step = SkipPolicy(COARSE), None
        state.conductor.objective = replace(state.conductor.objective, kernels="torch")
        return state

    def trained(cut: int | None) -> TrainState:
        state = begun()
        while state.t <= STEADY[-1]:
            if state.t == cut:
                path = checkpoint.save(tmp_path, state.checkpoint({}))
                state = begun()
                state.restore(checkpoint.load(path), path)
            with torch.device("meta" if cut else "cpu"):
                iterate(state, toy.RASTERIZER)
        return state

    at_once = trained(None)
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)
    unread = trained(9)
    for name, value in tensors(at_once).items():
        assert torch.equal(tensors(unread)[name], value), name
    for then, now in zip(at_once.history_as_floats(), unread.history_as_floats(), strict=True):
        if not now.get("corrected", 0.0) > 0:  # that is known too late to leave the share out
            then.pop("omega_at_lower_bound", None)
            now.pop("omega_at_lower_bound", None)
        assert known(now) == pytest.approx(known(then), rel=1e-6)


def known(row: dict[str, float]) -> dict[str, float]:
    """Without NaNs, which a row loses with its place among the newest, and in a checkpoint."""
    return {name: x for name, x in row.items() if not math.isnan(x)}


def test_a_scene_moves_as_one_and_its_cameras_and_cloud_stay():
    there = SCENE.to("meta")
    assert there.device.type == "meta"
    for view in (*there.train, *there.test):
        assert {x.device.type for x in (view.lr.image, view.hr.image, view.truth)} == {"meta"}
        assert {photo.camera.world_to_camera.device.type for photo in (view.lr, view.hr)} == {"cpu"}
    assert there.cloud.means.device.type == "cpu"
    assert there.to("meta").train[0].factor == SCENE.train[0].factor


def test_a_checkpoint_is_taken_to_wherever_the_run_is(tmp_path, no_data, monkeypatch):
    saved = start(("svs",))
    for _ in range(13):
        iterate(saved, toy.RASTERIZER)
    path = checkpoint.save(tmp_path, saved.checkpoint({}))
    found = checkpoint.load(path)
    assert found.device == "cpu"
    state = on_meta(monkeypatch, ("svs",))
    state.restore(found, path)
    assert {x.device.type for x in lying(state).values()} == {"meta"}
    assert lying(state).keys() == lying(saved).keys()
    assert state.t == 14
