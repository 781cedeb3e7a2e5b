"""The process in which the prototype runs: requests on stdin, answers on stdout, one JSON object a line.

    python -P -B prototype_worker.py SOURCES BUILD THREADS

Imports neither torch nor this library: its OpenMP has the process to itself.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


class Worker:
    """One scene at a time."""

    def __init__(self, sources: Path, build: Path, threads: int) -> None:
        sys.path.insert(0, str(sources))
        import gs  # type: ignore[import-not-found]  # the prototype's own binding

        self.gs, self.threads = gs, threads
        self.library = gs.Lib(str(build / "libgs.so"))
        self.context = gs.GS(self.library)

    def scene(self, file: str, degree: int, fx: float, fy: float, cx: float, cy: float, width: int, height: int,
              kernel: float, alpha_max: float) -> dict[str, Any]:  # fmt: skip
        with np.load(file) as saved:
            arrays = {name: np.ascontiguousarray(saved[name]) for name in saved.files}
        self.cotangents, pose = list(arrays.pop("cotangents")), arrays.pop("pose")
        self.gaussians = {**arrays, "deg": degree}
        self.camera = self.gs.cam(pose, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]))
        self.size, self.kernel, self.alpha_max = (width, height), kernel, alpha_max
        self.library.l.gs_free(self.context.c)
        self.context = self.gs.GS(self.library)
        k, n = len(self.cotangents), len(arrays["mean"])
        self.geometry = [np.zeros((n, 11), np.float32) for _ in range(k)]
        self.colour = [np.zeros(arrays["sh"].shape, np.float32) for _ in range(k)]
        return {}

    def forward(self, alpha_min: float, transmittance_min: float) -> dict[str, Any]:
        options = self.gs.opt(
            eps2d=self.kernel, acut=alpha_min, tcut=transmittance_min, amax=self.alpha_max, nthr=self.threads
        )
        began = time.perf_counter()
        self.context.project(self.gaussians, self.camera, *self.size, options)
        self.context.bin()
        self.image = self.context.forward()
        return {"ms": 1e3 * (time.perf_counter() - began)}

    def backward(self, k: int) -> dict[str, Any]:
        began = time.perf_counter()
        self.context.backward(self.cotangents[:k])
        self.context.pbwd(self.gaussians, self.geometry[:k], self.colour[:k])
        return {"ms": 1e3 * (time.perf_counter() - began)}

    def picture(self, file: str, alpha_min: float, transmittance_min: float) -> dict[str, Any]:
        for array in (self.geometry[0], self.colour[0]):
            array[:] = 0  # rows that are not seen are not written
        self.forward(alpha_min, transmittance_min)
        self.backward(1)
        g, sh = self.geometry[0], self.colour[0]
        np.savez(
            file,
            image=self.image, means=g[:, :3], quats=g[:, 3:7], scales=g[:, 7:10], opacities=g[:, 10],
            sh0=sh[:, :1], shN=sh[:, 1:],
        )  # fmt: skip
        return {}


def main() -> None:
    sources, build, threads = sys.argv[1:]
    worker = Worker(Path(sources), Path(build), int(threads))
    for line in sys.stdin:
        request = json.loads(line)
        answer: Callable[..., dict[str, Any]] = getattr(worker, request.pop("do"))
        sys.stdout.write(json.dumps(answer(**request)) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
