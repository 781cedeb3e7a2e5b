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


@pytest.mark.parametrize(("q", "omega"), [(None, 0.55 / 0.95), (0.0, 0.55 / 0.95), (0.5, 0.275 / 0.95), (1.0, 0.05)])
def test_values_worked_out_by_hand_which_reliability_softens_down_to_the_lower_bound(q, omega):
    # l = (1, 0, 0), h = (-3, 4, 0): c = -3/5, d = -3 + 0.05·5 = -2.75, s = (0.6 - 0.05) / 0.95.
    l, h = torch.tensor([1.0, 0, 0]), torch.tensor([-3.0, 4, 0])
    step = None if q is None else toy.step(evidence=Evidence(torch.tensor([q]), torch.tensor([1.0])))
    result = GCO(keep_length=False).correct(grads("means", l), grads("means", h), step)["means"][0]
    assert result.tolist() == pytest.approx([-3 + omega * 2.75, 4, 0], rel=1e-6)


def test_without_evidence_it_says_once_that_lr_prevails(caplog):
    """As the paper has it, an opposite HR gradient keeps 1 - 0.75 * 0.95 of its length, whichever of the two is longer."""
    caplog.set_level("INFO")
    lr, gco = Grads({"means": torch.tensor([[2.0, 0, 0], [0.5, 0, 0]])}), GCO(keep_length=False)
    hr = Grads({"means": torch.tensor([[-1.0, 0, 0], [-4.0, 0, 0]])})
    gco.correct(lr, hr, toy.step(evidence=Evidence(torch.zeros(2), torch.ones(2))))
    GCO(drop=True, keep_length=False).correct(lr, hr)  # no length is kept of what is dropped
    assert torch.equal(GCO().correct(lr, hr)["means"], hr["means"])  # exactly opposite, so that nothing turns it
    assert not caplog.messages
    for t in (1, 2):
        left = gco.correct(lr, hr, toy.step(t))["means"][:, 0] / hr["means"][:, 0]
        assert left.tolist() == pytest.approx([0.2875, 0.2875], rel=1e-6)
        GCO(groups=["sh0"]).correct(lr, hr)
    without, *others = caplog.messages
    assert "GCO corrects without evidence" in without
    assert ["compares sh0, and both scales have a gradient of means alone" in message for message in others] == [
        True
    ] * 2


@pytest.mark.parametrize("whole", [False, True])
def test_opacities_alone_are_told_to_pass_without_evidence(whole, caplog):
    gco, (lr, hr) = GCO(groups=["opacities"], whole=whole), random_pair(0)
    for _ in range(2):
        torch.testing.assert_close(gco.correct(lr, hr)["opacities"], hr["opacities"])
    (told,) = caplog.messages
    assert "GCO has no effect: an opacity is one number" in told
    GCO(groups=["opacities"], whole=whole, drop=True).correct(lr, hr)
    GCO(groups=["opacities"], whole=whole, keep_length=False).correct(lr, hr)
    GCO(groups=["opacities", "sh0"], whole=whole).correct(lr, hr)
    gco.correct(lr, hr, toy.step(evidence=Evidence(torch.zeros(200), torch.ones(200))))
    assert caplog.messages == [told]


@pytest.mark.parametrize("group", CONFLICT_GROUPS)
def test_without_evidence_what_is_turned_keeps_its_length_and_with_evidence_it_is_the_papers(group):
    lr, hr = random_pair(3)
    turned, shortened = (GCO(keep_length=kept).correct(lr, hr)[group].reshape(200, -1) for kept in (True, False))
    h = hr[group].reshape(200, -1)
    assert torch.allclose(turned.norm(dim=1), h.norm(dim=1), rtol=1e-6)
    assert (shortened.norm(dim=1) < 0.99 * h.norm(dim=1)).any()
    assert torch.allclose(torch.cosine_similarity(turned, shortened, dim=1), torch.ones(200))
    step = toy.step(evidence=Evidence(torch.linspace(0, 1, 200), torch.ones(200)))
    assert torch.equal(*(GCO(keep_length=kept).correct(lr, hr, step)[group] for kept in (True, False)))


def by_the_equations(
    lr: Grads, hr: Grads, group: str, q: Tensor, s: GCO, *, keeps_length: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Eq. 6, 7 and 11 of a group in float64: the corrected rows, their scale, which of them conflict, and ω."""
    compared = s.groups if s.whole else [group]
    l, h = (torch.cat([g[k].double().reshape(len(q), -1) for k in compared], 1) for g in (lr, hr))
    l_norm, h_norm = l.norm(dim=1), h.norm(dim=1)
    c = (l * h).sum(1) / (l_norm * h_norm)  # Eq. 6
    conflicts = (c < -s.tolerance) & (group in s.groups)
    ω = ((-c - s.tolerance) / (1 - s.tolerance) * (1 - q)).clamp(s.weight_min, s.weight_max)  # Eq. 11
    factor = (ω * (c + s.tolerance) * h_norm / l_norm)[:, None]
    left = (h - factor * l).norm(dim=1) / h_norm
    scale = 1 / left.clamp_min(2.0**-10) if keeps_length else torch.ones_like(left)
    l, h = (g[group].double().reshape(len(q), -1) for g in (lr, hr))
    corrected = scale[:, None] * (h - factor * l)  # Eq. 7
    return torch.where(conflicts[:, None], 0.0 if s.drop else corrected, h), scale, conflicts, ω


@given(
    seed=st.integers(0, 10_000), tolerance=st.floats(0, 0.9), bounds=st.tuples(st.floats(0, 1), st.floats(0, 1)),
    groups=st.lists(st.sampled_from(CONFLICT_GROUPS), min_size=1, unique=True), whole=st.booleans(), drop=st.booleans(),
    has_evidence=st.booleans(), keep_length=st.booleans(),
)  # fmt: skip
@settings(max_examples=60, deadline=None)
def test_the_correction_is_that_of_the_equations_for_any_settings_and_logs_what_it_did(
    seed, tolerance, bounds, groups, whole, drop, has_evidence, keep_length
):
    n, (lr, hr) = 60, random_pair(seed, n=60)
    gco = GCO(tolerance, min(bounds), max(bounds), groups, whole=whole, drop=drop, keep_length=keep_length)
    q = torch.rand(n, generator=torch.Generator().manual_seed(seed)) if has_evidence else torch.zeros(n)
    before = {name: value.clone() for name, value in lr.items()}
    result = gco.correct(lr, hr, toy.step(evidence=Evidence(q, torch.ones(n)) if has_evidence else None))
    of_all = []
    for group in CONFLICT_GROUPS:
        kept = keep_length and not has_evidence
        expected, scale, conflicts, ω = by_the_equations(lr, hr, group, q.double(), gco, keeps_length=kept)
        if group == "opacities" and kept and not (whole or drop):  # opposite numbers of a kept length
            conflicts = conflicts & False
        found = result[group].reshape(n, -1)
        size = expected.norm(dim=1) + scale * hr[group].double().reshape(n, -1).norm(dim=1)
        assert ((found - expected).norm(dim=1) <= 1e-6 * size).all(), group
        assert torch.equal(result[group][~conflicts], hr[group][~conflicts])
        assert torch.equal(lr[group], before[group])
        if group in groups:
            of_all.append((conflicts, ω))
            assert read(gco, f"corrected_{group}") == pytest.approx(float(conflicts.double().mean()))
    conflicts, ω = map(torch.cat, zip(*of_all, strict=True))
    assert read(gco, "corrected") == pytest.approx(float(conflicts.double().mean()))
    assert read(gco, "mean_omega") == pytest.approx(float(ω[conflicts].mean()), rel=1e-6, nan_ok=True)
    assert ("omega_at_lower_bound" in gco.logs) == (has_evidence and gco.weight_min > 0)
    if "omega_at_lower_bound" in gco.logs:
        lowest = (ω[conflicts] <= gco.weight_min).double().mean()
        assert read(gco, "omega_at_lower_bound") == pytest.approx(float(lowest), nan_ok=True)


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
    assert [GCO().correct({}, {"means": g}), GCO().correct({"means": g}, {})] == [{"means": g}, {}]
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
