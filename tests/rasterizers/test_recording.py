"""Recordings on the CPU, and in which order graphs are captured on CUDA."""

from contextlib import nullcontext
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from rasterizers import recording
from rasterizers.recording import Recording, running
from tests.helpers import toy
from tests.helpers.backends import cotangents, everything, needs, require_same_bits

CPU = torch.device("cpu")


def test_a_replay_reads_what_has_been_written_since():
    x, total = torch.arange(4.0), torch.zeros(())

    def work():
        doubled = 2 * x[1:].view(3, 1)
        total.add_(doubled.sum())
        return doubled, torch.zeros(2) + x[0]

    recorded = Recording(CPU, work)
    doubled, first = recorded.result
    assert (doubled.flatten().tolist(), first.tolist(), float(total)) == ([2, 4, 6], [0, 0], 12)
    x.add_(1)
    assert recorded.replay()
    assert (doubled.flatten().tolist(), first.tolist(), float(total)) == ([4, 6, 8], [1, 1], 30)
    assert running() is None


def test_a_replay_ends_where_what_follows_does_not_hold():
    x, found, read = torch.zeros(()), torch.zeros(()), []

    def work():
        found.copy_(x)
        current = running()
        assert current is not None
        read.append(current.pause(lambda: float(found), lambda: float(x) < 2))
        found.add_(10)

    recorded = Recording(CPU, work)
    assert [recorded.replay(), float(found), read] == [True, 10, [0]]
    x.fill_(2)
    assert [recorded.replay(), float(found)] == [False, 2]


def test_reading_a_number_is_refused_and_nothing_is_recorded_any_more():
    with pytest.raises(RuntimeError, match="must not read a number"):
        Recording(CPU, lambda: torch.ones(()).item())
    assert running() is None


@needs("warp")
def test_a_rendering_is_replayed_for_another_camera_background_and_number_of_pairs():
    import rasterizers

    rasterizer, splats, v = rasterizers.load("warp", device="cpu"), toy.splats(60), cotangents(2, 64, 96)
    own, background = toy.camera(0.0), torch.tensor([[0.1, 0.2, 0.3]])
    numbers = rasterizer.numbers_of(own, CPU)
    recorded = Recording(CPU, lambda: everything(rasterizer.over_changing(background)(splats, own), v))
    for angle, color in ((0.3, (0.5, 0.0, 1.0)), (0.7, (1.0, 1.0, 1.0)), (0.0, (0.0, 0.0, 0.0))):
        camera = toy.camera(angle)
        for x, y in zip(numbers, rasterizer.numbers_of(camera, CPU), strict=True):
            x.copy_(y)
        background.copy_(torch.tensor([color]))
        assert recorded.replay()
        require_same_bits(recorded.result, everything(rasterizer.with_background(color)(splats, camera), v))
    image = recorded.result[0].clone()
    splats.scales.mul_(30)  # many times as many pairs
    assert not recorded.replay()
    assert torch.equal(recorded.result[0], image)


@needs("warp")
@pytest.mark.parametrize("fails", [False, True])
def test_on_cuda_each_part_is_captured_and_replayed_and_warp_knows(fails, monkeypatch):
    import warp as wp

    order, stream = [], Mock(device=torch.device("cuda"))

    def graph():
        names = {n: (lambda *_, n=n, **__: order.append(n)) for n in ("capture_begin", "capture_end", "replay")}
        return SimpleNamespace(**names, pool=lambda: "pool")

    monkeypatch.setattr(recording, "_side_stream", lambda device: stream)
    monkeypatch.setattr(recording, "warp_stream", lambda stream: stream)
    for name, fake in {
        "CUDAGraph": graph,
        "current_stream": lambda device: stream,
        "stream": lambda s: nullcontext(),
    }.items():
        monkeypatch.setattr(torch.cuda, name, fake)
    for name in ("capture_begin", "capture_end"):
        monkeypatch.setattr(wp, name, lambda *, stream, external=None, n=name: order.append(f"wp.{n}"))

    def work():
        current = running()
        assert current is not None
        current.pause(lambda: order.append("read"), lambda: True)
        if fails:
            raise ValueError("no")

    part = ["capture_begin", "wp.capture_begin", "wp.capture_end", "capture_end"]
    with pytest.raises(ValueError, match="no") if fails else nullcontext():
        recorded = Recording(torch.device("cuda"), work)
    assert order == [*part, "replay", "read", *part] + ["replay"] * (not fails)
    if not fails:
        order.clear()
        assert [recorded.replay(), order] == [True, ["replay", "replay"]]
