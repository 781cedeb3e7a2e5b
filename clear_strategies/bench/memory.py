"""Peak memory of a rendering and its transpose, measured in a process of its own: what else was allocated, and kept by
the allocator, in a long benchmark would hide it.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

_ROOT: Final = Path(__file__).resolve().parents[2]
_MIB: Final = 2**20
_RESET_PEAK: Final = "5"  # proc(5), clear_refs: VmHWM starts again from what is resident


def peaks(
    scene: str,
    data: Path | None,
    backend: str,
    presets: Sequence[str],
    threads: int,
    *,
    device: str,
    seconds: float,
    is_peer: bool = False,
) -> dict[str, float] | str:
    """MiB that forward and backward (K = 2) add at their peak, by preset; the reason where it cannot be measured.

    On CUDA it is what torch's allocator handed out; what a library takes from the driver itself is not in it.
    """
    task = {
        "scene": scene, "data": str(data) if data is not None else None, "backend": backend, "presets": list(presets),
        "threads": threads, "device": device, "is_peer": is_peer,
    }  # fmt: skip
    paths = os.pathsep.join(filter(None, (str(_ROOT), os.environ.get("PYTHONPATH"))))
    command = [sys.executable, "-m", __name__, json.dumps(task)]
    try:
        child = subprocess.run(  # noqa: S603 - this very interpreter
            command,
            env={**os.environ, "PYTHONPATH": paths},
            capture_output=True,
            text=True,
            timeout=seconds,
            check=True,
        )
        found: dict[str, float] = json.loads(child.stdout.splitlines()[-1])
    except subprocess.CalledProcessError as error:
        return (error.stderr or "the child process failed").strip().splitlines()[-1]
    except subprocess.TimeoutExpired:
        return f"it took more than {seconds:.0f} s"
    except (OSError, ValueError, IndexError) as error:
        return str(error)
    return found


def measure(task: Mapping[str, Any]) -> dict[str, float]:
    """In the child: MiB by preset."""
    import torch

    from clear_strategies.bench import scenes

    torch.set_num_threads(task["threads"])
    workload = scenes.load(task["scene"], Path(task["data"]) if task["data"] else None)
    warm = scenes.load("tiny")
    if isinstance(workload, str) or isinstance(warm, str):
        raise TypeError(workload)
    workload, warm = workload.to(task["device"]), warm.to(task["device"])
    on_cuda = task["device"] == "cuda"
    found = {}
    for i, preset in enumerate(task["presets"]):
        draw = _drawing(task["backend"], preset, is_peer=task["is_peer"])
        if i == 0:  # libraries, thread pools
            draw(warm)
            before = torch.cuda.memory_allocated() / _MIB if on_cuda else _resident("VmRSS")
        _release()
        _reset_peak()
        if on_cuda:
            torch.cuda.reset_peak_memory_stats()
        draw(workload)
        after = torch.cuda.max_memory_allocated() / _MIB if on_cuda else _resident("VmHWM")
        found[preset] = max(0.0, after - before)
    return found


def _drawing(backend: str, preset: str, *, is_peer: bool) -> Callable[[Any], None]:
    """Forward, and backward of two cotangents, of a workload."""
    import torch

    import rasterizers
    from clear_strategies.bench import peers, scenes

    def cotangents(workload: Any) -> Any:
        camera = workload.camera
        return torch.ones(2, camera.height, camera.width, 3, device=workload.splats.means.device)

    if not is_peer:
        rasterizer = rasterizers.load(backend, preset=preset, **scenes.SETTINGS)

        def draw(workload: Any) -> None:
            rasterizer(workload.splats, workload.camera).vjp(cotangents(workload))

        return draw
    said: list[str] = []
    peer = next((peer for peer in peers.found(said.append) if peer.name == backend), None)
    if peer is None:
        raise LookupError(" ".join(said))

    def draw_peer(workload: Any) -> None:
        drawing = peer.draw(workload)
        for cotangent in cotangents(workload):
            drawing.vjp(cotangent)

    return draw_peer


def _resident(field: str) -> float:
    """MiB; from the kernel's accounting where /proc is missing."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(field)) / 1024
    except (OSError, StopIteration):
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _reset_peak() -> None:
    try:
        Path("/proc/self/clear_refs").write_text(_RESET_PEAK)
    except OSError:
        return  # best effort: the peak is then that of the whole process


def _release() -> None:
    """Give back what the allocator keeps, so that one preset does not pay for another."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if os.name == "posix" else None
    if trim is not None:
        trim(0)


if __name__ == "__main__":
    sys.stdout.write(json.dumps(measure(json.loads(sys.argv[1]))) + "\n")
