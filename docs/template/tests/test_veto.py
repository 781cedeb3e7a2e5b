"""Veto keeps the contract of a strategy, and drops what opposes."""

from __future__ import annotations

import torch
from clear_veto import Veto

from clear_strategies import Conductor, Grads, Photo, Step, View
from clear_strategies.testing import check_strategy
from rasterizers.interface import Camera


def test_it_keeps_the_contract() -> None:
    check_strategy(Veto)
    Conductor(Veto())


def test_what_opposes_is_dropped_from_start_on() -> None:
    lr, hr = Grads({"opacities": torch.tensor([1.0, 1.0])}), Grads({"opacities": torch.tensor([2.0, -2.0])})
    photo = Photo(Camera(torch.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 1), torch.zeros(1, 1, 3))
    view = View("a photo", photo, photo)
    assert Veto(start=10).correct(lr, hr, Step(10, view))["opacities"].tolist() == [2.0, 0.0]
    assert Veto(start=10).correct(lr, hr, Step(9, view))["opacities"].tolist() == [2.0, -2.0]
