"""Numbers that are read late: the same floats as at once, in one transfer, when they are asked for; and the history."""

import json
import math

import pytest
import torch

from clear_strategies.core import deferred
from clear_strategies.training.history import History
from tests.helpers import toy


def reads(operations: toy.Operations) -> int:
    """How often the host would wait for a device."""
    return operations.count["_local_scalar_dense"] + operations.count["nonzero"]


@pytest.fixture
def on_a_device(monkeypatch):
    """The CPU's tensors as if they lay where reading waits."""
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)


def test_on_the_cpu_numbers_are_floats_and_elsewhere_nothing_is_read_until_asked_for(monkeypatch):
    assert deferred.scalar(torch.tensor(1.5)) == 1.5
    assert deferred.defer(deferred.ratio, 1.0, 4.0) == 0.25
    assert math.isnan(deferred.defer(deferred.ratio, 0.0, 0.0))
    monkeypatch.setattr(deferred, "is_immediate", lambda x: False)
    with toy.Operations() as done:
        part, whole = deferred.scalar(torch.tensor(3)), deferred.scalar(torch.tensor(4.0, dtype=torch.float64))
        share = deferred.defer(deferred.ratio, part, deferred.defer(deferred.added, whole, 8.0))
        rows = [{"t": 1.0, "share": share, "part": part}, {"t": 2.0, "share": share}]
    assert reads(done) == 0
    assert deferred.resolve(rows) == [{"t": 1.0, "share": 0.25, "part": 3.0}, {"t": 2.0, "share": 0.25}]
    history = History()
    for t in range(300):
        history.append({"t": float(t), "loss": torch.tensor(t / 2)})
    assert all(isinstance(row["loss"], torch.Tensor) for row in history)
    assert [row["loss"] for row in deferred.resolve(history)] == [t / 2 for t in range(300)]
    history.append({"t": 300.0, "loss": 150.0})
    assert [row["loss"] for row in history] == [t / 2 for t in range(301)]


def test_a_row_of_a_copied_vector_has_its_numbers_in_the_rows_order(on_a_device):
    x, (_, second) = torch.tensor(3.0), deferred.elements(torch.tensor([7, 8]))
    nested = deferred.defer(deferred.ratio, second, deferred.defer(deferred.added, x, 1.0))
    row = {"share": nested, "one": 1.0, "x": x, "second": second}
    for doubled in (1, 2):  # the row of a row, too
        vector, row_of = deferred.gathered(row)
        row = row_of(doubled * vector)
        assert [type(number) for number in row.values()] == [
            deferred.Deferred, float, deferred.Deferred, deferred.Deferred
        ]  # fmt: skip
        assert [*row] == ["share", "one", "x", "second"]
        expected = [8 * doubled / (3 * doubled + 1), 1, 3 * doubled, 8 * doubled]
        assert deferred.read([*row.values()]) == expected


def test_numbers_cross_once_and_exactly_and_a_recipe_runs_once(on_a_device, monkeypatch):
    moved = []
    monkeypatch.setattr(torch, "cat", lambda tensors, real=torch.cat: moved.append(len(tensors)) or real(tensors))
    a, b = torch.tensor(1.0), torch.tensor(2.0)
    one, two, _ = deferred.elements(torch.tensor([7.0, 8.0, 9.0]))
    assert deferred.read([deferred.defer(deferred.added, a, b), deferred.defer(deferred.ratio, a, two), a, 5.0, one]) == [
        3.0, 0.125, 1.0, 5.0, 7.0,
    ]  # fmt: skip
    assert moved == [3, 1]  # two scalars and a vector, all of one type
    lists, vector = [], torch.ones(9)
    deferred.read([deferred.Deferred(lambda x: lists.append(x) or 0.0, (vector,)) for _ in range(3)])
    assert all(x is lists[0] for x in lists)  # a replayed iteration has one vector of all of its numbers
    large = torch.tensor(2**24 + 1)
    assert deferred.read([deferred.scalar(large), torch.tensor(0.5)]) == [2**24 + 1, 0.5]
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
    with toy.Operations() as done:
        result = deferred.mean(values, chosen)
    assert reads(done) == 0
    assert deferred.read([result]) == pytest.approx([expected], nan_ok=True)


# ---- a long history: its rows come back as they were, small, and the newest may still change
def rows(n: int) -> list[dict[str, float]]:
    return [{"t": float(t), "loss": 1 / (t + 1)} | ({"psnr": 20.0} if t % 7 == 0 else {}) for t in range(n)]


def test_rows_come_back_as_they_were_by_any_index_and_the_newest_may_change():
    written, history = rows(500), History(rows(500))
    assert len(history) == 500
    assert json.dumps(list(history)) == json.dumps(written)
    for at in (0, 1, 7, 435, 436, 499, -1, -64, -65, -500):
        assert json.dumps(history[at]) == json.dumps(written[at])
    assert json.dumps(history[430:440]) == json.dumps(written[430:440])
    for beyond in (500, -501):
        with pytest.raises(IndexError):
            history[beyond]
    counts = History({"count": t} for t in range(500))  # of a strategy that logs whole numbers
    assert len(counts._loose) == len(history._loose) == 64
    assert [row["count"] for row in counts] == list(range(500))
    history[-1]["seconds"], history[-60]["loss"] = 3.0, 9.0
    assert (history[499]["seconds"], history[440]["loss"]) == (3.0, 9.0)
