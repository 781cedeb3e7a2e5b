"""The merge in a host's `.grad` against `Conductor.merge` in float64, by every pass that runs here."""

from collections import Counter
from functools import partial
from importlib import import_module

import pytest
import torch

from clear_strategies import GCO, SVS, Conductor, Evidence, Grads, Objective, Strategy, Weights
from clear_strategies.core import deferred
from clear_strategies.core.gradients import CONFLICT_GROUPS, Colour
from clear_strategies.errors import DivergedError
from clear_strategies.kernels import reconcile
from clear_strategies.kernels.reconcile import dense, reference
from clear_strategies.merging.logs import computed
from clear_strategies.schedules import WarmupDecay
from integration.host import Host
from integration.host_merge import HostMerge
from integration.pending import BackwardPass
from tests.helpers import gsplat_host, toy
from tests.helpers.backends import needs

T, N = 50, 1003  # N: a last block of sixteen that is not full, and more than one chunk of 1,024 numbers
SHAPES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (15, 3), "detail": (3,)}
RULES = {"means": 1e-5, "quats": 1e-6, "scales": 1e-5, "opacities": 1e-4, "sh0": 1e-5, "shN": 1e-6, "detail": 1e-5}


@pytest.fixture(params=[*(pytest.param(name, marks=needs(name)) for name in ("cpp", "warp")), "reference"])
def passes(request, monkeypatch):
    """What computes products and apply for float32 in the CPU's memory."""
    chosen = import_module(f"{reconcile.__name__}.{request.param}")
    monkeypatch.setattr(
        reconcile, "_chosen", lambda *tensors: chosen if all(x.dtype == torch.float32 for x in tensors) else reference
    )
    return request.param


def drawn(seed: int, names, n: int = N, dtype=torch.float32) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return {
        name: (torch.randn(n, *SHAPES[name], generator=generator, dtype=torch.float64) * RULES[name]).to(dtype)
        for name in names
    }


def conductor(*, anchored: bool = False, start: int = 0) -> Conductor:
    strategies = [GCO(), SVS(anchor_strength=0.01 if anchored else 0.0, anchor_start=1)]
    made = Conductor(*strategies, objective=Objective(lambda_hr=WarmupDecay(start=start, full=start + 1)))
    made.on_fit_start(3, seed=0)
    return made


def setting(dtype, *, names=tuple(SHAPES), n: int = N, accumulated: bool, factors: bool, scale: float):
    """Parameters with `.grad`, the gradients of before, and g^HR; the same numbers in every dtype that holds them."""
    values, lr, hr = (drawn(seed, names, n) for seed in (1, 2, 3))
    earlier = drawn(4, names, n) if accumulated else {}
    q = torch.rand(n, generator=torch.Generator().manual_seed(5))
    basis = torch.rand(n, 9, generator=torch.Generator().manual_seed(6)) - 0.5
    rgb = drawn(7, ["means"], n)["means"]
    params = {name: torch.nn.Parameter((1e5 * value).to(dtype)) for name, value in values.items()}
    for name, p in params.items():
        if name != "detail":
            p.grad = (scale * lr[name] + earlier.get(name, 0.0)).to(dtype)
    before = {name: g.to(dtype) for name, g in earlier.items() if name != "detail"}
    grads = {name: g.to(dtype) for name, g in hr.items() if not (factors and name.startswith("sh"))}
    colour = Colour(rgb.to(dtype), basis.to(dtype)) if factors else None
    return params, before, Grads(grads, colour=colour), toy.step(T, Evidence(q, torch.ones(n)))


def anchor(made: Conductor, params) -> None:
    made.after_step({name: p.detach() * 0.9 for name, p in params.items()}, toy.step(1))


def merging(made, params, *, before, lr_colour=None, **of_host):
    """The merge at the end of a backward pass that has added to `.grad`, which held `before`."""
    host, device = Host(lambda: params, lambda: None, **of_host), params["means" if "means" in params else "sh0"].device
    done = BackwardPass(0, params, colour=lr_colour)
    done.before = before
    return partial(HostMerge(made, host, device, Counter(), lambda *_: None).merge_gradients, done, params)


def merge_in_place(made, params, g_hr, step, t, *, scale=1.0, **of_pass):
    return merging(made, params, **of_pass)(g_hr, step, t, scale)


def by_the_conductor(made, params, g_hr, step, t, *, before, scale):
    """What `merge_in_place` should do, written down."""
    passed = {name: p.grad - before.get(name, 0) for name, p in params.items() if p.grad is not None}
    lr, values = Grads(passed) * (1 / scale), {name: p.detach() for name, p in params.items()}
    out = {name: torch.empty_like(p) for name, p in values.items()}
    merged = made.merge(values, lr, g_hr, step, t, out)
    for name, g in out.items():
        params[name].grad = before.get(name, 0) + scale * g
    return merged.conflict


@pytest.mark.parametrize("accumulated", [False, True])
@pytest.mark.parametrize("factors", [False, True])
@pytest.mark.parametrize(("anchored", "scale"), [(False, 1.0), (True, 0.5)])
def test_every_pass_agrees_with_the_conductor_in_float64(passes, accumulated, factors, anchored, scale):
    results, conflicts = [], []
    for dtype in (torch.float32, torch.float64):
        made = conductor(anchored=anchored)
        params, before, hr, step = setting(dtype, accumulated=accumulated, factors=factors, scale=scale)
        if anchored:
            anchor(made, params)
        merge = merge_in_place if dtype == torch.float32 else by_the_conductor
        conflicts.append(deferred.resolve([dict(merge(made, params, hr, step, T, before=before, scale=scale))])[0])
        results.append({name: p.grad.double() for name, p in params.items()})
        assert deferred.read([computed(made.logs.scalars())["corrected"]])[0] > 0.1
    for name, exact in results[1].items():
        error = (results[0][name] - exact).flatten(1 if exact.dim() > 1 else 0).abs().max()
        assert error <= 4e-6 * exact.abs().max(), name
    assert conflicts[0] == pytest.approx(conflicts[1], abs=1e-9)


@pytest.mark.parametrize("accumulated", [False, True])
@pytest.mark.parametrize("hr", ["none", "rows", "factors", "factors of one basis"])
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_lr_gradient_of_the_colours_may_come_by_its_factors(passes, accumulated, hr, scale):
    basis = torch.rand(N, 9, generator=torch.Generator().manual_seed(8)) - 0.5
    rgb = drawn(9, ["means"])["means"]
    results = []
    for dtype in (torch.float32, torch.float64):
        params, before, routed, step = setting(
            dtype, accumulated=accumulated, factors=hr.startswith("factors"), scale=scale
        )
        lr = Colour(scale * rgb.to(dtype), basis.to(dtype))
        if hr == "factors of one basis":
            routed = Grads(routed, colour=Colour(routed.colour.rgb, lr.basis))
        for name in ("sh0", "shN"):
            params[name].grad = before.get(name, torch.zeros(0)).clone() if accumulated else None
        exact = dtype == torch.float64
        if exact:
            for name, g in dense(Grads(colour=lr), {name: params[name].detach() for name in ("sh0", "shN")}).items():
                params[name].grad = g if params[name].grad is None else params[name].grad + g
        made, routed = conductor(), Grads() if hr == "none" else routed
        merge = by_the_conductor if exact else partial(merge_in_place, lr_colour=lr)
        merge(made, params, routed, step, T, before=before, scale=scale)
        assert hr == "none" or deferred.read([computed(made.logs.scalars())["corrected"]])[0] > 0.1
        results.append({name: p.grad.double() for name, p in params.items()})
    for name, exact in results[1].items():
        assert (results[0][name] - exact).abs().max() <= 4e-6 * exact.abs().max(), name


BASIS = torch.rand(N, 9, generator=torch.Generator().manual_seed(8)) - 0.5
FORMS = {
    "a number": 0.3, "0-dim": torch.tensor(0.4), "[N]": torch.linspace(0, 1, N),
    "[N, G]": torch.linspace(1, 2, 6 * N).view(N, 6),
}  # fmt: skip


def rows_and_factors(seed: int, without: str) -> Grads:
    rgb = drawn(seed + 2, ["means"])["means"]
    return Grads(drawn(seed, [name for name in SHAPES if name != without]), colour=Colour(rgb, BASIS * seed))


def whole(g: Grads, name: str) -> torch.Tensor:
    """Every number of an attribute, [N, D] in float64: its rows, and its part of Y ⊗ ∇rgb."""
    rows = g.get(name, torch.zeros(N, *SHAPES[name])).double().reshape(N, -1)
    if g.colour is not None and name.startswith("sh"):
        basis = g.colour.basis[:, :1] if name == "sh0" else g.colour.basis[:, 1:]
        rows[:, : 3 * basis.shape[1]] += (basis[..., None] * g.colour.rgb[:, None]).flatten(1)
    return rows


@pytest.mark.parametrize("keeps_lr", [True, False])
@pytest.mark.parametrize(("keep", "remove"), list(zip(FORMS, [*FORMS][1:] + [*FORMS][:1], strict=True)))
def test_weights_of_any_form_and_rows_beside_factors_are_merged_as_written(passes, keep, remove, keeps_lr):
    """Eq. 7, 8 and 16, attribute by attribute. HR has no gradient of the means, which is 0 then."""
    lr, hr, plus = rows_and_factors(1, "detail"), rows_and_factors(2, "means"), Grads(drawn(5, SHAPES))
    out, weights = {name: torch.empty(N, *shape) for name, shape in SHAPES.items()}, Weights(FORMS[keep], FORMS[remove])
    assert reconcile.apply(out, lr, hr, weights, lambda_hr=0.5, plus=plus, keeps_lr=keeps_lr)
    found = reconcile.products(lr, hr)
    for name in SHAPES:
        l, h, k, r = whole(lr, name), whole(hr, name), 1.0, 0.0
        pairs = []
        if name != "detail":
            at = CONFLICT_GROUPS.index(name)
            k, r = (w[:, at, None] if w.dim() == 2 else w.view(-1, 1) for w in map(torch.as_tensor, weights))
            pairs = [(found.dot[:, at], l * h), (found.h2[:, at], h * h)]
            pairs += [(found.l2[:, at], l * l)] if name in found.names else []
        merged = (l if keeps_lr else 0) + (0.5 if keeps_lr else 1) * (k * h - r * l) + whole(plus, name)
        for x, exact in [*((x, numbers.sum(1)) for x, numbers in pairs), (out[name].double().view(N, -1), merged)]:
            assert torch.allclose(x, exact, rtol=1e-5, atol=1e-6 * float(exact.abs().max())), name


def test_opposed_are_gradients_of_a_cosine_below_0_where_neither_is_0(passes):
    lr = Grads({"means": torch.tensor([[1.0, 0, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0]])})
    hr = Grads({"means": torch.tensor([[-1.0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 0, 0], [0, 0, 0]])})
    found = reconcile.products(lr, hr)
    of_means_and_whole = (found.comparable[0], found.comparable[-1], found.opposed[0], found.opposed[-1])
    assert deferred.read(of_means_and_whole) == [3, 3, 1, 1]


def test_no_gaussians_have_weights_too(passes):
    """Such a table has no strides to tell its forms apart by."""
    none = Grads(drawn(1, SHAPES, n=0))
    for weights in (Weights(torch.ones(0), torch.ones(0, 6)), GCO().reconcile(reconcile.products(none, none), None)):
        out = {name: torch.empty(0, *shape) for name, shape in SHAPES.items()}
        assert reconcile.apply(out, none, none, weights)


@pytest.mark.parametrize("wrong", [torch.ones(N - 1), torch.ones(1), torch.ones(N, 1), torch.ones(N, 7), torch.ones(6)])
def test_weights_of_other_shapes_are_refused(passes, wrong):
    g = Grads(drawn(1, ["means"]))
    for weights in (Weights(keep=wrong), Weights(remove=wrong)):
        with pytest.raises(
            ValueError, match=r"Weights\.(keep|remove) must be a number, or a tensor \[1003\] or \[1003, 6\]"
        ):
            reconcile.apply({"means": torch.empty(N, 3)}, g, g, weights)


@pytest.mark.parametrize("names", [("means",), ("opacities", "sh0", "shN"), ("means", "quats", "scales", "detail")])
def test_frozen_attributes_stay_frozen(passes, names):
    made = conductor()
    params, before, hr, step = setting(torch.float32, names=names, accumulated=False, factors=False, scale=1.0)
    frozen = torch.nn.Parameter(torch.zeros(N, 2), requires_grad=False)
    ratios = merge_in_place(made, {**params, "frozen": frozen}, hr, step, T, before=before)
    assert frozen.grad is None
    assert set(ratios) == {*names} - {"detail"} | {"gaussian"}
    assert all(p.grad is not None and p.grad.isfinite().all() for p in params.values())


def test_without_hr_the_authentic_gradient_passes_and_that_of_f_det_is_zero(passes):
    params, before, *_ = setting(torch.float32, accumulated=False, factors=False, scale=1.0)
    expected = {name: p.grad.clone() for name, p in params.items() if name != "detail"}
    assert merge_in_place(conductor(), params, Grads(), None, T, before=before) == {}
    assert all(torch.equal(params[name].grad, g) for name, g in expected.items())
    assert not params["detail"].grad.any()


def test_half_precision_is_merged_in_float32(passes):
    merged, scale = [], 2.0**14  # without it the gradient is below what float16 holds
    for dtype in (torch.float16, torch.float32):
        params, before, hr, step = setting(torch.float32, accumulated=False, factors=True, scale=scale)
        g = params["shN"].grad.to(torch.float16)
        params["shN"] = torch.nn.Parameter(params["shN"].detach().to(dtype))
        params["shN"].grad = held = g.to(dtype)
        merge_in_place(conductor(), params, hr, step, T, before=before, scale=scale)
        merged.append(params["shN"].grad)
        assert merged[-1] is held  # which a loop may hold, too
    assert merged[0].dtype == torch.float16
    assert torch.allclose(merged[0].float(), merged[1], rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(
    ("side", "hint"),
    [("lr", r" \(that of HR is finite: look at the loop's own loss, and at the answers of GCO, .* SVS\)"), ("hr", "")],
)
def test_what_is_not_finite_is_refused_but_under_a_gradient_scaler(side, hint):
    params, before, hr, step = setting(torch.float32, accumulated=False, factors=False, scale=1.0)
    (params["scales"].grad if side == "lr" else hr["scales"])[17, 1] = torch.nan
    run = partial(merge_in_place, conductor(), params, hr, step, T, before=before)
    run(loss_scale=lambda: 1.0)
    where = f"the merged gradient{hint} of scales"
    with pytest.raises(DivergedError, match=f"{where} is not finite for 1 Gaussian, first Gaussian 17"):
        run()


def moved(params, before, hr, step, *, device: str):
    """The same setting on another device."""
    there = {name: torch.nn.Parameter(p.detach().to(device)) for name, p in params.items()}
    for name, p in params.items():
        there[name].grad = None if p.grad is None else p.grad.to(device)
    evidence = Evidence(*(x.to(device) for x in (step.evidence.reliability, step.evidence.demand)))
    colour = None if hr.colour is None else Colour(*(x.to(device) for x in hr.colour))
    grads = Grads({name: g.to(device) for name, g in hr.items()}, colour=colour)
    before = {name: g.to(device) for name, g in before.items()}
    return there, before, grads, toy.step(T, evidence)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@pytest.mark.parametrize("factors", [False, True])
def test_cuda_agrees_with_float64(factors):
    results = []
    for dtype, device in ((torch.float32, "cuda"), (torch.float64, "cpu")):
        made = conductor()
        made.on_fit_start(3, 0, device)
        params, before, hr, step = moved(*setting(dtype, accumulated=True, factors=factors, scale=0.5), device=device)
        ratios = deferred.resolve([dict(merge_in_place(made, params, hr, step, T, before=before, scale=0.5))])[0]
        results.append(({name: p.grad.double().cpu() for name, p in params.items()}, ratios))
    (merged, ratios), (exact, expected) = results
    for name, g in exact.items():
        assert (merged[name] - g).abs().max() <= 4e-6 * g.abs().max(), name
    assert ratios == pytest.approx(expected, abs=1e-9)


def operations(n: int, device: str = "cpu") -> Counter[str]:
    params, before, hr, step = moved(
        *setting(torch.float32, n=n, accumulated=False, factors=True, scale=1.0), device=device
    )
    merge_in_place(made := conductor(), params, hr, step, T, before=before)
    merge = merging(made, params, before=before)
    with toy.Operations() as done:
        merge(hr, step, T, 1.0)
    return +done.count


def test_the_number_of_operations_does_not_depend_on_that_of_gaussians(passes):
    few, many = operations(500), operations(20_000)
    assert few == many
    assert few.total() <= {"cpp": 22, "warp": 26, "reference": 300}[passes]


def test_on_a_device_nothing_is_read():
    found = operations(500, "meta")
    assert not found["_local_scalar_dense"]
    assert not found["nonzero"]
    assert found.total() <= 300


def test_parameters_whose_columns_lie_together_have_the_same_merged_gradients():
    grads = []
    for strided in (False, True):
        host = gsplat_host.Host()
        for name in ("means", "quats", "scales"):
            rows = host.splats[name].detach() + torch.linspace(0, 0.5, host.splats[name].shape[1])
            host.splats[name] = torch.nn.Parameter(rows.t().contiguous().t() if strided else rows)
        _, _, render = gsplat_host.started(GCO(), host=host)
        render().square().mean().backward()
        grads.append({name: host.splats[name].grad for name in ("means", "quats", "scales")})
        assert all(g.is_contiguous() != strided for g in grads[-1].values())
    for name, g in grads[0].items():
        torch.testing.assert_close(grads[1][name], g)


class PulledByTheMeans(Strategy):
    """Adds a gradient of one parameter that follows from another."""

    def regularize(self, params, t):
        return {"scales": params["means"]}


def test_a_strategy_reads_parameters_that_the_loop_has_frozen():
    def gradients(*strategies):
        host, _, render = gsplat_host.started(*strategies)
        host.splats["means"].requires_grad_(False)
        render().mean().backward()
        return host.splats

    alone, pulled = gradients(), gradients(PulledByTheMeans())
    assert pulled["means"].grad is None
    torch.testing.assert_close(pulled["scales"].grad, alone["scales"].grad + pulled["means"])
