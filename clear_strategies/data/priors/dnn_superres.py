"""The networks of OpenCV contrib's dnn_superres: EDSR, ESPCN, FSRCNN and LapSRN."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.checks import require_choice
from clear_strategies.data.priors.interface import finished, require_file, require_path
from clear_strategies.errors import DataError

_MODELS: Final = ("edsr", "espcn", "fsrcnn", "lapsrn")

# dnn_superres replaces OpenCV's DepthToSpace layer for the rest of the process. Every ONNX network read after that
# shuffles its pixels wrongly, without an error. Therefore dnn_superres runs in a process of its own, which reads and
# writes raw RGB.
_PROGRAM: Final = """
import sys, numpy, cv2
_, path, kind, factor = sys.argv
data = sys.stdin.buffer.read()
height, width = numpy.frombuffer(data[:16], "<i8")
rgb = numpy.frombuffer(data[16:], numpy.uint8).reshape(height, width, 3)
network = cv2.dnn_superres.DnnSuperResImpl_create()
network.readModel(path)
network.setModel(kind, int(factor))
bgr = network.upsample(numpy.ascontiguousarray(rgb[..., ::-1]))
sys.stdout.buffer.write(numpy.ascontiguousarray(bgr[..., ::-1]).tobytes())
"""


@dataclass(frozen=True, slots=True)
class DnnSuperres:
    """One of these networks, applied to the whole image in 8 bits.

    Args:
        path: the .pb file.
        model: its kind: edsr, espcn, fsrcnn or lapsrn.

    Raises:
        SettingError: no path is given, or the kind is another.
    """

    path: str = ""
    model: str = "espcn"

    def __post_init__(self) -> None:
        require_path(self.path, "the model, a .pb file")
        require_choice("prior.model", self.model, _MODELS)

    @property
    def label(self) -> str:
        return f"dnn_superres {Path(self.path).name}"

    @property
    def files(self) -> tuple[Path, ...]:
        return (Path(self.path),)

    def __call__(self, name: str, lr: Float[Tensor, "h w 3"], factor: int) -> Float[Tensor, "H W 3"]:
        began = time.perf_counter()
        require_file(Path(self.path), "the model, a .pb file")
        small = (images.quantize(lr) * 255).byte().cpu().numpy()
        command = [sys.executable, "-c", _PROGRAM, str(Path(self.path).absolute()), self.model, str(factor)]
        shape = np.array(small.shape[:2], "<i8").tobytes()
        child = subprocess.run(command, input=shape + small.tobytes(), capture_output=True, check=False)  # noqa: S603
        height, width = small.shape[0] * factor, small.shape[1] * factor
        if child.returncode:
            lines = child.stderr.decode(errors="replace").strip().splitlines() or [f"exit status {child.returncode}"]
            reason = next((line for line in lines if "Error" in line or "error" in line), lines[-1])
            raise DataError(
                self.path, "network", f"cannot be run as {self.model} x{factor} ({reason})",
                "set prior.model to the model's kind; dnn_superres needs opencv-contrib-python-headless",
            )  # fmt: skip
        if len(child.stdout) != height * width * 3:
            problem = f"does not enlarge {small.shape[1]}x{small.shape[0]} to {width}x{height}"
            raise DataError(self.path, "network", problem, f"use a x{factor} model")
        large = np.frombuffer(child.stdout, np.uint8).reshape(height, width, 3).copy()
        return finished(name, self.label, torch.from_numpy(large).to(lr) / 255, lr, factor, began)
