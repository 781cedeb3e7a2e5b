"""gsplat's own `examples/simple_trainer.py` with and without CLEAR. Needs CUDA and gsplat's examples.

    python -m integration.examples.gsplat_simple_trainer --examples GSPLAT/examples --data-dir data/360_v2/garden \
        --data-factor 16 --sr span_x4.onnx --steps 2000

Trains the scene without and with the strategies, and prints milliseconds per step and the PSNR of both.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch

from clear_strategies.data.priors import Images, Onnx
from integration.gsplat import install
from integration.views import SuperResolve


def train(trainer: Any, config: Any) -> tuple[float, float]:
    """Milliseconds per step, and the PSNR of the held-out photos at their own size."""
    runner = trainer.Runner(0, 0, 1, config)
    torch.cuda.synchronize()
    start = time.perf_counter()
    runner.train()
    torch.cuda.synchronize()
    seconds = time.perf_counter() - start
    stats = sorted(Path(config.result_dir, "stats").glob("val_step*.json"))
    return 1000 * seconds / config.max_steps, float(json.loads(stats[-1].read_text())["psnr"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", required=True, help="the folder examples/ of gsplat's repository")
    parser.add_argument("--data-dir", required=True)
    parser.add_argument("--data-factor", type=int, default=4, help="divisor of the photos' size; the results are LR")
    parser.add_argument(
        "--sr", required=True, help="a folder of SR images four times as large as LR, or an ONNX network"
    )
    parser.add_argument("--strategies", default="clear", help="as in +strategy=")
    parser.add_argument("--steps", type=int, default=2_000)
    parser.add_argument("--result-dir", default="results/clear")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error(
            "gsplat's rasterizer needs CUDA, and torch finds no device. On a CPU, run integration.examples.gsplat_loop."
        )
    sys.path.insert(0, options.examples)
    import simple_trainer as trainer

    sr: SuperResolve = Onnx(options.sr) if options.sr.endswith(".onnx") else Images(options.sr)

    def config(name: str) -> Any:
        window = {"refine_start_iter": options.steps // 20, "refine_stop_iter": options.steps // 2}
        return trainer.Config(
            disable_viewer=True, disable_video=True, data_dir=options.data_dir, data_factor=options.data_factor,
            result_dir=f"{options.result_dir}/{name}", max_steps=options.steps, eval_steps=[options.steps],
            save_steps=[], strategy=trainer.DefaultStrategy(**window),
        )  # fmt: skip

    ms, psnr = train(trainer, config("alone"))
    sys.stdout.write(f"alone: {ms:.2f} ms per step, PSNR {psnr:.2f} dB\n")
    install(trainer.Runner, strategies=options.strategies, sr=sr)
    ms, psnr = train(trainer, config("clear"))
    sys.stdout.write(f"{options.strategies}: {ms:.2f} ms per step, PSNR {psnr:.2f} dB\n")


if __name__ == "__main__":
    main()
