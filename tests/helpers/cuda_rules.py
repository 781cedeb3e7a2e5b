"""What CUDA, torch and Warp refuse of streams and graphs: the list by which `strict_cuda` stands in for a GPU.

A fault that is found on a GPU becomes a rule here first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple


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


class Rule(NamedTuple):
    """A refusal.

    Args:
        of: what the acts do that it is about, "" for any. refuses: whether it refuses one of them.
        message: of the error; it says who refuses, without a name the CUDA runtime.
        check: whether torch checks it before CUDA hears of it, so that a capture goes on. What else is refused in a capture makes
            that capture invalid; where the source does not say so, too.
    """

    of: str
    refuses: Callable[[Act, State], bool]
    message: str
    check: bool = False


def capturing(a: Act, s: State) -> bool:
    return s.capture is not None


IN_A_CAPTURE: Final = "Operation not permitted when stream is capturing"
RULES: Final = {
    # The first fault that a GPU showed.
    "pool_before_the_end": Rule(
        "pool", lambda a, s: not a.graph.captured, "Called CUDAGraph::pool() without a preceding successful capture (torch).",
        check=True,
    ),
    "replay_before_the_end": Rule(
        "replay", lambda a, s: not a.graph.captured,
        "Called CUDAGraph::replay without a preceding successful capture (torch).", check=True,
    ),
    "begin_on_the_default_stream": Rule(
        "begin", lambda a, s: a.on is s.legacy, "CUDA graphs must be captured on a non-default stream (torch).", check=True
    ),
    "begin_of_a_graph_that_is_captured": Rule(
        "begin", lambda a, s: a.graph.captured, "This CUDAGraph instance already owns a captured graph (torch).", check=True
    ),
    "second_begin": Rule("begin", capturing, "Operation not permitted: a capture is under way already."),
    "end_without_begin": Rule(
        "end", lambda a, s: not (s.capture is a.graph and s.captures(a.on)),
        "Operation failed: this graph is not being captured, or not on this stream (torch, CUDA).",
    ),
    # The second fault that a GPU showed.
    "a_stream_before_warp_begins": Rule(
        "warp stream", lambda a, s: not s.warp_runs,
        "'NoneType' object has no attribute 'cuda_devices' (Warp's stream_from_torch, before `warp.init`).", check=True,
    ),
    "warp_joins_what_is_captured": Rule(
        "warp begin", lambda a, s: not s.captures(a.on),
        "External capture reported, but the stream is not capturing (Warp's capture_begin).",
    ),
    "warp_ends_what_it_began": Rule(
        "warp end", lambda a, s: not s.warp_knows, "Graph capture is not active on this stream (Warp's capture_end)."
    ),
    "sort_that_warp_does_not_know_of": Rule(
        "sort", lambda a, s: s.capture is not None and not s.warp_knows,
        "Allocating a temporary sort buffer during unregistered graph capture (Warp; a warning, and the memory leaks).",
    ),
    "waiting_for_the_device": Rule(
        "read", capturing, f"{IN_A_CAPTURE}: the host waits, to read numbers or to know how many there are."
    ),
    "pinning_memory": Rule(
        "pin", capturing, f"{IN_A_CAPTURE}: cudaHostAlloc, in the modes global and thread_local, and the query of an event that "
        "precedes it (of a torch whose pinned memory has no pools of graphs).",
    ),
    # Torch records an event where pinned memory is freed, on each stream that has copied it, and asks for it whenever it pins
    # memory later (CachingHostAllocatorImpl::free).
    "freeing_pinned_memory": Rule(
        "unpin", lambda a, s: s.captures(a.on), "Operation not permitted on an event last recorded in a capturing stream."
    ),
    # Of reads outside of a capture it is not known here which are of the device.
    "sending_where_waits_are_refused": Rule(
        "send", lambda a, s: s.no_waits, "Called a synchronizing CUDA operation: a copy from memory that is not pinned, as of "
        '`new_tensor` (torch, after `set_sync_debug_mode("error")`).', check=True,
    ),
    "sending_numbers_of_python": Rule(
        "send", capturing, f"{IN_A_CAPTURE}: a copy from memory that is not pinned, as of torch.tensor."
    ),
    "allocating_outside_the_pool": Rule(
        "allocate", lambda a, s: s.capture is not None and (a.by_warp or not s.captures(a.on)),
        f"{IN_A_CAPTURE}: cudaMalloc, by Warp or by torch on a stream that is not captured.",
    ),
    "allocating_beside_what_is_cached": Rule(
        "allocate", lambda a, s: s.capture is not None and s.living + s.cached > ROOM,
        "CUDA out of memory: torch gives cached memory back only where no capture is underway (alloc_block in its allocator).",
        check=True,
    ),
    # CUDAGraph::capture_end, whose endAllocateToPool comes after the check of cudaStreamEndCapture.
    "emptying_the_cache_in_a_capture": Rule(
        "empty", lambda a, s: bool(s.underway),
        "captures_underway.empty() INTERNAL ASSERT FAILED (torch, also after a capture that CUDA has ended by an error).",
        check=True,
    ),
    # Torch 2.13 has a state of the generator for each capture.
    "random_numbers_after_a_failed_capture": Rule(
        "random", lambda a, s: s.capture is None and s.seeds, "Offset increment outside graph capture encountered unexpectedly "
        "(torch: a capture that CUDA has ended by an error leaves the generator as within it).", check=True,
    ),
    "timing_in_a_capture": Rule(
        "event", lambda a, s: s.captures(a.on),
        "Operation not permitted on an event last recorded in a capturing stream: it has no time, and cannot be asked for one.",
    ),
    "destroying_a_graph": Rule(
        "destroy", capturing, f"{IN_A_CAPTURE}: cudaGraphExecDestroy, where torch does not relax the mode for it."
    ),
    "a_graph_of_autograd_on_another_stream": Rule(
        "graph", lambda a, s: bool(a.on.records), "The AccumulateGrad node's stream does not match the stream of the node that "
        "produced the incoming gradient (torch from 2.10 on; a warning, and each backward pass waits).", check=True,
    ),
    "loading_a_module": Rule(
        "load", capturing, f"{IN_A_CAPTURE}: cuModuleLoadData, by drivers before CUDA 12.3 (Warp's capture_begin)."
    ),
    "waiting_for_a_capturing_stream": Rule(
        "wait", lambda a, s: s.captures(a.other),
        "Operation would make the legacy stream depend on a capturing blocking stream.",
    ),
    "a_capturing_stream_waiting": Rule(
        "wait", lambda a, s: s.captures(a.on), "Dependency created on uncaptured work in another stream."
    ),
    "work_on_another_stream": Rule(
        "", lambda a, s: a.what in ("work", "sort", "replay") and s.capture is not None and not s.captures(a.on),
        "Operation on a stream that is not captured: refused on the default stream, and missing from the graph on others.",
    ),
    "anything_after_a_failure": Rule(
        "", lambda a, s: s.capture is not None and s.capture.invalid and a.what not in ("end", "warp end"),
        "Operation failed due to a previous error during capture. So does the end, which ends the capture all the same.",
    ),
    "reading_memory_that_was_freed": Rule(
        "replay", lambda a, s: a.freed,
        "The graph reads memory that has been freed since it was captured (torch's check_input_liveness).",
    ),
}  # fmt: skip
