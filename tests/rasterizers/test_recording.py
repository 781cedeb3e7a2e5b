"""Recordings, on the CPU that stands in for a CUDA device and on a GPU; and that the stand-in refuses what CUDA refuses."""

import gc
import re
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import _disable_current_modes

from rasterizers import recording, warp_runtime
from rasterizers.recording import Recording, on_side_stream, running
from rasterizers.warp_runtime import launch
from tests.helpers import toy
from tests.helpers.backends import cotangents, everything, moved, needs, require_same_bits
from tests.helpers.cuda_rules import ROOM, RULES
from tests.helpers.strict_cuda import Graph, Stream, StrictCuda

wp: Any = pytest.importorskip("warp")
pytestmark = needs("warp")
CPU = torch.device("cpu")


def test_a_replay_reads_what_has_been_written_since(recorded_on):
    x, total = torch.arange(4.0, device=recorded_on), torch.zeros((), device=recorded_on)

    def work():
        assert not gc.isenabled()
        doubled = 2 * x[1:].view(3, 1)
        total.add_(doubled.sum())
        return doubled, torch.zeros(2, device=recorded_on) + x[0]

    recorded = Recording(recorded_on, work)
    doubled, first = recorded.result
    assert (doubled.flatten().tolist(), first.tolist(), float(total)) == ([2, 4, 6], [0, 0], 12)
    x.add_(1)
    assert recorded.replay()
    assert (doubled.flatten().tolist(), first.tolist(), float(total)) == ([4, 6, 8], [1, 1], 30)
    assert running() is None


def test_a_replay_ends_where_what_follows_does_not_hold(recorded_on):
    x, found, read = torch.zeros((), device=recorded_on), torch.zeros((), device=recorded_on), []

    def work():
        found.copy_(x)
        doubled = 2 * x  # memory that both graphs use
        current = running()
        assert current is not None
        read.append(current.pause(lambda: float(found), lambda: float(x) < 2))
        found.add_(10 + doubled)

    recorded = Recording(recorded_on, work)
    assert [recorded.replay(), float(found), read] == [True, 10, [0]]
    x.fill_(2)
    assert [recorded.replay(), float(found)] == [False, 2]


@pytest.mark.parametrize("part", [lambda x: x[1:], lambda x: torch.unsafe_chunk(x, 2)[1]])
def test_a_recording_keeps_what_it_reads_also_where_an_operation_returns_a_part(part, recorded_on):
    def record():
        x = torch.arange(2.0, device=recorded_on)
        return Recording(recorded_on, lambda: part(x) + 1), weakref.ref(x)

    recorded, x = record()
    assert x() is not None
    assert recorded.replay()
    assert recorded.result.item() == 2
    del recorded
    assert x() is None


def test_a_recording_that_is_dropped_in_another_ends_that(strict_cuda):
    older = [Recording(CPU, lambda: torch.zeros(1))]
    with pytest.raises(RuntimeError, match="a previous error"):
        Recording(CPU, lambda: (older.clear(), torch.zeros(1)))


def test_a_drawing_that_is_dropped_in_a_recording_ends_that(strict_cuda):
    """The host copies its counts to pinned memory."""
    import rasterizers

    with on_side_stream(CPU):
        drawn = [rasterizers.load("warp", device="cpu")(toy.splats(9), toy.camera(0.0))]
    with pytest.raises(RuntimeError, match="a previous error"):
        Recording(CPU, lambda: (drawn.clear(), torch.zeros(1)))


def test_memory_of_recordings_that_were_dropped_is_given_back_before_it_runs_short(strict_cuda):
    for _ in range(2 * ROOM):
        Recording(CPU, lambda: torch.zeros(1))
    assert strict_cuda.state.cached <= ROOM / 4


def test_memory_of_a_recording_that_was_dropped_is_given_back(recorded_on, monkeypatch):
    monkeypatch.setattr(recording, "_CACHED", 0.0)
    reserved = []
    for _ in range(4):
        Recording(recorded_on, lambda: torch.zeros(2**24, device=recorded_on))
        reserved.append(torch.cuda.memory_reserved(recorded_on))
    assert reserved[1:] == [reserved[1]] * 3


def test_where_cuda_ends_a_recording_by_an_error_the_cache_and_random_numbers_are_as_before(recorded_on):
    x = torch.zeros(2, device=recorded_on)
    with pytest.raises(RuntimeError):
        Recording(recorded_on, x.tolist)
    torch.cuda.empty_cache()
    x += torch.rand(2, device=recorded_on).floor()
    recorded = Recording(recorded_on, lambda: x + 1)
    assert recorded.replay()
    assert recorded.result.tolist() == [1, 1]


def test_a_rendering_is_replayed_for_another_camera_background_and_number_of_pairs(recorded_on):
    import rasterizers

    rasterizer = rasterizers.load("warp", device=recorded_on.type)
    splats, v = moved(toy.splats(60), recorded_on), cotangents(2, 64, 96).to(recorded_on)
    own, background = toy.camera(0.0), torch.tensor([[0.1, 0.2, 0.3]], device=recorded_on)
    numbers = rasterizer.numbers_of(own, recorded_on)
    with on_side_stream(recorded_on):
        everything(rasterizer.over_changing(background)(splats, own), v)
    recorded = Recording(recorded_on, lambda: everything(rasterizer.over_changing(background)(splats, own), v))
    for angle, color in ((0.3, (0.5, 0.0, 1.0)), (0.7, (1.0, 1.0, 1.0)), (0.0, (0.0, 0.0, 0.0))):
        camera = toy.camera(angle)
        for x, y in zip(numbers, rasterizer.numbers_of(camera, recorded_on), strict=True):
            x.copy_(y)
        background.copy_(torch.tensor([color]))
        assert recorded.replay()
        require_same_bits(recorded.result, everything(rasterizer.with_background(color)(splats, camera), v))
    image = recorded.result[0].clone()
    splats.scales.mul_(30)  # many times as many pairs
    assert not recorded.replay()
    assert torch.equal(recorded.result[0], image)


def test_the_side_stream_waits_for_earlier_work_and_later_work_for_it(strict_cuda, monkeypatch):
    waits = []
    monkeypatch.setattr(Stream, "wait_stream", lambda self, other: waits.append((self, other)))
    with on_side_stream(CPU):
        side, legacy = strict_cuda.current, strict_cuda.state.legacy
        assert waits == [(side, legacy)]
    assert waits == [(side, legacy), (legacy, side)]


def in_two_threads(call):
    with ThreadPoolExecutor(2) as threads:
        return [*threads.map(lambda _: call(), range(2))]


def test_launches_of_two_threads_are_each_on_the_stream_of_its_own(monkeypatch):
    class Command:
        def prepare(self, size, arguments):
            return self

        def launch(self, stream):
            on.append((threading.get_ident(), stream))

    on: list[tuple[int, int]] = []
    both_are_here = threading.Barrier(2, timeout=60)

    def launches():
        with warp_runtime.on_stream(torch.device("cuda")):
            for _ in range(2):
                both_are_here.wait()
                launch(doubled, [1], (torch.zeros(1),))
        assert warp_runtime._kept.stream is None

    monkeypatch.setattr(warp_runtime, "_Launch", lambda *_: Command())
    monkeypatch.setattr(warp_runtime, "warp_stream", lambda stream: stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: threading.get_ident())
    in_two_threads(launches)
    assert len({thread for thread, _ in on}) == 2
    assert all(thread == stream for thread, stream in on)


def test_each_thread_records_on_a_stream_of_its_own(monkeypatch):
    both_are_here = threading.Barrier(2, timeout=60)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: object())

    def streams():
        both_are_here.wait()
        return [recording._side_stream(CPU) for _ in range(2)]

    first, second = in_two_threads(streams)
    assert first[0] is first[1]
    assert second[0] is second[1]
    assert first[0] is not second[0]


def test_another_thread_may_read_while_a_recording_is_made(recorded_on):
    """A checkpoint is written beside training."""
    x = torch.ones(2, device=recorded_on)

    def work():
        with ThreadPoolExecutor(1) as other:
            assert other.submit(lambda: torch.ones(3).numpy().sum()).result() == 3
        return x + 1

    assert Recording(recorded_on, work).result.tolist() == [2, 2]


def test_a_backward_pass_runs_in_a_thread_of_its_own(recorded_on):
    x, seen = torch.ones(1, device=recorded_on, requires_grad=True), []
    x.register_hook(lambda _: seen.append(threading.get_ident()))
    x.sum().backward()
    assert seen != [threading.get_ident()]


def after_the_end(act):
    def example(cuda, x):
        cuda.state.capture.capture_end()
        act(cuda, x)

    return example


def with_memory_that_is_freed(cuda, x):
    graph = cuda.state.capture
    with _disable_current_modes():
        older = torch.ones(1)
    x.add_(older)
    del older
    graph.capture_end()
    graph.replay()


def with_a_sort(cuda, _):
    wp.init()
    cuda.state.warp_knows = False
    keys, values = (wp.from_torch(torch.zeros(4, dtype=torch.int32)) for _ in range(2))
    wp.utils.radix_sort_pairs(keys, values, 2, end_bit=8)


def after_a_failure(cuda, x):
    with suppress(RuntimeError):
        x.tolist()
    x.add_(1)


def after_a_failed_end(act):
    def example(cuda, x):
        graph = cuda.state.capture
        for fails in (x.tolist, graph.capture_end):
            with suppress(RuntimeError):
                fails()
        act(cuda, x)

    return example


def with_a_full_cache(cuda, x):
    cuda.state.cached = ROOM
    x.clone()


@wp.kernel
def doubled(x: wp.array(dtype=wp.float32)):
    i = wp.tid()
    x[i] = 2.0 * x[i]


def on_the_default_stream(act):
    def example(cuda, x):
        with torch.cuda.stream(cuda.state.legacy):
            act(cuda, x)

    return example


EXAMPLES: dict[str, list[Callable[[StrictCuda, torch.Tensor], object]]] = {
    "pool_before_the_end": [lambda cuda, x: cuda.state.capture.pool()],
    "replay_before_the_end": [lambda cuda, x: cuda.state.capture.replay()],
    "begin_on_the_default_stream": [on_the_default_stream(lambda cuda, x: torch.cuda.CUDAGraph().capture_begin())],
    "begin_of_a_graph_that_is_captured": [lambda cuda, x: [(g := cuda.state.capture).capture_end(), g.capture_begin()]],
    "second_begin": [lambda cuda, x: torch.cuda.CUDAGraph().capture_begin()],
    "end_without_begin": [lambda cuda, x: torch.cuda.CUDAGraph().capture_end()],
    "a_stream_before_warp_begins": [lambda cuda, x: wp.stream_from_torch(cuda.current)],
    "warp_joins_what_is_captured": [after_the_end(lambda cuda, x: wp.capture_begin(stream=cuda.current, external=True))],
    "warp_ends_what_it_began": [lambda cuda, x: [wp.capture_end(stream=cuda.current) for _ in range(2)]],
    "sort_that_warp_does_not_know_of": [with_a_sort],
    "waiting_for_the_device": [
        lambda cuda, x: x.item(), lambda cuda, x: bool(x), lambda cuda, x: x.tolist(), lambda cuda, x: x.cpu(),
        lambda cuda, x: x.numpy(), lambda cuda, x: x.nonzero(), lambda cuda, x: x[x > 0],
        lambda cuda, x: torch.cuda.synchronize(), lambda cuda, x: torch.cuda.Event().query(),
        lambda cuda, x: torch.linalg.inv(x[:, None]),
    ],
    "pinning_memory": [lambda cuda, x: x.pin_memory()],
    "freeing_pinned_memory": [lambda cuda, x: cuda.ask("unpin", cuda.current)],
    "sending_where_waits_are_refused": [
        lambda cuda, x: [torch.cuda.set_sync_debug_mode("error"), x.new_tensor(2.0)]
    ],
    "sending_numbers_of_python": [
        lambda cuda, x: torch.tensor([1.0]), lambda cuda, x: x.new_tensor(2.0), lambda cuda, x: x[[0]],
    ],
    "allocating_outside_the_pool": [
        lambda cuda, x: wp.empty(3, device="cpu"), on_the_default_stream(lambda cuda, x: torch.empty(3))
    ],
    "allocating_beside_what_is_cached": [with_a_full_cache],
    "emptying_the_cache_in_a_capture": [
        lambda cuda, x: torch.cuda.empty_cache(), after_a_failed_end(lambda cuda, x: torch.cuda.empty_cache())
    ],
    "random_numbers_after_a_failed_capture": [after_a_failed_end(lambda cuda, x: torch.rand(1))],
    "timing_in_a_capture": [lambda cuda, x: torch.cuda.Event(enable_timing=True).record()],
    "destroying_a_graph": [lambda cuda, x: cuda.ask("destroy")],
    "a_graph_of_autograd_on_another_stream": [lambda cuda, x: x.clone().requires_grad_().add(1)],
    "loading_a_module": [lambda cuda, x: launch(doubled, [1], (x,))],
    "waiting_for_a_capturing_stream": [lambda cuda, x: cuda.state.legacy.wait_stream(cuda.current)],
    "a_capturing_stream_waiting": [lambda cuda, x: cuda.current.wait_stream(cuda.state.legacy)],
    "work_on_another_stream": [on_the_default_stream(lambda cuda, x: x.add_(1))],
    "anything_after_a_failure": [after_a_failure],
    "reading_memory_that_was_freed": [with_memory_that_is_freed],
}  # fmt: skip
"""For each rule what it refuses: acts in a capture, with a tensor of one number that was allocated before it."""

ACTS = [pytest.param(name, act, id=f"{name}-{nth}") for name, acts in EXAMPLES.items() for nth, act in enumerate(acts)]


def test_every_rule_has_an_example():
    assert list(RULES) == list(EXAMPLES)


@pytest.mark.parametrize(("name", "act"), ACTS)
def test_the_stand_in_refuses_what_cuda_refuses(name, act, strict_cuda):
    x = torch.zeros(1)
    with on_side_stream(CPU):
        graph = torch.cuda.CUDAGraph()
        graph.capture_begin()
        with pytest.raises(RuntimeError, match=re.escape(RULES[name].message)):
            act(strict_cuda, x)
        with suppress(RuntimeError):
            graph.capture_end()


@pytest.mark.parametrize(("name", "act"), [act for act in ACTS if act.values[0] != "a_stream_before_warp_begins"])
def test_after_work_that_cannot_be_recorded_live_work_goes_on_and_other_work_is_recorded(name, act, strict_cuda):
    x = torch.zeros(1)
    with pytest.raises(RuntimeError):
        Recording(CPU, lambda: act(strict_cuda, x))
    s = strict_cuda.state
    found = s.capture, s.warp_knows, strict_cuda.current, running(), gc.isenabled()
    assert found == (None, False, s.legacy, None, True)
    torch.cuda.empty_cache()
    x.zero_().add_(torch.rand(1).mul_(0)).add_(1)
    recorded = Recording(CPU, lambda: x + 1)
    x.add_(1)
    assert (recorded.replay(), recorded.result.tolist()) == (True, [3])


@pytest.mark.parametrize("fails", ["CUDAGraph.capture_begin", "wp.capture_begin", "wp.capture_end", "CUDAGraph.replay"])
def test_where_a_call_of_cuda_fails_live_work_goes_on(fails, strict_cuda, monkeypatch):
    def failing(*_, **__):
        raise RuntimeError("out of memory")

    owner, name = fails.split(".")
    monkeypatch.setattr(wp if owner == "wp" else Graph, name, failing)
    with pytest.raises(RuntimeError, match="out of memory"):
        Recording(CPU, lambda: torch.zeros(1))
    assert torch.zeros(1).add_(1).item() == 1
