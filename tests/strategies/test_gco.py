"""GCO: Eq. 6, 7 and 11 by property and by hand-computed values."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from clear_strategies import CONFLICT_GROUPS, GCO, Evidence, Grads
from tests.helpers import toy

WIDTHS = {"means": (3,), "sh0": (1, 3), "shN": (15, 3), "opacities": (), "scales": (3,), "quats": (4,)}


def grads(group: str, *rows: Tensor) -> Grads:
    return Grads({group: torch.stack(rows).view(len(rows), *WIDTHS[group])})


def random_pair(seed: int, n: int = 200, norm_lr: float = 1.0, norm_hr: float = 1.0) -> tuple[Grads, Grads]:
    g = torch.Generator().manual_seed(seed)
    lr = Grads({name: norm_lr * torch.randn(n, *shape, generator=g) for name, shape in WIDTHS.items()})
    hr = Grads({name: norm_hr * torch.randn(n, *shape, generator=g) for name, shape in WIDTHS.items()})
    return lr, hr


def read(gco: GCO, name: str) -> float:
    return gco.logs[name]()


def dot(a: Tensor, b: Tensor) -> Tensor:
    return (a.double() * b.double()).flatten(1).sum(1) if a.dim() > 1 else a.double() * b.double()


@pytest.mark.parametrize(("q", "omega"), [(None, 0.55 / 0.95), (0.0, 0.55 / 0.95), (0.5, 0.275 / 0.95), (1.0, 0.05)])
def test_values_worked_out_by_hand_which_reliability_softens_down_to_the_lower_bound(q, omega):
    # l = (1, 0, 0), h = (-3, 4, 0): c = -3/5, d = -3 + 0.05·5 = -2.75, s = (0.6 - 0.05) / 0.95.
    l, h = torch.tensor([1.0, 0, 0]), torch.tensor([-3.0, 4, 0])
    step = None if q is None else toy.step(evidence=Evidence(torch.tensor([q]), torch.tensor([1.0])))
    result = GCO().correct(grads("means", l), grads("means", h), step)["means"][0]
    assert result.tolist() == pytest.approx([-3 + omega * 2.75, 4, 0], rel=1e-6)


def test_opposite_gradients_are_corrected_up_to_the_upper_bound_and_agreeing_ones_to_the_lower():
    result = GCO().correct(Grads({"opacities": torch.tensor([2.0])}), Grads({"opacities": torch.tensor([-1.0])}), None)
    # c = -1, s = 1 -> ω = 0.75; d = -2 + 0.05·2 = -1.9; -1 + 0.75·1.9/4·2
    assert float(result["opacities"]) == pytest.approx(-1 + 0.75 * 1.9 / 2, rel=1e-6)
    lr, hr = random_pair(8)
    gco = GCO()
    gco.correct(lr, hr, toy.step(evidence=Evidence(torch.full((200,), 0.99), torch.ones(200))))
    assert read(gco, "mean_omega") == pytest.approx(0.05, abs=1e-3)
    assert read(gco, "omega_at_lower_bound") == 1
    gco.correct(lr, hr, toy.step(evidence=Evidence(torch.zeros(200), torch.ones(200))))
    assert read(gco, "omega_at_lower_bound") < 0.9


def test_without_evidence_it_says_once_that_lr_prevails(caplog):
    """An opposite HR gradient keeps 1 - 0.75 * 0.95 of its length, whichever of the two is longer."""
    caplog.set_level("INFO")
    lr, gco = Grads({"means": torch.tensor([[2.0, 0, 0], [0.5, 0, 0]])}), GCO()
    hr = Grads({"means": torch.tensor([[-1.0, 0, 0], [-4.0, 0, 0]])})
    gco.correct(lr, hr, toy.step(evidence=Evidence(torch.zeros(2), torch.ones(2))))
    assert not caplog.messages
    for t in (1, 2):
        left = gco.correct(lr, hr, toy.step(t))["means"][:, 0] / hr["means"][:, 0]
        assert left.tolist() == pytest.approx([0.2875, 0.2875], rel=1e-6)
    (message,) = caplog.messages
    assert "GCO corrects without evidence" in message


def test_what_the_paper_does_not_do_is_there_to_compare_with():
    """Of two groups one opposes: dropped, it is left out as a whole; as one Gaussian, both agree."""
    lr = Grads({"means": torch.tensor([[3.0, 0, 0]]), "scales": torch.tensor([[1.0, 0, 0]])})
    hr = Grads({"means": torch.tensor([[3.0, 0, 0]]), "scales": torch.tensor([[-1.0, 2, 0]])})
    dropped = GCO(drop=True).correct(lr, hr, None)
    assert torch.equal(dropped["means"], hr["means"])
    assert not dropped["scales"].any()
    together = GCO(whole=True).correct(lr, hr, None)  # 9 - 1 > 0
    assert all(torch.equal(together[name], hr[name]) for name in hr)
    opposed = GCO(whole=True, tolerance=0, weight_min=1, weight_max=1).correct(
        lr, Grads({n: -g for n, g in hr.items()}), None
    )
    assert sum(float(dot(opposed[name], lr[name])) for name in lr) == pytest.approx(0, abs=1e-6)  # the margin


@given(seed=st.integers(0, 10_000), tolerance=st.floats(0, 0.9))
@settings(max_examples=30, deadline=None)
def test_full_correction_lands_on_the_margin(seed, tolerance):
    lr, hr = random_pair(seed)
    whole = GCO(tolerance=tolerance, weight_min=1.0, weight_max=1.0).correct(lr, hr, None)
    for group in CONFLICT_GROUPS:
        if group == "quats":
            continue
        n = dot(lr[group], lr[group]).sqrt() * dot(hr[group], hr[group]).sqrt()
        conflict = dot(lr[group], hr[group]) < -(tolerance + 1e-9) * n
        after = dot(lr[group], whole[group])
        assert torch.allclose(after[conflict], -tolerance * n[conflict], rtol=1e-5, atol=float(n.max()) * 1e-6)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_only_conflicts_change_and_then_help_lr_without_lengthening_the_gradient(seed):
    lr, hr = random_pair(seed)
    before = {name: value.clone() for name, value in lr.items()}
    result = GCO().correct(lr, hr, None)
    for group in CONFLICT_GROUPS:
        c = dot(lr[group], hr[group]) / (dot(lr[group], lr[group]).sqrt() * dot(hr[group], hr[group]).sqrt())
        calm = c >= -0.05 + 1e-9
        assert torch.equal(result[group][calm], hr[group][calm])
        assert torch.equal(lr[group], before[group])
        assert (dot(result[group], lr[group]) >= dot(hr[group], lr[group]) - 1e-6).all()
        assert (dot(result[group], result[group]) <= dot(hr[group], hr[group]) * (1 + 1e-6)).all()


@given(seed=st.integers(0, 1_000), i=st.integers(-60, 60), j=st.integers(-60, 60))
@settings(max_examples=60, deadline=None)
def test_decisions_do_not_change_when_a_loss_is_scaled_by_a_power_of_two(seed, i, j):
    lr, hr = random_pair(seed, n=50)
    result = GCO().correct(lr, hr, None)
    scaled = GCO().correct(lr * 2.0**i, hr * 2.0**j, None)
    for group in CONFLICT_GROUPS:
        assert torch.equal(scaled[group], result[group] * 2.0**j), group


def test_zero_gradients_are_no_conflict_and_what_could_correct_nothing_is_refused():
    zero, some = torch.zeros(3), torch.tensor([1.0, 2, 3])
    for l, h in ((zero, some), (some, zero), (zero, zero)):
        result = GCO().correct(grads("means", l), grads("means", h), None)["means"]
        assert torch.equal(result[0], h)
        assert result.isfinite().all()
    g = torch.ones(2, 3)
    with pytest.raises(ValueError, match=r"groups means, .* are compared, .* lr has _xyz, hr has _xyz\. Name them so"):
        GCO().correct({"_xyz": g}, {"_xyz": -g})


@pytest.mark.parametrize("noisy", [("lr",), ("hr",), ("lr", "hr")], ids="+".join)
def test_a_rotation_gradient_that_is_rounding_at_one_scale_is_no_conflict(noisy):
    pair = dict(zip(("lr", "hr"), random_pair(5, norm_lr=1e-6, norm_hr=1e-6), strict=True))
    for scale in noisy:
        pair[scale]["quats"] = pair[scale]["quats"] * 1e-7
    gco = GCO()
    result = gco.correct(**pair, step=None)
    assert torch.equal(result["quats"], pair["hr"]["quats"])
    assert read(gco, "corrected_quats") == 0
    assert read(gco, "corrected_scales") > 0


def test_gradients_of_any_layout_and_of_two_types_are_corrected():
    lr, hr = random_pair(9)
    expected = GCO().correct(lr, hr)["means"]
    for dtype in (torch.float32, torch.float64):
        low, high = ({"means": g["means"].to(dtype)} for g in (lr, hr))
        turned = {"means": high["means"].T.contiguous().T}
        assert torch.equal(GCO().correct(low, turned)["means"], GCO().correct(low, high)["means"])
    mixed = GCO().correct({"means": lr["means"].double()}, {"means": hr["means"].float()})["means"]
    assert mixed.dtype == torch.float32
    assert torch.allclose(mixed.double(), expected.double(), rtol=1e-5)
