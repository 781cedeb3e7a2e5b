"""C++ and Warp's kernels between the renderings and the step, on a CPU, beside what they stand for in torch."""

import pytest
import torch

import clear_strategies as cs
from clear_strategies.core import deferred
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, to_ndc
from clear_strategies.core.step import Step
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.kernels import native
from clear_strategies.kernels.per_gaussian import activate, evidence_score, reference, route, wander
from clear_strategies.merging.iteration import HrSide, Update
from clear_strategies.testing import StubShot
from rasterizers.native import kernel_threads
from tests.helpers import toy
from tests.helpers.backends import needs

N = 700
OF_ACTIVATION = ("scales", "filtered", "sigmoid", "coefficient", "factor", "opacities")


@pytest.fixture(params=[pytest.param(x, marks=needs("cpp" if x == "cpp" else "warp")) for x in ("cpp", 1, "many")])
def lanes(request, monkeypatch):
    """C++, or Warp's kernels with so many threads per block."""
    if request.param == "cpp":
        return request.param
    monkeypatch.setattr(native, "available", lambda: False)
    monkeypatch.setattr(native, "fastest", lambda device: "warp")
    if request.param == "many":
        request.getfixturevalue("whole_blocks")()
    return request.param


def both(function):
    """What a function returns by the kernels of `lanes`, and in torch."""
    with pytest.MonkeyPatch.context() as in_torch:
        found = function()
        in_torch.setattr(native, "implementation", lambda package, *tensors: reference)
        return found, function()


def seen(means2d, visible):
    return StubShot(torch.zeros(1, 1, 3), means2d, visible, [])


def numbers(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def require_close(found, expected) -> None:
    torch.testing.assert_close(found, expected, rtol=2e-6, atol=1e-30)


@pytest.mark.parametrize("gate", [None, torch.float32, torch.float64])
@pytest.mark.parametrize("n", [0, 1, 16, 1_043])
def test_the_activation(lanes, n, gate):
    for size in (1.0, 6.0):
        parameters = size * numbers(n, 3), 2 * size * numbers(n), numbers(n).clamp_min(0)
        parameters[0][:1] = -60  # squares vanish
        z = None if gate is None else (1.25 * (numbers(n) > 0)).to(gate)
        with kernel_threads(2):
            found = activate(*parameters, z)
        expected = reference.activate(*(x.double() for x in parameters), z)
        rtol = 8e-7 if lanes == "cpp" else 2e-6
        for name, x, y in zip(OF_ACTIVATION, found, expected, strict=True):
            torch.testing.assert_close(x.double(), y, rtol=rtol, atol=1e-36, msg=name)


@needs("cpp")
def test_what_is_out_of_range_is_activated_as_in_torch():
    scales = torch.tensor([[-60.0, 0.0, 1.0], [torch.nan, 0.0, 1.0], [torch.inf, 0.0, 1.0], [0.0, 0.0, 0.0]])
    logits, filters = torch.tensor([200.0, -80.0, 0.0, torch.nan]), torch.tensor([0.0, 0.0, 1.0, 1.0])
    # The reference takes float64 tensors; these fit float32 as well.
    expected = [x.float() for x in reference.activate(scales.double(), logits.double(), filters.double(), None)]
    for name, x, y in zip(OF_ACTIVATION, activate(scales, logits, filters, None), expected, strict=True):
        torch.testing.assert_close(x, y, rtol=8e-7, atol=1e-34, equal_nan=True, msg=name)


@needs("cpp")
def test_shapes_that_do_not_belong_together_are_refused():
    module, (scales, logits, filters) = native.module(), (numbers(5, 3), numbers(5), numbers(5))
    rows, columns = torch.empty(2, 5, 3), torch.empty(4, 5)
    with pytest.raises(ValueError, match=r"scales must be \[N, 3\]"):
        module.activate(scales, logits, filters[:4], None, rows, columns, 1)
    with pytest.raises(ValueError, match=r"columns \[4, N\]"):
        module.activate(scales, logits, filters, None, rows, torch.empty(4, 6), 1)


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_the_evidence_and_its_routing(lanes, normalize, share):
    p2g, visible = (
        cs.P2G(patch=4, normalize=normalize),
        torch.rand(N, generator=torch.Generator().manual_seed(1)) < share,
    )
    view, centers = toy.scene().train[0], 50 + 60 * numbers(N, 2)
    centers[~visible] = torch.nan
    shot = seen(centers, visible)

    def answers():
        e = p2g.observe(Step(1, view, visible), shot)
        logged = [deferred.read([x() if callable(x) else x])[0] for x in p2g.logs.values()]
        routed = [p2g.route(Step(1, view, visible, one))[visible] for one in (e, Evidence(e.reliability, e.demand))]
        return e.reliability, e.demand, *routed, torch.tensor(logged)

    for found, expected in zip(*both(answers), strict=True):
        torch.testing.assert_close(found, expected, rtol=2e-6, atol=0, equal_nan=True)


@pytest.mark.parametrize("score_by", ["sum", "evidence", "gradient"])
@pytest.mark.parametrize("hf", [False, True])
def test_scores_and_their_sum(lanes, score_by, hf):
    g = torch.Generator().manual_seed(3)
    q, a, visible = torch.rand(N, generator=g), torch.rand(N, generator=g), torch.rand(N, generator=g) < 0.5
    lr, base, detail = (Grads(screen=1e-4 * numbers(N + k, 2)[:N]) for k in range(3))
    detail.screen[0] = 1e-25
    hr = HrSide(base, detail if hf else None, (96, 64), toy.step(1, Evidence(q, a)))
    conductor = cs.Conductor(cs.P2G(score_by=score_by))

    def statistics():
        score, ordinary = conductor.scores(to_ndc(lr.screen, (24, 16)), hr, (0.7, 0.14))
        found = [score, ordinary]
        for reduce in ("mean", "max"):
            density = toy.densifier(DensitySettings(reduce=reduce), N)
            for factor in (1.0, 0.3):
                density.accumulate(
                    Update(hr.step, None, factor * score, factor * ordinary), seen(lr.screen, visible), 1
                )
            found += density.state_dict().values()
        return found

    for found, expected in zip(*both(statistics), strict=True):
        require_close(found, expected)


def test_the_noise_of_mcmc(lanes):
    quats, log_scales, gate, eta = numbers(N, 4) * 10, numbers(N, 3), numbers(N).sigmoid(), numbers(N // 2, 3)
    quats[0], quats[2] = 0, 1e-25
    rows = torch.arange(0, N, 2)

    def moved():
        means = torch.zeros(N, 3)
        wander(means, quats, log_scales, gate, rows, eta, 3.0)
        return means

    found, expected = both(moved)
    # A small part of a rotated row has the rounding of its largest.
    size = torch.linalg.vector_norm(expected, dim=1, keepdim=True)
    assert float(((found - expected).abs() / (1 + size)).max()) <= 1e-5
    if lanes == "cpp":
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6 * float(expected.abs().max()))


@needs("warp")
@pytest.mark.parametrize("ptx_of", [120], indirect=True)
def test_the_kernels_compile_for_cuda_on_a_machine_without(ptx_of):
    from clear_strategies.kernels.per_gaussian import warp

    ptx_of(warp._activate.module, warp.LANES)  # the module of all kernels


@needs("warp")
def test_other_tensors_take_torch(monkeypatch):
    from clear_strategies.kernels.per_gaussian import warp

    monkeypatch.setattr(warp, "activate", lambda *_: "Warp's")
    monkeypatch.setattr(native, "available", lambda: False)  # not C++
    x = [torch.zeros(1, 3), torch.zeros(1), torch.zeros(1)]
    assert activate(*x, None) != "Warp's"
    monkeypatch.setattr(native, "fastest", lambda device: "warp")
    assert activate(*x, None) == "Warp's"
    assert activate(*x, torch.zeros(1, dtype=torch.float64)) != "Warp's"


def test_evidence_of_another_type_than_the_kernels_is_computed_in_torch(lanes):
    """A strategy's own, where the other tensors are the trainer's."""
    visible, screen, ordinary = numbers(N) > 0, numbers(N, 2), numbers(N).abs()
    e = Evidence(numbers(N).double().sigmoid(), numbers(N).double().sigmoid())

    found, expected = both(lambda: (route(e, visible, 0.25, True), evidence_score(e, screen, ordinary, True)))
    assert all(map(torch.equal, found, expected))
