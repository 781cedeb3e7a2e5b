"""SplatSuRe's weights, worked out by hand."""

import math

import pytest
import torch

from clear_strategies import Grads, Photo, SplatSuRe, Step, View
from rasterizers import Camera


def camera(distance: float, focal: float = 10.0) -> Camera:
    """Looks along z at the origin from `distance`."""
    pose = torch.eye(4)
    pose[2, 3] = distance
    return Camera(pose, focal, focal, 4.0, 4.0, 8, 8)


def visit(strategy: SplatSuRe, name: str, distance: float, shown: list[bool], means=None) -> torch.Tensor:
    """One iteration of a view: the weights of its HR gradients."""
    photo = Photo(camera(distance), torch.zeros(8, 8, 3))
    step = Step(1, View(name, photo, photo), torch.tensor(shown))
    one = Grads({"opacities": torch.ones(len(shown))})
    corrected = strategy.correct(one, one, step)["opacities"]
    strategy.after_step({"means": torch.zeros(len(shown), 3) if means is None else means}, step)
    return corrected


def started(n_views: int = 3, **settings) -> SplatSuRe:
    strategy = SplatSuRe(**settings)
    strategy.on_fit_start(n_views, 0)
    return strategy


def test_far_views_yield_to_the_nearest_once_all_were_visited():
    s = started(ratio=1.5, softness=0.5)
    views = {"near": 2.0, "middle": 2.5, "far": 4.0}
    for name, distance in views.items():
        assert visit(s, name, distance, [True, True]).tolist() == [1, 1]  # too few views have shown them
    withheld = 1 / (1 + math.exp(-(2 - 1.5) / 0.5))  # rates 10/2, 10/2.5, 10/4: ratio 2
    for name, expected in (("near", 1.0), ("middle", 1 - withheld), ("far", 1 - withheld)):
        assert visit(s, name, views[name], [True, True]).tolist() == pytest.approx([expected] * 2)
    assert s.logs["mean_hr_weight"] == pytest.approx(1 - withheld)


def test_equal_sampling_keeps_nearly_everything_and_a_wide_range_leaves_nearly_nothing():
    s = started()
    for name in "abc":
        visit(s, name, 1.0, [True])
    assert s.weight("a").tolist() == [1.0]
    visit(s, "c", 2.0, [True])
    assert s.weight("a").tolist() == [1.0]
    assert float(s.weight("c")) < 1e-6


def test_a_gaussian_that_few_views_show_keeps_its_gradient_and_half_the_size_changes_no_rate():
    s = started()
    for name, distance, shown in (("a", 1.0, [True, True]), ("b", 2.0, [True, False]), ("c", 4.0, [True, True])):
        visit(s, name, distance, shown)
    w = visit(s, "c", 4.0, [True, True])
    assert float(w[0]) < 1e-6
    assert float(w[1]) == 1.0
    rates = []
    for factor in (2, 4):
        strategy, lr, hr = started(), camera(4.0), camera(4.0, 10.0 * factor)
        view = View("a", Photo(lr, torch.zeros(8, 8, 3)), Photo(hr, torch.zeros(8, 8, 3)))
        strategy.after_step({"means": torch.zeros(1, 3)}, Step(1, view, torch.tensor([True])))
        rates.append(strategy.state["a"])
    assert torch.equal(*rates)


def test_a_rate_is_that_of_the_last_iteration_that_showed_the_gaussian_before_the_camera():
    """Dropout hides a Gaussian for an iteration; that is no evidence that the view does not see it."""
    s = started()
    visit(s, "a", 2.0, [True, True], means=torch.tensor([[0.0, 0, -3], [0, 0, 3]]))
    visit(s, "a", 4.0, [False, False])
    assert s.state["a"].tolist() == [0.0, 2.0]


def test_the_weights_follow_their_gaussians():
    s = started()
    for name, distance in (("a", 1.0), ("b", 2.0), ("c", 4.0)):
        visit(s, name, distance, [True, name != "b"])
    before = s.weight("c")
    s.on_resize(torch.tensor([1, 0, 0]))
    assert torch.equal(s.weight("c"), before[[1, 0, 0]])


def test_two_views_are_warned_of(caplog):
    started(3)
    assert not caplog.text
    started(2)
    assert "SplatSuRe has no effect: 2 training views, fewer than min_views=3" in caplog.text
