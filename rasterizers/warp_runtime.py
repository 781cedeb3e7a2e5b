"""Shared by all Warp code: a check that Warp runs here, torch tensors as kernel arguments, launches, and torch's stream.

Used by `rasterizers.warp_backend` and by the Warp kernels in `clear_strategies.kernels`. Imports Warp only when called.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from struct import Struct
from typing import Any, Final

import torch
from torch import Tensor

from rasterizers.interface import BackendUnavailable
from rasterizers.recording import running, warp_stream
from rasterizers.sending import sent


def require_warp(what: str, device: str, otherwise: str) -> None:
    """Check that Warp can run `what`, before it is imported, and silence Warp's output on stdout.

    Args:
        what: names the caller in the error message.
        device: "cuda" or "cpu".
        otherwise: says in the error message what runs without CUDA.

    Raises:
        BackendUnavailable: Warp is not installed or too old, or there is no CUDA device.
    """
    install = "pip install -U 'clear-strategies[warp]'"
    try:
        import warp as wp
    except ImportError as error:
        raise BackendUnavailable(f"{what} needs NVIDIA Warp, which is not installed ({error}); {install}.") from error
    major, minor, *_ = wp.config.version.split(".")
    # 1.17 does not compile `ellipses[listed[pair]]`. Until 1.16, a sort may free the memory in which a CUDA graph sorts, and a
    # replay would read it (NVIDIA/warp#1373).
    if (int(major), int(minor)) < (1, 18):
        raise BackendUnavailable(f"{what} needs NVIDIA Warp 1.18 or later, got {wp.config.version}; {install}.")
    # Warp would print a greeting and a line per compilation to stdout, which belongs to the application.
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    if device != "cuda":
        return
    missing = None
    if not torch.cuda.is_available():
        missing = "torch finds no CUDA device. Install NVIDIA's driver and a torch built for CUDA"
    elif wp.get_cuda_device_count() == 0:
        missing = "torch finds a CUDA device, Warp does not. Update NVIDIA's driver or warp-lang"
    if missing:
        raise BackendUnavailable(f"{what} cannot run on CUDA: {missing}; {otherwise}.")


@cache
def runs_warp(device: str) -> bool:
    """Return True if Warp runs on "cuda", or on "cpu"."""
    try:
        require_warp("a kernel", device, "torch computes the same")
    except BackendUnavailable:
        return False
    return True


def launch(
    kernel: Any, dim: Sequence[int], arguments: Sequence[Any], device: torch.device, *, block: int = 256, together: bool = False
) -> None:  # fmt: skip
    """Launch a kernel with a thread for each index of `dim`, in a scope of `on_stream`.

    Does the same as `wp.launch` in a fifth of the host's time, which on CUDA exceeds the kernels': arguments that do not change
    are converted once. With an empty `dim` it only compiles and loads the kernel, which a recording cannot.

    Args:
        arguments: numbers, structures of `struct`, and tensors or None for the kernel's arrays, see `array`.
        block: threads per block. together: a block for each index of `dim`, as of `wp.launch_tiled`.
    """
    size = (*dim, block) if together else tuple(dim)
    key = kernel, device, block
    kept = _kept.launches.get(key)
    if kept is None:
        kept = _kept.launches[key] = _Launch(kernel, device, block)
    if 0 in size:
        return
    kept.prepare(size, arguments).launch(_kept.stream)
    if (recording := running()) is not None:
        recording.launched(arguments)


class _Launch:
    """A launch that converts its size and arguments only when they change."""

    def __init__(self, kernel: Any, device: torch.device, block: int) -> None:
        import warp as wp

        wp.init()
        self.command = wp.Launch(kernel, wp.device_from_torch(device), block_dim=block)
        self.on_cuda = device.type == "cuda"
        self.size: tuple[int, ...] = ()
        self.bounds: dict[tuple[int, ...], Any] = {}  # Warp's description of a size, for the sizes so far
        self.kinds = [argument.type for argument in kernel.adj.args]
        # For each argument that is an array: by type, shape and strides, its description, of which only the address changes.
        self.arrays: list[dict[Any, Any] | None] = [{} if wp.types.is_array(kind) else None for kind in self.kinds]

    def prepare(self, size: tuple[int, ...], arguments: Sequence[Any]) -> Any:
        command = self.command
        params = command.params  # the bounds, and the arguments
        if size != self.size:
            self._resize(size)
        for index, (argument, known) in enumerate(zip(arguments, self.arrays, strict=True), 1):
            if known is None and not isinstance(argument, ctypes.Structure):
                params[index].value = argument
                continue
            if known is None:
                params[index] = argument
            elif argument is None:
                params[index] = _empty_array()
            else:
                layout = argument.dtype, argument.shape, argument.stride()
                described = params[index] = known.get(layout) or self._described(index, layout, argument)
                described.data = argument.data_ptr()
            if self.on_cuda:
                command.params_addr[index] = ctypes.addressof(params[index])
        return command

    def _described(self, index: int, layout: Any, tensor: Tensor) -> Any:
        known = self.arrays[index - 1]
        if known is None or len(known) >= _MOST_SHAPES:
            known = self.arrays[index - 1] = {}
        known[layout] = array(tensor, self.kinds[index - 1])
        return known[layout]

    def _resize(self, size: tuple[int, ...]) -> None:
        """As `set_dim`, which takes as long as the launch: at two scales the sizes alternate."""
        command, self.size = self.command, size
        bounds = self.bounds.get(size)
        if bounds is None:
            if len(self.bounds) >= _MOST_SHAPES:
                self.bounds.clear()
            command.set_dim(size)
            self.bounds[size] = command.bounds
            return
        command.bounds = command.params[0] = bounds
        if self.on_cuda:
            command.params_addr[0] = ctypes.addressof(bounds)


class _Kept(threading.local):
    """A thread's launches, by kernel, device and threads per block, its arrays to be sorted, by length and device, and the stream
    of `on_stream`.
    """

    stream: Any = None

    def __init__(self) -> None:
        self.launches: dict[tuple[Any, torch.device, int], _Launch] = {}
        self.sorts: dict[tuple[int, torch.device], tuple[Any, ...]] = {}


_kept = _Kept()
_sorting: Final = threading.Lock()
_MOST_SHAPES: Final = 256  # the number of Gaussians, and so the shapes, change in a long training


def sort_pairs(keys: Tensor, values: Tensor, count: int, bits: int) -> None:
    """Sort the first `count` keys and values by key, stably, in a scope of `on_stream`; both have twice that length, for scratch.

    Does the same as `wp.utils.radix_sort_pairs`, but `wp.from_torch` would take longer than the sort: Warp's arrays are cached by
    length, and only their addresses change.
    """
    import warp as wp

    key = len(keys), keys.device
    arrays = _kept.sorts.get(key)
    if arrays is None:
        if len(_kept.sorts) >= _MOST_SHAPES:
            _kept.sorts.clear()
        device = wp.device_from_torch(keys.device)
        arrays = _kept.sorts[key] = tuple(
            wp.array(ptr=x.data_ptr(), shape=len(x), dtype=wp.int32, device=device) for x in (keys, values)
        )
    arrays[0].ptr, arrays[1].ptr = keys.data_ptr(), values.data_ptr()
    # Warp sorts on its current stream, which is that of all threads.
    with _sorting, wp.ScopedStream(_kept.stream, sync_enter=False):
        wp.utils.radix_sort_pairs(*arrays, count, end_bit=bits)
    if (recording := running()) is not None:
        recording.launched((keys, values))


def array(tensor: Tensor | None, kind: Any) -> Any:
    """A tensor as a kernel's array of type `kind`, without a copy; the caller keeps it alive. None becomes an empty array.

    The tensor may have more dimensions than the array: those of the array's vectors or matrices, or one with the numbers of a
    structure, and before them some that the array's last dimension goes through.

    Raises:
        TypeError: its numbers have another type than the array's.
        ValueError: its strides do not fit the array.
    """
    if tensor is None:
        return _empty_array()
    n, shape, strides = kind.ndim, tensor.shape, tensor.stride()
    if not (is_struct := hasattr(kind.dtype, "ctype")):
        _require_numbers(tensor, kind.dtype)
    inner = (
        (ctypes.sizeof(kind.dtype.ctype) // tensor.element_size(),) if is_struct else getattr(kind.dtype, "_shape_", ())
    )
    outer, dense = len(shape) - len(inner), tuple(math.prod(inner[k + 1 :]) for k in range(len(inner)))
    last = [
        (length, step) for length, step in zip(shape[n - 1 : outer], strides[n - 1 : outer], strict=True) if length != 1
    ]
    joined = strides[outer:] == dense and all(step == length * finer for (_, step), (length, finer) in pairwise(last))
    if not joined and 0 not in shape:
        raise ValueError(
            f"a tensor of shape {tuple(shape)} with strides {strides} is no array of {n} dimensions; copy it."
        )
    lengths = *shape[: n - 1], math.prod(length for length, _ in last)
    steps = *strides[: n - 1], last[-1][1] if last else math.prod(inner)
    in_bytes = [step * tensor.element_size() for step in steps]
    return type(_empty_array())(tensor.data_ptr(), 0, n, lengths, in_bytes)


def _require_numbers(tensor: Tensor, kind: Any) -> None:
    import warp as wp

    read, given = getattr(kind, "_wp_scalar_type_", kind), wp.dtype_from_torch(tensor.dtype)  # of a vector, of a number
    if given is not read:
        raise TypeError(f"a kernel reads numbers of type {read.__name__}, got {given.__name__}: cast the tensor.")


def struct(kind: Any, rows: Mapping[str, Tensor | None], **values: Any) -> Any:
    """A Warp structure as a kernel argument: `rows` as arrays, numbers. What is not given is empty, or 0.

    With rows, structures are kept by all but the addresses: most of a training's iteration are those of the iteration before.
    """
    given = {name: x for name, x in rows.items() if x is not None}
    if not given:
        return kind.ctype(**values)
    layouts = [part for x in given.values() for part in (x.dtype, x.shape, x.stride())]
    key = kind, *given, *values, *values.values(), *layouts
    known = _structures.get(key)
    if known is None:
        if len(_structures) >= _MOST_STRUCTURES:
            _structures.clear()
        arrays = {name: array(x, kind.vars[name].type) for name, x in given.items()}
        known = _structures[key] = bytes(kind.ctype(**arrays, **values))
    memory = bytearray(known)
    offsets = _offsets(kind)
    for name, tensor in given.items():
        _ADDRESS.pack_into(memory, offsets[name], tensor.data_ptr())
    return kind.ctype.from_buffer(memory)


def on_device(structure: Any, device: torch.device) -> Tensor:
    """A structure without arrays as an array of one, in a tensor of its bytes."""
    return sent(torch.frombuffer(bytearray(structure), dtype=torch.uint8)[None], device)


_MOST_STRUCTURES: Final = 1024
_structures: dict[tuple[Any, ...], bytes] = {}
_ADDRESS: Final = Struct("=Q")  # the first field of an array


@cache
def _empty_array() -> Any:
    """Warp's structure of an array: (address, address of the gradient, dimensions, shape, strides in bytes)."""
    import warp as wp

    return type(wp.from_torch(torch.empty(1, device="cpu"), return_ctype=True))()


@cache
def _offsets(kind: Any) -> Mapping[str, int]:
    """The offset of each field of a Warp structure."""
    return {name: getattr(kind.ctype, name).offset for name, _ in kind.ctype._fields_}


@contextmanager
def on_stream(device: torch.device) -> Iterator[None]:
    """A scope in which this thread launches on torch's current stream."""
    outer, current = _kept.stream, None if device.type == "cpu" else torch.cuda.current_stream(device)
    _kept.stream = None if current is None else warp_stream(current)
    try:
        yield
    finally:
        _kept.stream = outer
