"""Runs documented commands in the working folder, one after the other in one process, each training as small as it can be.

The commands come as JSON: [["python", "-m", "clear_strategies.run", "+strategy=gco"], …].
"""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from clear_strategies import run
from tests.helpers import captures, networks
from tests.helpers.command_line import ALONE, OF_DEMO, RANDOM_POINTS

TINY = ["fit.iterations=4", *ALONE, *RANDOM_POINTS]
PACKAGE = "your_package"
CLEAR = "outputs/clear"


def your_data() -> None:
    """What the pages call my/photos, my/fern, sr and span_x4.onnx, all tiny."""
    captures.colmap_txt(Path("my/photos"))
    captures.llff(Path("my/fern"))
    Path("sr").mkdir()
    for i, name in enumerate(captures.NAMES):
        pixels = np.random.default_rng(i).integers(0, 256, (4 * captures.HEIGHT, 4 * captures.WIDTH, 3), np.uint8)
        Image.fromarray(pixels).save(Path("sr") / name)
    Path("span_x4.onnx").write_bytes(networks.onnx_bytes(networks.upscaling_weight()))


def follow(words: list[str]) -> None:
    """One command. Settings that make it tiny come last, but for those that it names itself besides its length."""
    if words[:3] == ["python", "-m", "clear_strategies.run"]:
        words = ["clear-strategies", *words[3:]]
    if words[0] == "clear-strategies":
        if words[1] not in ("render", "export") and "--cfg" not in words:
            demo = words[1] != "train" and not any(word.startswith("data=") for word in words)
            named = {word.split("=")[0] for word in words} - {"fit.iterations"}
            words = [*words, *(w for w in TINY + OF_DEMO * demo if w.split("=")[0] not in named)]
        sys.argv = words
        run.main()
    else:
        trains = words[2] != "clear_strategies.report"
        sys.argv = [words[2], *words[3:], *(["--iterations", "4"] if trains else [])]
        runpy.run_module(words[2], run_name="__main__")


def main() -> None:
    torch.set_num_threads(1)
    sys.path.insert(0, "")  # your_package
    your_data()
    lines = json.loads(sys.argv[1])
    if any(CLEAR in line for line in lines):
        follow(["clear-strategies", "+strategy=clear", f"hydra.run.dir={CLEAR}"])
    for line in lines:
        sys.stdout.write(f"$ {' '.join(line)}\n")
        follow(line)


if __name__ == "__main__":
    main()
