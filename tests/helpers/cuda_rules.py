"""What CUDA, torch and Warp refuse of streams and graphs: the list by which `strict_cuda` stands in for a GPU.

A fault that is found on a GPU becomes a rule here first. Each docstring is the error's message, and says who refuses; without a
name it is the CUDA runtime. What it refuses in a capture makes that capture invalid; where the source does not say so, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final


@dataclass
class Act:
    """What is about to be done.

    Args:
        what: "pool", "begin", "end" and "replay" of a graph; "warp stream", "warp begin" and "warp end"; "wait" for another
            stream; "work", "allocate", "sort", "read", "send" and "pin"; "load" of a kernel's module; "random" numbers of the
            device's own generator; "empty": `torch.cuda.empty_cache`; "event": one is recorded; "graph": autograd notes work;
            "destroy": a graph is no more; "unpin": pinned memory is no more, which work on the stream has copied.
        on: the stream. graph: whose pool, beginning, end or replay it is. other: the stream that is waited for.
        freed: the graph reads memory that is no more. by_warp: memory is Warp's, not torch's.
    """

    what: str
    on: Any
    graph: Any = None
    other: Any = None
    freed: bool = False
    by_warp: bool = False


ROOM: Final = 64
"""Pools of graphs that the device has memory for."""


@dataclass
class State:
    """What the device, torch and Warp remember.

    Args:
        legacy: torch's default stream. capture: the graph that is being captured.
        warp_knows: whether Warp knows of that; warp_runs: whether it has begun.
        underway: the pools that torch's allocator allocates from, `captures_underway` in c10/cuda/CUDACachingAllocator.cpp.
        seeds: whether torch's generator takes its next numbers for those of a capture.
        no_waits: whether torch is to refuse what waits for the device.
        living, cached: pools with graphs, and those whose graphs are no more.
    """

    legacy: Any
    capture: Any = None
    warp_knows: bool = False
    warp_runs: bool = False
    underway: list[Any] = field(default_factory=list)
    seeds: bool = False
    no_waits: bool = False
    living: int = 0
    cached: int = 0

    def drop(self) -> None:
        """A pool's graphs are no more. Its memory stays cached, for nobody else."""
        self.living, self.cached = self.living - 1, self.cached + 1

    def captures(self, stream: Any) -> bool:
        return self.capture is not None and self.capture.stream is stream


Rule = Callable[[Act, State], bool]
RULES: Final[list[Rule]] = []
CHECKS: Final[list[Rule]] = []
"""Those that torch checks before CUDA hears of it, so that a capture goes on."""


def rule(refuses: Rule) -> Rule:
    RULES.append(refuses)
    return refuses


def check(refuses: Rule) -> Rule:
    CHECKS.append(refuses)
    return rule(refuses)


# The first fault that a GPU showed.
@check
def pool_before_the_end(a: Act, _: State) -> bool:
    """Called CUDAGraph::pool() without a preceding successful capture (torch)."""
    return a.what == "pool" and not a.graph.captured


@check
def replay_before_the_end(a: Act, _: State) -> bool:
    """Called CUDAGraph::replay without a preceding successful capture (torch)."""
    return a.what == "replay" and not a.graph.captured


@check
def begin_on_the_default_stream(a: Act, s: State) -> bool:
    """CUDA graphs must be captured on a non-default stream (torch)."""
    return a.what == "begin" and a.on is s.legacy


@check
def begin_of_a_graph_that_is_captured(a: Act, _: State) -> bool:
    """This CUDAGraph instance already owns a captured graph (torch)."""
    return a.what == "begin" and a.graph.captured


@rule
def second_begin(a: Act, s: State) -> bool:
    """Operation not permitted: a capture is under way already."""
    return a.what == "begin" and s.capture is not None


@rule
def end_without_begin(a: Act, s: State) -> bool:
    """Operation failed: this graph is not being captured, or not on this stream (torch, CUDA)."""
    return a.what == "end" and not (s.capture is a.graph and s.captures(a.on))


# The second fault that a GPU showed.
@check
def a_stream_before_warp_begins(a: Act, s: State) -> bool:
    """'NoneType' object has no attribute 'cuda_devices' (Warp's stream_from_torch, before `warp.init`)."""
    return a.what == "warp stream" and not s.warp_runs


@rule
def warp_joins_what_is_captured(a: Act, s: State) -> bool:
    """External capture reported, but the stream is not capturing (Warp's capture_begin)."""
    return a.what == "warp begin" and not s.captures(a.on)


@rule
def warp_ends_what_it_began(a: Act, s: State) -> bool:
    """Graph capture is not active on this stream (Warp's capture_end)."""
    return a.what == "warp end" and not s.warp_knows


@rule
def sort_that_warp_does_not_know_of(a: Act, s: State) -> bool:
    """Allocating a temporary sort buffer during unregistered graph capture (Warp; a warning, and the memory leaks)."""
    return a.what == "sort" and s.capture is not None and not s.warp_knows


@rule
def waiting_for_the_device(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: the host waits, to read numbers or to know how many there are."""
    return a.what == "read" and s.capture is not None


@rule
def pinning_memory(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: cudaHostAlloc, in the modes global and thread_local, and the query of
    an event that precedes it (of a torch whose pinned memory has no pools of graphs).
    """
    return a.what == "pin" and s.capture is not None


@rule
def freeing_pinned_memory(a: Act, s: State) -> bool:
    """Operation not permitted on an event last recorded in a capturing stream: torch records one where pinned memory is freed, on
    each stream that has copied it, and asks for it whenever it pins memory later (CachingHostAllocatorImpl::free).
    """
    return a.what == "unpin" and s.captures(a.on)


@check
def sending_where_waits_are_refused(a: Act, s: State) -> bool:
    """Called a synchronizing CUDA operation: a copy from memory that is not pinned, as of `new_tensor` (torch, after
    `set_sync_debug_mode("error")`; of reads outside of a capture it is not known here which are of the device).
    """
    return a.what == "send" and s.no_waits


@rule
def sending_numbers_of_python(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: a copy from memory that is not pinned, as of torch.tensor."""
    return a.what == "send" and s.capture is not None


@rule
def allocating_outside_the_pool(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: cudaMalloc, by Warp or by torch on a stream that is not captured."""
    return a.what == "allocate" and s.capture is not None and (a.by_warp or not s.captures(a.on))


@check
def allocating_beside_what_is_cached(a: Act, s: State) -> bool:
    """CUDA out of memory: torch gives cached memory back only where no capture is underway (alloc_block in its allocator)."""
    return a.what == "allocate" and s.capture is not None and s.living + s.cached > ROOM


@check
def emptying_the_cache_in_a_capture(a: Act, s: State) -> bool:
    """captures_underway.empty() INTERNAL ASSERT FAILED (torch, also after a capture that CUDA has ended by an error: see
    CUDAGraph::capture_end, whose endAllocateToPool comes after the check of cudaStreamEndCapture).
    """
    return a.what == "empty" and bool(s.underway)


@check
def random_numbers_after_a_failed_capture(a: Act, s: State) -> bool:
    """Offset increment outside graph capture encountered unexpectedly (torch: a capture that CUDA has ended by an error leaves
    the generator as within it; torch 2.13 has a state for each capture).
    """
    return a.what == "random" and s.capture is None and s.seeds


@rule
def timing_in_a_capture(a: Act, s: State) -> bool:
    """Operation not permitted on an event last recorded in a capturing stream: it has no time, and cannot be asked for one."""
    return a.what == "event" and s.captures(a.on)


@rule
def destroying_a_graph(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: cudaGraphExecDestroy, where torch does not relax the mode for it."""
    return a.what == "destroy" and s.capture is not None


@check
def a_graph_of_autograd_on_another_stream(a: Act, _: State) -> bool:
    """The AccumulateGrad node's stream does not match the stream of the node that produced the incoming gradient (torch from
    2.10 on; a warning, and each backward pass waits).
    """
    return a.what == "graph" and bool(a.on.records)


@rule
def loading_a_module(a: Act, s: State) -> bool:
    """Operation not permitted when stream is capturing: cuModuleLoadData, by drivers before CUDA 12.3 (Warp's capture_begin)."""
    return a.what == "load" and s.capture is not None


@rule
def waiting_for_a_capturing_stream(a: Act, s: State) -> bool:
    """Operation would make the legacy stream depend on a capturing blocking stream."""
    return a.what == "wait" and s.captures(a.other)


@rule
def a_capturing_stream_waiting(a: Act, s: State) -> bool:
    """Dependency created on uncaptured work in another stream."""
    return a.what == "wait" and s.captures(a.on)


@rule
def work_on_another_stream(a: Act, s: State) -> bool:
    """Operation on a stream that is not captured: refused on the default stream, and missing from the graph on others."""
    return a.what in ("work", "sort", "replay") and s.capture is not None and not s.captures(a.on)


@rule
def anything_after_a_failure(a: Act, s: State) -> bool:
    """Operation failed due to a previous error during capture. So does the end, which ends the capture all the same."""
    return s.capture is not None and s.capture.invalid and a.what not in ("end", "warp end")


@rule
def reading_memory_that_was_freed(a: Act, _: State) -> bool:
    """The graph reads memory that has been freed since it was captured (torch's check_input_liveness)."""
    return a.what == "replay" and a.freed
