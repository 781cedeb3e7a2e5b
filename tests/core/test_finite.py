"""What is not finite is found before a step, named, and never reaches a parameter or a checkpoint."""

from dataclasses import dataclass, replace

import pytest
import torch

import clear_strategies as cs
from clear_strategies.core.finite import is_finite
from clear_strategies.errors import AnswerError, DivergedError
from clear_strategies.training import checkpoint, field
from clear_strategies.training.loop import fit, iterate
from rasterizers.interface import summed_vjp
from tests.helpers import toy
from tests.helpers.short_run import SCENE, start, tensors

BAD = (float("nan"), float("inf"), -float("inf"))
NAMES = ("gco", "p2g", "svs")


def without_a_pixel(bad: float, scale: str):
    """The toy scene; one pixel of one photo of every view is not finite."""

    def spoil(view):
        photo = getattr(view, scale)
        image = photo.image.clone()
        image[3, 5, 1] = bad
        return replace(view, **{scale: replace(photo, image=image)})

    return replace(SCENE, train=tuple(spoil(view) for view in SCENE.train))


@pytest.fixture(scope="module", params=["compiled", "readable"])
def begun(request):
    """A run at its sixth iteration, in which HR takes part, and what it holds; a refused step changes neither."""
    state = start(NAMES)
    if request.param == "readable":
        state.compiled_step = None
    for _ in range(5):
        iterate(state, toy.RASTERIZER)
    return state, {name: value.clone() for name, value in tensors(state).items()}


def assert_same(before, after):
    assert before.keys() == after.keys()
    for name, value in before.items():
        assert torch.equal(value, after[name]), name


def test_a_sum_that_overflows_is_finite_where_its_numbers_are():
    assert is_finite(torch.full((4,), 3e38))
    assert is_finite(torch.zeros(0))
    assert not any(is_finite(torch.tensor([1.0, bad])) for bad in BAD)


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("scale", ["lr", "hr"])
def test_a_pixel_that_is_not_finite_is_named_before_the_step(begun, scale, bad, monkeypatch):
    state, before = begun
    photo = {"lr": "the LR photo", "hr": "the SR image"}[scale]
    with monkeypatch.context() as now:
        now.setattr(state, "views", without_a_pixel(bad, scale).train)
        with pytest.raises(
            DivergedError, match=rf"^t=6, view view\d: the loss .*{photo} is not finite.*pixel \(5, 3\)"
        ):
            iterate(state, toy.RASTERIZER)
    assert state.t == 6
    assert_same(before, tensors(state))


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "rgb"])
def test_a_gradient_that_is_not_finite_is_named_before_the_step(begun, name, bad, monkeypatch):
    state, before = begun

    def spoiled(*arguments):
        g = summed_vjp(*arguments)
        rows = getattr(g, name).clone()
        rows[0, 7] = bad
        return replace(g, **{name: rows})

    monkeypatch.setattr(field, "summed_vjp", spoiled)
    with pytest.raises(DivergedError, match=r"^t=6, view view\d: .* is not finite for 1 Gaussian, first Gaussian 7"):
        iterate(state, toy.RASTERIZER)
    assert_same(before, tensors(state))


def test_a_run_that_meets_nan_saves_the_state_before_and_says_where(tmp_path):
    state = start(NAMES)
    state.views = without_a_pixel(float("nan"), "hr").train
    with pytest.raises(
        DivergedError, match=r"first pixel \(5, 3\). The state before that step is .*step_\d+\.safetensors; .* Check"
    ):
        fit(state, SCENE, toy.RASTERIZER, checkpoints=tmp_path)
    saved = checkpoint.load(tmp_path)
    assert saved.t == state.t == len(saved.history) + 1
    assert_same(dict(saved.tensors), tensors(state))


@dataclass(frozen=True)
class Fails(cs.Strategy):
    """Does something wrong at t=5."""

    what: str

    def reconcile(self, products, step):
        if step.t == 5 and self.what == "it raises before the step":
            raise KeyError("mine")
        return cs.Weights(keep=float("nan") if step.t == 5 and self.what == "a weight is NaN" else 1.0)

    def extra_views(self, t):
        photo = SCENE.train[0].lr
        spoilt = replace(photo, image=photo.image * float("nan"))
        return (
            [cs.ExtraView(spoilt, photo.image[..., 0] * 0 + 1)]
            if t == 5 and self.what == "an extra view is NaN"
            else []
        )

    def after_step(self, params, step):
        if step.t == 5 and self.what == "it raises after the step":
            raise KeyError("mine")
        if step.t == 5 and self.what == "it logs a column of the history":
            self.log("loss_lr", 1.0)


@pytest.mark.parametrize(("what", "stepped"), [
    ("it raises before the step", False), ("a weight is NaN", False), ("it raises after the step", True),
    ("an extra view is NaN", True), ("it logs a column of the history", True),
])  # fmt: skip
def test_a_run_that_ends_by_an_error_says_when_and_saves_the_state_before_where_no_step_was_made(
    what, stepped, tmp_path
):
    state = start((), more=[Fails(what)])
    with pytest.raises((KeyError, AnswerError, DivergedError)) as raised:
        fit(state, SCENE, toy.RASTERIZER, checkpoints=tmp_path)
    told = " ".join([str(raised.value), *getattr(raised.value, "__notes__", [])])
    assert "t=5" in told
    assert ("Its step was made, so that its state is not saved." in told) is stepped
    assert (" The state before that step is " in told) is not stepped
    assert [checkpoint.load(path).t for path in checkpoint.saved(tmp_path)] == ([] if stepped else [5])
