"""A peer: the throw-away CPU rasterizer that showed what two cores can do, where its folder is.

It is built on the fly and lives in a process of its own: it is compiled with -ffast-math, which would switch this
process to flush-to-zero. It answers request by request, so its turns alternate with ours.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.bench.accuracy import Picture
from clear_strategies.bench.scenes import SETTINGS, Workload
from clear_strategies.errors import ClearError

_WORKER: Final = Path(__file__).with_name("prototype_worker.py")
_FILES: Final = ("build.sh", "gs.cpp", "gs.py", "simd.h")
_INSTRUCTIONS: Final = {"avx512f", "avx512bw", "avx512dq", "avx512vl"}
_BUILD_SECONDS: Final = 300


class PrototypeError(ClearError, RuntimeError):
    """The peer's process ended or answered an error."""


@contextmanager
def started(folder: Path | None, threads: int) -> Iterator[Prototype | str]:
    """The prototype at work, or the reason why not.

    Args:
        folder: where its sources are; None: ../shared/prototype beside the repository.
    """
    folder = folder if folder is not None else Path(__file__).resolve().parents[2].parent / "shared" / "prototype"
    if reason := _why_not(folder):
        yield reason
        return
    with ExitStack() as stack:
        build = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bench-prototype-")))
        if reason := _build(folder, build):
            yield reason
            return
        # -P: this folder's names shadow no library. -B: nothing is written beside the sources.
        command = [sys.executable, "-P", "-B", str(_WORKER), str(folder), str(build), str(threads)]
        pipe, patient = subprocess.PIPE, {**os.environ, "OMP_WAIT_POLICY": "passive"}
        worker = stack.enter_context(
            subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, env=patient)  # noqa: S603
        )
        stack.callback(worker.terminate)
        try:
            yield Prototype(worker, build)
        finally:
            if worker.stdin is not None:
                worker.stdin.close()


class Prototype:
    """Requests to the worker; every answer's milliseconds are its own, taken without the pipe."""

    def __init__(self, worker: subprocess.Popen[str], folder: Path) -> None:
        self._worker, self._folder = worker, folder

    def scene(self, workload: Workload, cotangents: Float[Tensor, "K H W 3"]) -> None:
        """What the following requests draw."""
        splats, camera = workload.splats, workload.camera
        if splats.rgb_offset is not None:
            raise PrototypeError("the prototype knows no rgb_offset; fold it into sh0.")
        file = self._folder / "scene.npz"
        np.savez(
            file,
            mean=splats.means, quat=splats.quats, scale=splats.scales, op=splats.opacities,
            sh=torch.cat((splats.sh0, splats.shN), 1), cotangents=cotangents, pose=camera.world_to_camera.double(),
        )  # fmt: skip
        intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        degree = math.isqrt(splats.shN.shape[1] + 1) - 1
        common = {"kernel": SETTINGS["kernel"], "alpha_max": SETTINGS["alpha_max"]}
        self._ask("scene", file=str(file), degree=degree, **intrinsics, **common)
        file.unlink()

    def forward(self, cuts: Mapping[str, float]) -> float:
        """Milliseconds of projection, binning and blending at these cut-offs."""
        return float(self._ask("forward", **cuts)["ms"])

    def backward(self, k: int) -> float:
        """Milliseconds of the transpose of the last forward, for the first k cotangents, down to the Gaussians."""
        return float(self._ask("backward", k=k)["ms"])

    def picture(self, cuts: Mapping[str, float]) -> Picture:
        """The image, and the gradients for the first cotangent."""
        file = self._folder / "picture.npz"
        self._ask("picture", file=str(file), **cuts)
        with np.load(file) as saved:
            found = {name: torch.from_numpy(saved[name]) for name in saved.files}
        file.unlink()
        return Picture(found.pop("image"), found)

    def _ask(self, request: str, **facts: Any) -> dict[str, Any]:
        pipe_in, pipe_out = self._worker.stdin, self._worker.stdout
        if pipe_in is None or pipe_out is None:
            raise PrototypeError("the prototype's process has no pipes.")
        try:
            pipe_in.write(json.dumps({"do": request, **facts}) + "\n")
            pipe_in.flush()
            line = pipe_out.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            said = self._worker.stderr.read().strip().splitlines() if self._worker.stderr is not None else []
            raise PrototypeError(f"the prototype's process ended: {said[-1] if said else 'it said nothing'}.")
        answer: dict[str, Any] = json.loads(line)
        return answer


def _why_not(folder: Path) -> str | None:
    missing = [name for name in _FILES if not (folder / name).is_file()]
    if missing:
        return f"its {missing[0]} is not here; give its folder with --prototype"
    if shutil.which("g++") is None or shutil.which("bash") is None:
        return "there is no g++ to build it"
    try:
        flags = set(Path("/proc/cpuinfo").read_text().split())
    except OSError:
        flags = set()
    if not flags >= _INSTRUCTIONS:
        return "this processor lacks AVX-512"
    return None


def _build(folder: Path, build: Path) -> str | None:
    """Run its script; the reason where that fails, e.g. without OpenMP."""
    try:
        done = subprocess.run(  # noqa: S603
            ["bash", str(folder / "build.sh"), str(build)],  # noqa: S607
            capture_output=True, text=True, timeout=_BUILD_SECONDS, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"it cannot be built ({error})"
    if not (build / "libgs.so").is_file():
        said = [line for line in done.stderr.splitlines() if "error" in line] or done.stderr.splitlines() or ["?"]
        return f"it cannot be built ({said[0].strip()})"
    return None
