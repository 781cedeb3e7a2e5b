"""Densification in hosts: the tensor of the score, its scale, what a 3DGS-style densifier reads, and where it ends."""

import importlib
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clear_strategies import GCO, P2G, SVS, Conductor, Strategy
from clear_strategies.errors import SettingError
from integration.autograd_shot import ScreenGradientSlot
from integration.densification import ScoreScaler, end_with_strategies, require_end, score_for_host
from integration.inria import attach
from tests.helpers import gsplat_host
from tests.helpers.host_parts import HR_FROM_START, WITHOUT_HR, N, options


# ---- the tensor in which a host keeps the screen gradient
@pytest.mark.parametrize("to_pixels", [(1.0, 1.0), (2 / 200, 2 / 100)], ids=["gsplat", "inria"])
def test_written_norms_are_in_ndc(to_pixels):
    tensor = torch.zeros(1, 3, 2, requires_grad=True)
    slot = ScreenGradientSlot(tensor, (200, 100), to_pixels)
    slot.write(torch.tensor([0.5, 0.0, 2.0]))
    pixels = slot.per_gaussian(tensor.grad, 3)
    assert torch.allclose((pixels * torch.tensor([100.0, 50.0])).norm(dim=1), torch.tensor([0.5, 0.0, 2.0]))


def test_packed_rows_are_those_of_their_gaussians_and_gsplats_absolute_gradient_is_written_too():
    tensor = torch.zeros(2, 2, requires_grad=True)
    slot = ScreenGradientSlot(tensor, (2, 2), rows=torch.tensor([3, 1]))
    assert slot.per_gaussian(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), 4).tolist() == [[0, 0], [3, 4], [0, 0], [1, 2]]
    slot.write(torch.tensor([9.0, 5.0, 9.0, 7.0]))
    assert tensor.grad.tolist() == [[7, 0], [5, 0]]
    tensor = torch.zeros(1, 2, 2, requires_grad=True)
    tensor.absgrad = torch.ones(1, 2, 2)
    ScreenGradientSlot(tensor, (2, 2)).write(torch.tensor([1.0, 2.0]))
    assert tensor.absgrad[0, :, 0].tolist() == [1, 2]


# ---- the score at the scale of a host's threshold
def everyone(n):
    return torch.ones(n, dtype=torch.bool)


@given(seed=st.integers(0, 1_000), smaller=st.floats(3, 30))
@settings(max_examples=30, deadline=None)
def test_as_many_pass_as_by_the_ordinary_statistic_and_in_the_scores_order(seed, smaller):
    g = torch.Generator().manual_seed(seed)
    ordinary, score = torch.rand(50, generator=g) * 1e-3, torch.rand(50, generator=g) * 1e-3 / smaller
    scaled = ScoreScaler(threshold=5e-4)(score, ordinary, everyone(50))
    passing = int((ordinary >= 5e-4).sum())
    assert int((scaled >= 5e-4).sum()) == passing
    assert set((scaled >= 5e-4).nonzero()[:, 0].tolist()) == set(score.argsort(descending=True)[:passing].tolist())


def test_a_gaussian_counts_in_the_views_that_see_it():
    """Half of all is above the threshold where it is seen, every other time: its mean is that of these views."""
    scaler, half = ScoreScaler(threshold=1.0, half_life=1_000), torch.arange(8) < 4
    ordinary, score = torch.where(half, 1.5, 0.5), torch.where(half, 0.4, 0.2)
    for i in range(11):
        hidden = half & (i % 2 == 1)
        scaled = scaler(torch.where(hidden, 0.1, score), torch.where(hidden, 0.1, ordinary), ~hidden)
    assert ((scaled >= 1) == half).all()


def test_none_passes_without_a_score_and_absolute_gradients_decide_how_many_pass_with_one():
    scaled = ScoreScaler(threshold=1.0)(torch.rand(20) * 100, torch.rand(20) * 0.5, everyone(20))
    assert float(scaled.max()) < 1
    zeros = torch.zeros(5)
    assert torch.equal(ScoreScaler(threshold=1.0)(zeros, torch.ones(5) * 2, everyone(5)), zeros)
    tensor = torch.zeros(1, 4, 2)
    slot = ScreenGradientSlot(tensor, (2, 2))
    ordinary, score = torch.full((4,), 0.1), torch.tensor([0.4, 0.1, 0.3, 0.2])
    for scale in (1.0, 64.0):
        tensor.absgrad = scale * torch.tensor([[[8.0, 0], [6, 0], [1, 0], [0, 0]]])  # 2x2 pixels: the same in NDC
        assert score_for_host(slot, ordinary, ordinary, everyone(4), ScoreScaler(5.0), scale) is None
        written = score_for_host(slot, score, ordinary, everyone(4), ScoreScaler(5.0), scale)
        assert (written >= 5).tolist() == [True, False, True, False]  # two pass, as by 8 and 6


def test_the_factor_follows_recent_views_restarts_with_another_number_of_gaussians_and_is_restored():
    scaler = ScoreScaler(threshold=1.0, half_life=2)
    ordinary, score = torch.tensor([2.0, 2.0, 0.5, 0.5]), torch.tensor([4.0, 3.0, 2.0, 1.0])
    first = scaler(score, ordinary, everyone(4))
    assert (first >= 1).tolist() == [True, True, False, False]
    for _ in range(30):  # the score falls to a hundredth
        last = scaler(score / 100, ordinary, everyone(4))
    assert (last >= 1).tolist() == [True, True, False, False]
    assert len(scaler(torch.ones(7), torch.ones(7), everyone(7))) == 7
    views = [(torch.rand(9) / 9, torch.rand(9)) for _ in range(25)]
    whole, first, resumed = (ScoreScaler(threshold=0.5) for _ in range(3))
    for score, ordinary in views[:15]:
        first(score, ordinary, everyone(9))
    resumed.load_state_dict(first.state_dict())
    last = [
        [scaler(*view, everyone(9)) for view in part][-1] for scaler, part in ((whole, views), (resumed, views[15:]))
    ]
    assert torch.equal(*last)
    assert resumed.factor != 1


# ---- a 3DGS-style loop
def screen_gradient(host, render, camera, gaussians, **settings):
    """What the densifier reads after a step's backward pass."""
    package = render(camera, gaussians, None, None, **settings)
    host.photometric(package["render"], camera.original_image).backward()
    return package["viewspace_points"].grad


@pytest.mark.parametrize(
    ("strategies", "threshold"),
    [((), 2e-4), ((GCO(),), 2e-4), ((P2G(patch=4),), None)],
    ids=["baseline", "gco", "unknown"],
)
def test_without_a_score_or_a_threshold_the_densifier_reads_its_own_statistic(
    strategies, threshold, inria_host, inria_attached, caplog
):
    """Its threshold is meant for the gradient of the photo; with HR's gradient added, every host would grow more."""
    clear, gaussians, scene = inria_attached(*strategies, threshold=threshold)
    assert ("(gsplat's grow_grad2d, 3DGS's opt.densify_grad_threshold)" in caplog.text) == (threshold is None)
    renders = inria_host.render, clear.wrap(inria_host.render)
    read = [screen_gradient(inria_host, render, scene.cameras[0], gaussians) for render in renders]
    assert clear.attachment.counts["HR renders"] == 1
    assert torch.equal(*read)


def test_with_a_score_as_many_gaussians_pass_the_threshold_as_by_the_hosts_statistic(inria_host, inria_capture):
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    own = screen_gradient(inria_host, inria_host.render, scene.cameras[0], gaussians)[:, :2].norm(dim=1)
    threshold = float(own.sort(descending=True).values[6:8].mean())  # 7 of 24 pass
    clear = attach(
        gaussians, scene.cameras, Conductor(P2G(patch=4), objective=HR_FROM_START), sr=inria_capture / "sr",
        threshold=threshold,
    )  # fmt: skip
    written = screen_gradient(inria_host, clear.wrap(inria_host.render), scene.cameras[0], gaussians)[:, :2].norm(dim=1)
    assert int((written >= threshold).sum()) == int((own >= threshold).sum()) == 7
    assert not torch.allclose(written, own)


def test_mip_splattings_third_column_holds_the_score_too(inria_host, inria_attached, monkeypatch):
    """It splits as many Gaussians by the largest absolute gradients as by the gradient, so it must rank by the score."""
    monkeypatch.setattr(importlib.import_module("gaussian_renderer"), "ABSOLUTE", True)
    clear, gaussians, scene = inria_attached(P2G(patch=4))
    gaussians.xyz_gradient_accum_abs = torch.zeros(N, 1)
    gradient = screen_gradient(inria_host, clear.wrap(inria_host.render), scene.cameras[0], gaussians)
    assert torch.equal(gradient[:, 2], gradient[:, 0])
    assert float(gradient[:, 2].max()) > 0


def test_the_score_goes_to_the_tensor_of_the_rendering_that_the_densifier_reads(inria_host, inria_attached):
    """In Deformable 3DGS it is not viewspace_points, which is known from the first time on."""

    def render(*args, **kwargs):
        package = inria_host.render(*args, **kwargs)
        other = torch.zeros(N, 3, requires_grad=True)
        image = package["render"] + 0 * other.sum()
        return {**package, "render": image, "viewspace_points": other, "read": package["viewspace_points"]}

    clear, gaussians, scene = inria_attached(P2G(patch=4))
    for _ in range(2):
        package = clear.wrap(render)(scene.cameras[0], gaussians, None, None)
        inria_host.photometric(package["render"], scene.cameras[0].original_image).backward()
        gaussians.add_densification_stats(package["read"], package["visibility_filter"])
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad()
    assert package["read"].grad[:, 0].any()
    assert not package["read"].grad[:, 1].any()
    clear.wrap(inria_host.render)(scene.cameras[0], gaussians, None, None)  # another function's rendering lacks it


def test_mip_splattings_filter_is_that_of_the_hr_cameras(inria_host, inria_capture, monkeypatch):
    """With that of the LR cameras, no Gaussian could be as thin as what the SR images show."""
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    widths = []
    compute = lambda model, cameras: widths.append([camera.image_width for camera in cameras])  # noqa: E731
    monkeypatch.setattr(type(gaussians), "compute_3D_filter", compute, raising=False)
    clear = attach(gaussians, scene.cameras, Conductor(objective=HR_FROM_START), sr=inria_capture / "sr")
    gaussians.compute_3D_filter(cameras=scene.cameras)
    clear.remove()
    gaussians.compute_3D_filter(scene.cameras)
    attach(gaussians, scene.cameras, Conductor(objective=WITHOUT_HR))
    gaussians.compute_3D_filter(scene.cameras)
    assert widths == [[96] * 3, [24] * 3, [24] * 3]
    assert scene.cameras[0].image_width == 24


def test_a_host_that_relocates_by_opacity_does_not_read_the_score(inria_host, inria_capture, caplog):
    gaussians, scene = inria_host.setup(options(inria_host, inria_capture))
    gaussians.relocate_gs = lambda dead_mask: None
    attach(gaussians, scene.cameras, Conductor(P2G(patch=4), objective=HR_FROM_START), sr=inria_capture / "sr")
    assert "relocates" not in caplog.text
    for _ in range(2):
        gaussians.relocate_gs(dead_mask=torch.zeros(N, dtype=torch.bool))
    assert caplog.text.count("the densification score of P2G has no effect") == 1


def test_absolute_gradients_stay_the_hosts_own(inria_host, caplog, inria_attached):
    clear, gaussians, scene = inria_attached(P2G(patch=4))
    renders = inria_host.render, clear.wrap(inria_host.render)
    grads = [screen_gradient(inria_host, render, scene.cameras[0], gaussians, columns=4) for render in renders]
    assert torch.equal(grads[0][:, 2:], grads[1][:, 2:])
    assert not torch.equal(grads[0][:, :2], grads[1][:, :2])
    assert "4 columns" in caplog.text


@dataclass(frozen=True)
class Late(Strategy):
    """Forbids densification outside of [first, last)."""

    first: int
    last: int

    def may_densify(self, t):
        return self.first <= t < self.last


@pytest.mark.parametrize("first", [0, 1])
def test_it_is_the_first_iteration_after_the_last_that_is_allowed(first, caplog):
    settings = SimpleNamespace(until=100)
    with caplog.at_level("INFO"):
        end_with_strategies(Conductor(Late(20, 60)), settings, "until", first)
    assert settings.until == 60 + first
    assert f"densification ends at until={60 + first} instead of 100 (Late)" in caplog.text
    assert (
        f"Late forbids densification at 20 of the iterations before {60 + first}, the first is {first}" in caplog.text
    )


def test_a_strategy_that_never_allows_it_is_named(caplog):
    require_end(Conductor(Late(0, 1)), 100, "until", first=0)
    assert "but Late ends densification at 0" in caplog.text


def test_without_such_a_strategy_nothing_changes(caplog):
    settings = SimpleNamespace(until=100)
    end_with_strategies(Conductor(SVS()), settings, "until")
    require_end(Conductor(Late(0, 1_000)), 100, "until")
    assert settings.until == 100
    assert not caplog.text


@pytest.mark.parametrize("host", ["gsplat", "inria"])
def test_a_host_that_would_densify_after_the_anchor_is_refused_before_the_first_step(host, request):
    early = SVS(anchor_start=5, anchor_strength=0.01)
    if host == "gsplat":
        strategy = SimpleNamespace(refine_stop_iter=24, grow_grad2d=2e-4)
        with pytest.raises(SettingError, match=r"before the anchor is taken, got 24. Set refine_stop_iter=5"):
            gsplat_host.started(early, strategy=strategy)
    else:
        with pytest.raises(SettingError, match=r"before the anchor is taken, got 24. Set densify_until_iter=6"):
            request.getfixturevalue("inria_attached")(early, densify_until=24)
