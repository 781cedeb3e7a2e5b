"""SVS: Eq. 15 and 16."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies import SVS, AnchorError, Conductor
from clear_strategies.core.seeds import dropout_mask, generator_at, hashed_generator_at
from clear_strategies.schedules import Ramp
from clear_strategies.training.field import GaussianField
from tests.helpers import toy

# The paper's reading (conf/readings/paper.yaml).
PAPER_WEIGHTS = {
    "means": 1.0, "scales": 1.0, "quats": 1.0, "opacities": 0.1, "sh0": 0.01, "shN": 0.01, "detail": 0.0,
}  # fmt: skip


@given(p=st.floats(0, 0.95), seed=st.integers(0, 2**31), t=st.integers(1, 10_000))
@settings(max_examples=50, deadline=None)
def test_mask_is_zero_or_the_inverse_keep_rate(p, seed, t):
    z = dropout_mask(500, p, seed, t)
    assert bool(((z == 0) | ((z * (1 - p) - 1).abs() < 1e-5)).all())
    assert torch.equal(z, dropout_mask(500, p, seed, t))


def test_the_mask_has_its_rate_which_ramps_linearly_and_changes_with_seed_and_iteration():
    assert float((dropout_mask(100_000, 0.2, 0, 1) == 0).float().mean()) == pytest.approx(0.2, abs=0.005)
    assert not torch.equal(dropout_mask(1000, 0.2, 0, 1), dropout_mask(1000, 0.2, 0, 2))
    assert not torch.equal(dropout_mask(1000, 0.2, 0, 1), dropout_mask(1000, 0.2, 1, 1))
    ramp = Ramp(maximum=0.2, full=100)
    assert [ramp(0), ramp(50), ramp(100), ramp(200)] == pytest.approx([0, 0.1, 0.2, 0.2])
    assert SVS(dropout=Ramp(maximum=0.0)).gate(5, 10) is None
    svs = started(0, dropout=Ramp(0.2, "constant", full=400), looks=1_000)
    assert kept_share(svs, 400) == pytest.approx(1 - 0.08, abs=4e-3)


def test_both_scales_lose_the_gaussians_of_a_mask_and_each_those_of_its_own_if_there_are_two():
    svs, scene = started(looks=0, shared=False), toy.scene()
    field = GaussianField.from_cloud(scene.cloud)
    z = Conductor(svs).gate(10_000, len(field))
    assert torch.equal(z[0], started(looks=0).gate(10_000, len(field)))
    assert not torch.equal(z[0], z[1])
    for k, shot in enumerate(field.render_scales(toy.RASTERIZER, scene.train[0], gate=z)):
        both = field.render_scales(toy.RASTERIZER, scene.train[0], gate=z[k])
        assert not any(of_scale.visible[z[k] == 0].any() for of_scale in both)
        alone = both[k]
        assert alone.visible.any()
        assert torch.equal(shot.image, alone.image)
        (grads,), (expected,) = (s.vjp(torch.ones(1, *s.image.shape)) for s in (shot, alone))
        assert all(torch.equal(g, expected[name]) for name, g in grads.items())


def started(n_views=3, **settings):
    svs = SVS(**settings)
    svs.on_fit_start(n_views, 0)
    return svs


def kept_share(svs, t):
    return float((svs.gate(t, 100_000) > 0).float().mean())


def params(n=20, seed=0):
    g = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(n, 3, generator=g), "scales": torch.randn(n, 3, generator=g),
        "opacities": torch.randn(n, generator=g), "detail": torch.randn(n, 3, generator=g),
    }  # fmt: skip


@pytest.mark.parametrize(("n_views", "rate"), [(2, 0.2), (4, 0.2), (8, 0.1), (80, 0.01)])
def test_the_rate_falls_with_the_looks_at_each_view(n_views, rate, caplog):
    caplog.set_level("DEBUG")
    for looks, expected in ((1_000, 1 - rate), (0, 0.8)):  # 0: as published
        svs = started(n_views, dropout=Ramp(0.2, full=4_000), looks=looks)
        assert kept_share(svs, 4_000) == pytest.approx(expected, abs=4e-3)
    assert [f"dropout rises to {rate:.3f} instead of 0.200" in message for message in caplog.messages] == [True] * (
        rate < 0.2
    )


def test_a_rate_that_the_looks_lower_to_nothing_is_told(caplog):
    assert started(dropout=Ramp(0.2, full=0)).gate(100, 5) is None
    assert "SVS drops nothing" in caplog.text
    caplog.clear()
    assert kept_share(started(dropout=Ramp(0.2, full=0), looks=0), 1) == pytest.approx(0.8, abs=4e-3)
    assert started(dropout=Ramp(0.0, full=0)).gate(1, 5) is None
    assert not caplog.text


def test_anchor_pulls_back_with_twice_the_weighted_distance():
    svs = started(anchor_start=10, anchor_strength=0.01, anchor_weights={"scales": 0.5, "opacities": 0.1})
    theta = params()
    svs.after_step(theta, toy.step(9))
    assert svs.regularize(theta, 10) is None
    svs.after_step(theta, toy.step(10))
    assert all(not g.any() for g in svs.regularize(theta, 11).values())
    moved = {name: value + 0.3 for name, value in theta.items()}
    g = svs.regularize(moved, 11)
    assert set(g) == {"scales", "opacities"}
    assert torch.allclose(g["scales"], torch.full((20, 3), 2 * 0.01 * 0.5 * 0.3), atol=1e-7)
    assert torch.allclose(g["opacities"], torch.full((20,), 2 * 0.01 * 0.1 * 0.3), atol=1e-7)


def test_anchored_positions_do_not_depend_on_the_unit_of_the_world_and_the_mean_divides_by_the_number():
    loads = started(anchor_start=1, anchor_strength=0.01, anchor_weights=PAPER_WEIGHTS)
    for unit in (1.0, 1000.0):
        svs = started(anchor_start=1, anchor_strength=0.01, anchor_weights=PAPER_WEIGHTS)
        theta = params()
        theta["means"] = theta["means"] * unit
        svs.after_step(theta, toy.step(1))
        Conductor(loads).load_state_dict({f"SVS.{name}": p for name, p in theta.items()})
        theta["means"] = theta["means"] * 1.1
        vjp = svs.regularize(theta, 2)["means"] * unit  # ∂/∂(x / unit)
        assert torch.equal(loads.regularize(theta, 2)["means"] * unit, vjp)
        if unit == 1.0:
            expected = vjp
    assert torch.allclose(vjp, expected, rtol=1e-4)
    svs = started(anchor_start=1, anchor_strength=0.01, anchor_weights=PAPER_WEIGHTS)
    svs.after_step({"means": torch.ones(20, 3)}, toy.step(1))  # a cloud without extent
    assert svs.regularize({"means": torch.full((20, 3), 1.0)}, 2)["means"].isfinite().all()
    pulls = []
    for reduction in ("sum", "mean"):
        svs = started(anchor_start=1, anchor_strength=0.01, anchor_weights=PAPER_WEIGHTS, reduction=reduction)
        theta = params()
        svs.after_step(theta, toy.step(1))
        theta["scales"] = theta["scales"] + 1
        pulls.append(svs.regularize(theta, 2)["scales"])
    assert torch.allclose(pulls[0], pulls[1] * 20)


def test_densification_ends_when_the_anchor_is_taken_once_whatever_a_skip_jumped_over():
    assert [SVS(anchor_start=10).may_densify(t) for t in (9, 10)] == [True, False]
    svs = started(anchor_start=5, anchor_strength=0.01)
    svs.after_step(params(), toy.step(4))
    assert not svs.state
    at_seven = params()
    svs.after_step(at_seven, toy.step(7))
    svs.after_step({name: p + 1 for name, p in at_seven.items()}, toy.step(8))
    assert torch.equal(svs.state["means"], at_seven["means"])
    svs.on_resize(torch.arange(20).flip(0))
    assert torch.equal(svs.state["means"], at_seven["means"].flip(0))
    without = started(anchor_start=5, anchor_strength=0.0)
    without.after_step(at_seven, toy.step(7))
    assert not without.state


def test_a_changed_number_of_gaussians_under_an_anchor_is_an_error():
    svs = started(anchor_start=5, anchor_strength=0.01)
    svs.after_step(params(), toy.step(5))
    with pytest.raises(AnchorError, match="t=5 for 20 Gaussians, now there are 21"):
        svs.regularize(params(21), 6)
    with pytest.raises(AnchorError, match="Stop densification at t_a"):
        svs.on_resize(torch.arange(19))


@pytest.mark.parametrize("at", [generator_at, hashed_generator_at])
@pytest.mark.parametrize("seed", [0, 20261126014022, 2**63, -1])
def test_any_whole_number_is_a_seed(at, seed):
    first, again, next_t = (torch.rand(4, generator=at(seed, t)) for t in (7, 7, 8))
    assert torch.equal(first, again)
    assert not torch.equal(first, next_t)
