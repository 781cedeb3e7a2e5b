"""A long history: its rows come back as they were, small, and the newest may still change."""

from __future__ import annotations

import json

import pytest
import torch

from clear_strategies.core import deferred
from clear_strategies.training.history import History


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
    history[-1]["seconds"], history[-60]["loss"] = 3.0, 9.0
    assert (history[499]["seconds"], history[440]["loss"]) == (3.0, 9.0)


def test_numbers_on_a_device_are_kept_until_they_are_read():
    history = History()
    for t in range(300):
        history.append({"t": float(t), "loss": torch.tensor(t / 2)})
    assert all(isinstance(row["loss"], torch.Tensor) for row in history)
    assert [row["loss"] for row in deferred.resolve(history)] == [t / 2 for t in range(300)]
    history.append({"t": 300.0, "loss": 150.0})
    assert [row["loss"] for row in history] == [t / 2 for t in range(301)]
