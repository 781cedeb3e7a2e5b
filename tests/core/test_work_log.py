"""What work says of itself: the log of stages, on a device by events instead of clocks, and lines of progress."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import dataclass

import pytest
import torch

from clear_strategies import Conductor
from clear_strategies.core import progress
from clear_strategies.core.progress import EVERY, FIRST, Progress, told
from clear_strategies.core.work_log import WorkLog


class Device:
    """A clock that a test moves, ms: what is recorded now is passed once the device has come so far."""

    queued, reached, waits = 0.0, 0.0, 0
    of = torch.device("cuda:1")  # not the current one

    def event(self, *, enable_timing: bool) -> Event:
        assert enable_timing
        return Event(self)


@dataclass
class Event:
    device: Device
    at: float = math.nan

    def record(self, stream: torch.device) -> None:
        assert stream == self.device.of  # each device has a stream of its own
        self.at = self.device.queued

    def query(self) -> bool:
        return self.at <= self.device.reached

    def synchronize(self) -> None:
        self.device.waits += self.at > self.device.reached
        self.device.reached = max(self.device.reached, self.at)

    def elapsed_time(self, end: Event) -> float:
        assert self.query()
        assert end.query()
        return end.at - self.at


@pytest.fixture
def device(monkeypatch) -> Device:
    fake = Device()
    monkeypatch.setattr(torch.cuda, "Event", fake.event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device=None: device)
    return fake


def work(work_log: WorkLog, device: Device, name: str, ms: float) -> None:
    with work_log.stage(name):
        device.queued += ms


def test_on_cuda_nobody_waits_until_somebody_looks_and_a_failing_stage_is_stamped_too(device):
    work_log = WorkLog(Device.of)
    for _ in range(3):
        work(work_log, device, "render", 2.0)
        work(work_log, device, "step", 0.5)
    assert device.waits == 0
    rows = {row["stage"]: row for row in work_log.rows()}
    assert device.waits > 0
    assert (rows["render"]["runs"], rows["render"]["ms_each"], rows["render"]["seconds"]) == (3, 2.0, 0.006)
    assert rows["step"]["ms_each"] == 0.5
    assert list(rows) == ["render", "step"]
    work_log = WorkLog(Device.of)
    with pytest.raises(ZeroDivisionError), work_log.stage("render"):
        work(work_log, device, "inner", 1 / 0)
    assert work_log.entries["render"].runs == 1


def test_the_state_is_ready_for_json_and_counting_goes_on_from_it(device):
    work_log = WorkLog()
    work_log.device = Device.of  # once the trainer knows
    work(work_log, device, "render", 1000.0)
    work_log.skip("rows", "still", torch.tensor(7))
    state = json.loads(json.dumps(work_log.state_dict()))
    assert state["render"].pop("peak") > 100  # MiB, of a process that has imported torch
    assert state == {
        "render": {"runs": 1, "seconds": 1.0, "skipped": {}},
        "rows": {"runs": 0, "seconds": 0.0, "peak": 0, "skipped": {"still": 7}},
    }
    resumed = WorkLog(Device.of)
    work(resumed, device, "lost", 1.0)
    resumed.load_state_dict(state)
    work(resumed, device, "render", 500.0)
    resumed.skip("rows", "still", 2)
    assert resumed.entries["render"].seconds == 1.5
    assert resumed.entries["rows"].skipped == {"still": 9}
    assert "lost" not in resumed.entries


def test_skips_on_the_device_are_summed_late_and_nothing_skipped_leaves_no_line():
    work_log, buffer = WorkLog(), torch.tensor([3, 0], dtype=torch.int32)
    work_log.skip("rows", "still", buffer[0])
    work_log.skip("rows", "not visible", buffer[1])
    work_log.skip("bands", "above", torch.tensor(0))
    buffer[0] = 4  # whose numbers these are may write over them
    work_log.skip("rows", "still", buffer[0])
    assert not work_log._entries
    assert {name: entry.skipped for name, entry in work_log.entries.items()} == {"rows": {"still": 7}}
    assert work_log.rows()[0]["why"] == "still (7x)"


def test_on_a_cpu_no_event_is_made_and_a_runs_log_is_on_its_device(monkeypatch):
    monkeypatch.setattr(torch.cuda, "Event", None)
    work_log = WorkLog()
    with work_log.stage("render"):
        pass
    work_log.skip("render", "nothing to see")
    assert work_log.entries["render"].runs == 1
    assert 0 < work_log.entries["render"].seconds < 1
    assert work_log.entries["render"].skipped == {"nothing to see": 1}
    conductor = Conductor()
    assert conductor.work_log.device.type == "cpu"
    conductor.on_fit_start(1, 0, "cuda")
    assert conductor.work_log.device.type == "cuda"


# ---- long work says how far it is, and short work nothing
def test_a_line_now_and_then_and_only_where_something_has_happened(monkeypatch, caplog):
    clock = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    counter = Progress("features", "photos", 10)
    with caplog.at_level(logging.INFO):
        for seconds, done in ((0, 1), (FIRST, 2), (EVERY / 2, 3), (EVERY, 3), (1, 4), (EVERY, 4), (70, 5), (EVERY, 10)):
            clock[0] += seconds
            counter(done)
    left = {2: "8 s", 3: "40 s", 4: "42 s", 5: "1 min 38 s"}
    assert caplog.messages == [f"features: {n} of 10 photos, about {time} left" for n, time in left.items()]


def test_items_that_have_been_used_are_told(monkeypatch, caplog):
    clock, used = [100.0], []
    monkeypatch.setattr(progress.time, "monotonic", lambda: clock[0])
    with caplog.at_level(logging.INFO):
        for item in told(iter("abc"), "maps", "views", 3):
            used.append(item)
            clock[0] += EVERY
    assert used == ["a", "b", "c"]
    assert caplog.messages == ["maps: 1 of 3 views, about 20 s left", "maps: 2 of 3 views, about 10 s left"]
