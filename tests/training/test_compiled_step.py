"""The fused per-Gaussian pass beside what it stands for: Conductor.merge, Adam.step and GaussianField.constrain.

In C++ and in Warp, whose kernels for CUDA run on a CPU, too.
"""

import itertools
import math
from dataclasses import dataclass, replace

import pytest
import torch

from clear_strategies import CONFLICT_GROUPS, GCO, P2G, SVS, Conductor, Grads, Objective
from clear_strategies.core import deferred
from clear_strategies.core.conflicts import Weights
from clear_strategies.core.gradients import gradients_of
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.kernels.gaussian_step import StepSettings
from clear_strategies.kernels.gaussian_step.cpp import CppGaussianStep
from clear_strategies.merging.logs import computed
from clear_strategies.schedules import LogLinear, Ramp, WarmupDecay
from clear_strategies.strategies.base import Strategy
from clear_strategies.training.compiled_step import CompiledStep, compiled_step_for
from clear_strategies.training.loop import iterate
from clear_strategies.training.mip import MipFilter
from clear_strategies.training.optim import Adam, LearningRates
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from rasterizers.interface import BackendUnavailable
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.compiled_step_cases import (
    ANCHORING,
    HR_LOSSES,
    Case,
    T,
    as_floats,
    case,
    compiled_merge,
    conductors,
    readable_merge,
)

EPS = torch.finfo(torch.float32).eps


def assert_same_gradient(c: Case, expected, found, λ=1.0, hr="both"):
    g_lr, from_hr = c.grads(0, hr)
    a = c.fields[0]._activate(c.z)
    parts = [g_lr] if from_hr is None else [g_lr, from_hr.g, *map(a.vjp, gradients_of(c.hr))]
    for name, value in expected.items():
        size = sum(abs(g[name]).double() for g in parts if g is not None and name in g) + abs(value).double()
        norm = size.flatten(1).norm(dim=1).view(-1, *[1] * (value.dim() - 1)) if value.dim() > 1 else size
        off = (found[name].double() - value.double()).abs()
        worst = (off - (4 * EPS * norm + 6e-45)).max() if off.numel() else torch.tensor(-1.0)
        assert float(worst) <= 0, f"{name}: {float(off.max()):.3g}"
    assert all(not value.any() for name, value in found.items() if name not in expected)


def both_ways(passes, c: Case, readable, compiled, hr="both"):
    """(merged gradient, conflict ratios) of the readable path and of the compiled one."""
    merged = readable_merge(readable, c.fields[0].raw(), *c.grads(0, hr), T)
    step = CompiledStep(compiled, Adam(c.fields[1].raw(), LearningRates(), 1.0), passes=passes)
    return *merged, *compiled_merge(step, c, hr)


def same(a, b):
    assert a.keys() <= b.keys()
    # On a device nobody knows that there is nothing to say.
    assert all(math.isnan(b[name]) for name in b.keys() - a.keys())
    for name, value in a.items():
        assert b[name] == pytest.approx(value, rel=1e-6, nan_ok=True), name


KINDS = ("random", "tiny", "huge", "mixed", "opposite", "parallel", "sparse", "zero", "round")
TWO_GROUPS = {"groups": ("shN", "means")}


@pytest.mark.parametrize(("kind", "settings"), [*((kind, {}) for kind in KINDS), ("random", TWO_GROUPS)])
def test_the_merged_gradient_is_the_readable_one(passes, kind, settings, caplog):
    """GCO's other settings give other weights, which both paths take from one function."""
    for gate, evidence in ((False, True), (True, False)):
        c = case(237, kind=kind, gate=gate, evidence=evidence)
        readable, compiled = conductors(lambda: GCO(**settings), SVS, anchored=c.fields[0])
        expected, conflict, found, found_conflict = both_ways(passes, c, readable, compiled)
        assert_same_gradient(c, expected, found)
        assert repr(as_floats(found_conflict)) == repr(as_floats(conflict))
        same(as_floats(computed(readable.logs.scalars())), as_floats(computed(compiled.logs.scalars())))
        assert not caplog.messages


@pytest.mark.parametrize("beyond", [-1e-5, -4e-7, 4e-7, 1e-5])
def test_beyond_2e_7_of_the_margin_both_paths_decide_the_same(passes, beyond):
    """The cosine of the SH gradients is that of ∇_rgb; its float32 rows round it by 1e-7."""
    c, margin = case(1000, evidence=False), GCO().tolerance
    g_lr, g_hr = c.lr.rgb[0].double(), c.hr.rgb[0].double()
    along = g_lr / g_lr.norm(dim=1, keepdim=True)
    across = torch.linalg.cross(along, g_hr)
    cosine = -margin + beyond
    c.hr.rgb[0] = 1e-5 * (cosine * along + math.sqrt(1 - cosine**2) * across / across.norm(dim=1, keepdim=True))
    readable, compiled = conductors(GCO)
    both_ways(passes, c, readable, compiled, "base")
    for conductor in (readable, compiled):
        logs = as_floats(computed(conductor.logs.scalars()))
        assert [logs[f"corrected_{group}"] for group in ("sh0", "shN")] == [float(beyond < 0)] * 2


@pytest.mark.parametrize("names", [s for k in range(4) for s in itertools.combinations((GCO, P2G, SVS), k)], ids=str)
def test_every_subset_of_strategies_with_and_without_hr(passes, names):
    for hr, anchored in itertools.product(HR_LOSSES, (False, True)):
        c = case(100, kind="random", evidence=P2G in names)
        readable, compiled = conductors(*names, anchored=c.fields[0] if anchored else None)
        expected, conflict, found, found_conflict = both_ways(passes, c, readable, compiled, hr)
        assert_same_gradient(c, expected, found, hr=hr)
        assert repr(as_floats(found_conflict)) == repr(as_floats(conflict))


def test_hr_for_the_score_alone_is_neither_compared_nor_corrected(passes):
    later = WarmupDecay(start=T + 5, full=T + 10, decay_from=40, end=50)
    c = case(50)
    expected, conflict, found, found_conflict = both_ways(passes, c, *conductors(GCO, λ=later))
    assert conflict == found_conflict == {}
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def three_steps(passes, c: Case, both, rates: LearningRates, hr="both", skips=True, steps=3):
    """Three steps each way: readable parameters and moments, and compiled ones."""
    adams = [Adam(f.raw(), rates, 2.0) for f in c.fields]
    step = CompiledStep(both[1], adams[1], skips=skips, passes=passes)
    for i in range(steps):
        g, _ = readable_merge(both[0], c.fields[0].raw(), *c.grads(0, hr), T + i)
        adams[0].step(c.fields[0].raw(), g)
        c.fields[0].constrain()
        step.step(c.fields[1].raw(), *c.factors(1, hr), T + i)
        c.hr.means.neg_()  # another view: momentum and gradient disagree
    return adams


def assert_same_state(c: Case, adams, rates: LearningRates):
    for name, p in c.fields[0].raw().items():
        q = c.fields[1].raw()[name]
        step = rates.at(1, 2.0)[name] * 10
        assert bool(((p - q).abs() <= 4 * EPS * (p.abs() + step)).all()), name
        for a, b in ((adams[0].first, adams[1].first), (adams[0].second, adams[1].second)):
            size = a[name].abs().amax() if a[name].numel() else 0.0
            assert bool(((a[name] - b[name]).abs() <= 4 * EPS * size).all()), name


@pytest.mark.parametrize("kind", ["random", "sparse", "zero"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_step_is_adams(passes, degree, kind):
    sizes = (17,)
    if (degree, kind) == (3, "random"):
        sizes = (0, 1, 15, 16, 17) if passes is CppGaussianStep else (0, 17)  # C++ takes sixteen at a time
    for n, hr in itertools.product(sizes, HR_LOSSES):
        c = case(n, degree, kind)
        rates = LearningRates(detail_decay=0.1, means=LogLinear(end=10))
        adams = three_steps(passes, c, conductors(P2G), rates, hr)
        assert_same_state(c, adams, rates)
        assert adams[0].steps == adams[1].steps == 3
    c = case(1000, degree, kind)
    rates = LearningRates()
    # One step: an anchor hands the last bit of a parameter on to the next gradient, much enlarged beside it.
    assert_same_state(c, three_steps(passes, c, conductors(P2G, SVS, anchored=c.fields[0]), rates, steps=1), rates)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_fields_of_every_degree_step(passes, bands):
    for degree in range(math.isqrt(bands + 1)):
        c = case(33, degree, bands=bands)
        assert_same_state(c, three_steps(passes, c, conductors(GCO), LearningRates()), LearningRates())


def test_parameters_are_projected_and_what_is_not_finite_is_not_hidden(passes):
    c = case(40, kind="sparse")
    for field in c.fields:
        field.opacities.data[:20], field.scales.data[5:30] = 50.0, -90.0
        field.means.data[3], field.opacities.data[4] = float("nan"), float("nan")
    three_steps(passes, c, conductors(), LearningRates())
    for name, p in c.fields[0].raw().items():
        assert torch.allclose(p, c.fields[1].raw()[name], rtol=1e-6, atol=1e-9, equal_nan=True), name
    assert float(c.fields[1].opacities.data.nan_to_num().max()) <= 15
    assert float(c.fields[1].scales.data.nan_to_num().min()) >= -20
    assert bool(c.fields[1].opacities.data[4].isnan())


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("anchored", [False, True])
def test_rows_and_bands_that_are_left_out_would_not_have_moved(passes, degree, anchored):
    rates = LearningRates(detail_decay=0.1)
    states, ledgers = [], []
    for skips in (True, False):
        c = case(500, degree, "sparse")
        both = conductors(GCO, SVS, anchored=c.fields[0] if anchored else None)
        if anchored:  # at θ^a itself nothing pulls
            for conductor in both:
                svs = conductor.strategies[1]
                svs.state.clear()
                conductor.after_step(c.fields[1].raw(), toy.step(svs.anchor_start))
        adams = three_steps(passes, c, both, rates, skips=skips)
        states.append([*c.fields[1].raw().values(), *adams[1].first.values(), *adams[1].second.values()])
        ledgers.append(both[1].work_log.entries)
    assert all(torch.equal(a, b) for a, b in zip(*states, strict=True))
    assert ledgers[0]["optimizer rows"].skipped["gradient and moments are 0"] > 500
    if anchored:  # whose pull on the bands would have to be read
        assert "SH bands in the optimizer" not in ledgers[0]
    else:
        inactive = 3 * (15 - (degree + 1) ** 2 + 1)
        assert ledgers[0]["SH bands in the optimizer"].skipped == {"above the active degree": inactive}
    assert "optimizer rows" not in ledgers[1]


@pytest.mark.parametrize(
    ("degrees", "moved", "skipped"),
    [((1, 1), {1: 10}, 12 + 4), ((2, 1), {}, 7 + 7), ((0, 1), {0: 1}, 13 + 12)],
    ids=["restored moments", "a lower degree", "a higher degree"],
)
def test_bands_are_left_out_above_the_highest_that_has_momentum(passes, degrees, moved, skipped):
    """`moved`: before which step a band of restored moments has momentum."""
    states = []
    for skips in (True, False):
        cases = [case(20, degree=degree) for degree in degrees]
        params, conductor = cases[0].fields[1].raw(), conductors()[1]
        adam = Adam(params, LearningRates(), 1.0)
        step = CompiledStep(conductor, adam, skips=skips, passes=passes)
        for i, c in enumerate(cases):
            if i in moved:
                for moments, value in ((adam.first, 1e-3), (adam.second, 1e-6)):
                    moments["shN"][:, moved[i]] = value
                adam.load_state_dict(adam.state_dict(), adam.steps)
            step.step(params, *c.factors(1), T)
        states.append([*params.values(), *adam.first.values(), *adam.second.values()])
        if skips:
            entry = conductor.work_log.entries["SH bands in the optimizer"]
            assert entry.skipped == {"above the active degree": skipped}
    assert all(torch.equal(a, b) for a, b in zip(*states, strict=True))


def test_the_same_bits_for_any_number_of_threads(passes):
    states = []
    threads = torch.get_num_threads()
    try:
        for count in (1, 1, 2, 3, 4, 8):
            torch.set_num_threads(count)
            c = case(5000, kind="mixed")
            _, conductor = conductors(GCO, SVS, anchored=c.fields[0])
            adam = Adam(c.fields[1].raw(), LearningRates(), 1.0)
            step = CompiledStep(conductor, adam, passes=passes)
            for i in range(3):
                step.step(c.fields[1].raw(), *c.factors(1), T + i)
            state = [*c.fields[1].raw().values(), *adam.first.values(), *adam.second.values()]
            states.append((state, repr(as_floats(computed(conductor.logs.scalars())))))
    finally:
        torch.set_num_threads(threads)
    for state, readings in states[1:]:
        assert readings == states[0][1]
        assert all(torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in zip(state, states[0][0], strict=True))


def test_a_rasterizer_may_have_the_basis_of_what_a_scale_draws_alone(passes):
    for make in (GCO, Signed):
        c = case(64, kind="sparse")
        c.lr, c.hr = (replace(g, basis=g.basis * (g.rgb != 0).any(2).any(0)[:, None]) for g in (c.lr, c.hr))
        expected, conflict, found, found_conflict = both_ways(passes, c, *conductors(make))
        assert_same_gradient(c, expected, found)
        assert as_floats(conflict) == as_floats(found_conflict)


def test_wrong_tensors_are_refused_at_the_border(passes):
    c = case(8)
    shot, g, _ = c.factors(1)
    lr, a = {**g.tensors}, shot.activation
    drawn = {"scales": a.scales, "filtered": a.filtered, "filter": a.filter_3d, "sigmoid": a.sigmoid}
    drawn |= {"factor": a.factor, "basis": g.colour.basis}
    for wrong, error, message in (
        (lr["means"].double(), TypeError, r"means must be a contiguous float32 tensor (in the CPU's memory|on cuda:0)"),
        (lr["means"].T.contiguous().T, TypeError, "means must be a contiguous float32 tensor"),
        (lr["means"][:5], ValueError, r"means must have 8 rows of 3 numbers, got shape \(5, 3\)"),
    ):
        with pytest.raises(error, match=message):
            passes(drawn, lr | {"means": wrong}, None)
    with pytest.raises(ValueError, match=r"detail must have 8 rows of 3 numbers, got shape \(8, 4\)"):
        passes(drawn, lr, lr | {"detail": lr["quats"]})
    with pytest.raises(KeyError, match="means"):
        passes(drawn, {}, None)


def thirty_iterations(passes) -> TrainState:
    """With `passes`, or by the readable path where there are none."""
    svs = ANCHORING(dropout=Ramp(full=30), anchor_start=20)
    objective = Objective(lambda_hr=WarmupDecay(start=3, full=10, decay_from=20, end=30))
    state = TrainState.start(
        toy.scene(16, seed=2, train=3, test=1), Conductor(GCO(), P2G(), svs, objective=objective, statistics_from=1),
        settings=FitSettings(iterations=30, scale_schedule=False, degree_every=6, fused="auto" if passes else "off"),
        density=DensitySettings(start=1, stop=19, statistics_from=1, every=9, min_gaussians=2, max_gaussians=40),
        rates=LearningRates(means=LogLinear(end=30), detail_decay=0.01), mip=MipFilter(every=7, last=1),
    )  # fmt: skip
    if passes:
        state.compiled_step = CompiledStep(state.conductor, state.optimizer, passes=passes)
    for _ in range(30):
        iterate(state, toy.RASTERIZER)
    deferred.resolve(state.history)
    return state


@pytest.fixture(scope="module")
def readable() -> TrainState:
    return thirty_iterations(None)


def test_thirty_iterations_are_those_of_the_readable_path(passes, readable):
    compiled = thirty_iterations(passes)
    assert readable.compiled_step is None
    assert len(readable.field) == len(compiled.field)
    for a, b in zip(readable.history, compiled.history, strict=True):
        assert a.keys() == b.keys()
        assert b["psnr_train_lr"] == pytest.approx(a["psnr_train_lr"], abs=0.01)
        assert all(b[k] == pytest.approx(a[k], rel=1e-2, abs=1e-3, nan_ok=True) for k in a if k.startswith("loss"))
    for name, p in readable.field.raw().items():
        # Not each and every number: Adam follows the sign of a gradient that is nothing but rounding. The readable path
        # beside itself, disturbed by 1e-7 a step, keeps 0.72 of the opacities and 0.80 of the means this near.
        near = (p - compiled.field.raw()[name]).abs() <= 1e-3 * (1 + p.abs())
        assert float(near.float().mean()) > 0.7, name
    stages = compiled.conductor.work_log.entries
    assert stages["per-Gaussian pass"].runs == 30
    assert "optimizer" not in stages
    assert set(CONFLICT_GROUPS) <= {key.removeprefix("conflict_") for row in compiled.history for key in row}


# ---- strategies that overrule a hook of ours, and runs without the compiled step, which say why
@dataclass(frozen=True)
class Bolder(GCO):
    def correct(self, lr, hr, step=None):
        return super().correct(lr, hr, step) * 2.0


@dataclass(frozen=True)
class Halved(GCO):
    def reconcile(self, products, step):
        keep, remove = super().reconcile(products, step)
        return Weights(keep / 2, remove / 2)


@dataclass(frozen=True)
class Signed(Strategy):
    """Number by number, which no two weights a group can state."""

    def correct(self, lr, hr, step=None):
        return Grads({name: torch.where(lr[name] * g > 0, g, 1e-7) for name, g in hr.items()})  # where both are 0, too


@dataclass(frozen=True)
class Pulling(Strategy):
    def regularize(self, params, t):
        return Grads({name: 1e-6 * params[name] for name in ("shN", "detail")})


@dataclass(frozen=True)
class Shared(Strategy):
    """One weight a Gaussian for all groups; another for all Gaussians."""

    def reconcile(self, products, step):
        return Weights(torch.linspace(0, 1, len(products.dot), device=products.dot.device), 0.3)


@pytest.mark.parametrize("make", [Bolder, Halved, Signed, Shared])
@pytest.mark.parametrize("degree", [0, 2])
def test_strategies_of_others_take_the_same_path(passes, make, degree):
    c, pulling = case(100, degree=degree, kind="sparse"), (SVS, Pulling) if degree else ()
    expected, conflict, found, found_conflict = both_ways(passes, c, *conductors(make, *pulling, anchored=c.fields[0]))
    assert_same_gradient(c, expected, found)
    assert as_floats(conflict) == as_floats(found_conflict)


@pytest.mark.parametrize("hr", HR_LOSSES)
def test_f_det_decays_wherever_it_has_a_gradient_though_by_an_anchor_alone(passes, hr):
    c, rates = case(40), LearningRates(detail_decay=0.1)
    assert_same_state(c, three_steps(passes, c, conductors(Pulling), rates, hr), rates)


class OwnAdam(Adam):
    pass


def test_the_readable_path_is_taken_where_it_must_be_and_that_is_said_once(caplog, monkeypatch):
    field = case(4).fields[0]
    adam = Adam(field.raw(), LearningRates(), 1.0)
    double = Adam(field.double().raw(), LearningRates(), 1.0)
    cases = [
        ((Conductor(GCO(), P2G()), adam, "off"), "fit.fused=off"),
        ((Conductor(), OwnAdam(field.raw(), LearningRates(), 1.0)), "OwnAdam may compute something else than Adam"),
        ((Conductor(), double), "means is torch.float64 on cpu, not float32"),
    ]
    for arguments, reason in cases:
        caplog.clear()
        with caplog.at_level("DEBUG"):
            assert compiled_step_for(*arguments) is None
        assert [reason in message for message in caplog.messages] == [True]

    def missing():
        raise BackendUnavailable("the compiled kernels are not installed.")

    monkeypatch.setattr("clear_strategies.kernels.native.module", missing)
    caplog.clear()
    with caplog.at_level("DEBUG"):
        assert compiled_step_for(Conductor(), adam) is None
    path = "The per-Gaussian step takes the readable path, which is several times slower: "
    assert caplog.messages == [path + "the compiled kernels are not installed."]


@needs("warp")
def test_torchs_default_dtype_plays_no_part_in_the_numbers_of_a_recorded_step():
    from clear_strategies.kernels.gaussian_step.warp import loss_weights, written

    settings = StepSettings(0.9, 0.999, 1.0, 1e-15, 0.5, False, 0)
    torch.set_default_dtype(torch.float64)
    try:
        found = loss_weights(written(settings, {}, torch.device("cpu"), lambda_hf=0.25))
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.tolist() == [0.5, 0.25]
