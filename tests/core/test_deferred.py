"""Numbers that are read late: the same floats as at once, in one transfer, and nothing read before it is asked for."""

from __future__ import annotations

import math

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from clear_strategies.core import deferred


class Reads(TorchDispatchMode):
    """Counts what makes the host wait for a device."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, operation, types, arguments=(), keywords=None):
        self.count += operation.overloadpacket in (torch.ops.aten._local_scalar_dense, torch.ops.aten.nonzero)
        return operation(*arguments, **(keywords or {}))


@pytest.fixture
def on_a_device(monkeypatch):
    """The CPU's tensors as if they lay where reading waits."""
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)


def test_on_the_cpu_numbers_are_floats():
    assert deferred.scalar(torch.tensor(1.5)) == 1.5
    assert deferred.defer(deferred.ratio, 1.0, 4.0) == 0.25
    assert math.isnan(deferred.defer(deferred.ratio, 0.0, 0.0))


def test_elsewhere_nothing_is_read_until_it_is_asked_for(on_a_device):
    with Reads() as reads:
        part, whole = deferred.scalar(torch.tensor(3)), deferred.scalar(torch.tensor(4.0, dtype=torch.float64))
        share = deferred.defer(deferred.ratio, part, deferred.defer(deferred.added, whole, 8.0))
        rows = [{"t": 1.0, "share": share, "part": part}, {"t": 2.0, "share": share}]
    assert reads.count == 0
    assert deferred.resolve(rows) == [{"t": 1.0, "share": 0.25, "part": 3.0}, {"t": 2.0, "share": 0.25}]


def test_a_number_that_takes_part_in_several_crosses_once(on_a_device, monkeypatch):
    moved = []
    monkeypatch.setattr(torch, "stack", lambda tensors, real=torch.stack: moved.append(len(tensors)) or real(tensors))
    a, b = torch.tensor(1.0), torch.tensor(2.0)
    assert deferred.read([deferred.defer(deferred.added, a, b), deferred.defer(deferred.ratio, a, b), a, 5.0]) == [
        3.0, 0.5, 1.0, 5.0,
    ]  # fmt: skip
    assert moved == [2]


def test_counts_beyond_float32_stay_exact(on_a_device):
    large = torch.tensor(2**24 + 1)
    assert deferred.read([deferred.scalar(large), torch.tensor(0.5)]) == [2**24 + 1, 0.5]


def test_a_recipe_may_have_an_effect_and_runs_once(on_a_device):
    calls = []
    row = {"x": deferred.defer(lambda x: calls.append(x) or x, torch.tensor(7.0))}
    assert not calls
    deferred.resolve([row])
    deferred.resolve([row])
    assert calls == [7.0]


@pytest.mark.parametrize("chosen", [[True, False, True, True], [False] * 4, [False, True, False, True]])
def test_the_mean_of_chosen_rows_is_the_same_without_counting_them(chosen, monkeypatch):
    values, chosen = torch.tensor([4.0, 2.0, 1.0, 3.0]), torch.tensor(chosen)
    values[~chosen] = math.inf  # which must not leak in
    expected = deferred.mean(values, chosen)
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)
    with Reads() as reads:
        result = deferred.mean(values, chosen)
    assert reads.count == 0
    assert deferred.read([result]) == pytest.approx([expected], nan_ok=True)
