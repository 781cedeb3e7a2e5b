"""Warp's kernels between the renderings and the step, on a CPU, beside what they stand for in torch."""

from typing import NamedTuple

import pytest
import torch

import clear_strategies as cs
from clear_strategies.core import deferred
from clear_strategies.core.evidence import Evidence
from clear_strategies.core.gradients import Grads, to_ndc
from clear_strategies.core.step import Step
from clear_strategies.density.adaptive import DensitySettings
from clear_strategies.kernels import per_gaussian
from clear_strategies.kernels.per_gaussian import activate, evidence_score, route, wander
from clear_strategies.merging.iteration import HrSide, Update
from clear_strategies.training.field import GaussianField
from tests.helpers import toy
from tests.helpers.backends import needs

pytestmark = needs("warp")
N = 700


@pytest.fixture(params=[1, 32], ids="{}_lanes".format)
def by_warp(request, monkeypatch, blocks_of):
    """What a function returns in torch, and by Warp's kernels with so many threads per block."""
    from clear_strategies.kernels.per_gaussian import warp

    def both(function):
        monkeypatch.setattr(per_gaussian.native, "available", lambda: False)  # not C++
        expected = function()
        monkeypatch.setattr(per_gaussian, "DEVICES", {"cpu"})
        if request.param > 1:
            blocks_of(warp.LANES, request.param)
        return function(), expected

    return both


class Seen(NamedTuple):
    means2d: torch.Tensor
    visible: torch.Tensor
    image: torch.Tensor = torch.zeros(1, 1, 3)

    def vjp(self, cotangents):
        raise NotImplementedError


def numbers(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def require_close(found, expected) -> None:
    torch.testing.assert_close(found, expected, rtol=2e-6, atol=1e-30)


@pytest.mark.parametrize("gated", [False, True])
def test_the_activation(by_warp, gated):
    field = GaussianField.from_cloud(toy.cloud(N))
    field.scales.data += 3 * numbers(N, 3)
    field.scales.data[0] = -60  # squares vanish
    field.opacities.data += 5 * numbers(N)
    field.filter_3d = numbers(N).abs() * (numbers(N) > 0)
    gate = (numbers(N) > 0) * 1.25 if gated else None
    found, expected = by_warp(lambda: field._activate(gate))
    for name in ("scales", "filtered", "sigmoid", "coefficient", "factor", "opacities"):
        require_close(getattr(found, name), getattr(expected, name))


@pytest.mark.parametrize("normalize", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_the_evidence_and_its_routing(by_warp, normalize, share):
    p2g, visible = (
        cs.P2G(patch=4, normalize=normalize),
        torch.rand(N, generator=torch.Generator().manual_seed(1)) < share,
    )
    view, centers = toy.scene().train[0], 50 + 60 * numbers(N, 2)
    centers[~visible] = torch.nan
    shot = Seen(centers, visible)

    def answers():
        e = p2g.observe(Step(1, view, visible), shot)
        logged = [deferred.read([x() if callable(x) else x])[0] for x in p2g.logs.values()]
        routed = [p2g.route(Step(1, view, visible, one))[visible] for one in (e, Evidence(e.reliability, e.demand))]
        return e.reliability, e.demand, *routed, torch.tensor(logged)

    for found, expected in zip(*by_warp(answers), strict=True):
        torch.testing.assert_close(found, expected, rtol=2e-6, atol=0, equal_nan=True)


@pytest.mark.parametrize("score_by", ["sum", "evidence", "gradient"])
@pytest.mark.parametrize("hf", [False, True])
def test_scores_and_their_sum(by_warp, score_by, hf):
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
            density = DensitySettings(reduce=reduce).densifier(N, extent=1, seed=0, white_background=False)
            for factor in (1.0, 0.3):
                density.accumulate(
                    Update(hr.step, None, factor * score, factor * ordinary), Seen(lr.screen, visible), 1
                )
            found += density.state_dict().values()
        return found

    for found, expected in zip(*by_warp(statistics), strict=True):
        require_close(found, expected)


@pytest.mark.slow
def test_the_noise_of_mcmc(by_warp):
    quats, log_scales, gate, eta = numbers(N, 4) * 10, numbers(N, 3), numbers(N).sigmoid(), numbers(N // 2, 3)
    quats[0], quats[2] = 0, 1e-25
    rows = torch.arange(0, N, 2)

    def moved():
        means = numbers(N, 3)
        wander(means, quats, log_scales, gate, rows, eta, 3.0)
        return means

    found, expected = by_warp(moved)
    size = torch.linalg.vector_norm(expected - numbers(N, 3), dim=1, keepdim=True)
    assert (
        float(((found - expected).abs() / (1 + size)).max()) <= 1e-5
    )  # a small part of a rotated row has the rounding of its largest


def test_the_kernels_compile_for_cuda_on_a_machine_without(ptx_of):
    from clear_strategies.kernels.per_gaussian import warp

    ptx_of(warp._activate.module, warp.LANES["cuda"])  # the module of all kernels


def test_other_tensors_take_torch(monkeypatch):
    from clear_strategies.kernels.per_gaussian import warp

    monkeypatch.setattr(warp, "activate", lambda *_: "Warp's")
    monkeypatch.setattr(per_gaussian.native, "available", lambda: False)  # not C++
    x = [torch.zeros(1, 3), torch.zeros(1), torch.zeros(1)]
    assert activate(*x, None) != "Warp's"
    monkeypatch.setattr(per_gaussian, "DEVICES", {"cpu"})
    assert activate(*x, None) == "Warp's"
    assert activate(*x, torch.zeros(1, dtype=torch.float64)) != "Warp's"


def test_evidence_of_another_type_than_the_kernels_is_computed_in_torch(by_warp):
    """A strategy's own, where the other tensors are the trainer's."""
    visible, screen, ordinary = numbers(N) > 0, numbers(N, 2), numbers(N).abs()
    e = Evidence(numbers(N).double().sigmoid(), numbers(N).double().sigmoid())

    def both():
        return route(e, visible, 0.25, True), evidence_score(e, screen, ordinary, True)

    found, expected = by_warp(both)
    assert all(map(torch.equal, found, expected))
