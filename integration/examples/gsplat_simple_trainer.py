"""gsplat's own `examples/simple_trainer.py` with CLEAR attached, and what a step costs: needs CUDA and gsplat's examples.

    python -m integration.examples.gsplat_simple_trainer --examples GSPLAT/examples --data-dir data/360_v2/garden \
        --data-factor 16 --sr span_x4.onnx --steps 2000

Trains the scene twice, without and with the strategies, and prints milliseconds a step and PSNR of both. Not yet run: no
machine with CUDA has been at hand.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch

from clear_strategies.compose import conductor
from clear_strategies.core.view import View
from clear_strategies.data.priors import Images, Onnx
from integration.gsplat_strategy import ClearStrategy
from integration.views import SuperResolve, view


def training_views(trainer: Any, config: Any, sr: SuperResolve) -> list[View]:
    """The trainer's own photographs and cameras, in its normalized world."""
    parser = trainer.Parser(
        data_dir=config.data_dir, factor=config.data_factor, normalize=config.normalize_world_space,
        test_every=config.test_every,
    )  # fmt: skip
    dataset = trainer.Dataset(parser, split="train")
    return [
        view(
            parser.image_names[dataset.indices[i]], item["image"].cuda() / 255, torch.linalg.inv(item["camtoworld"]).cuda(),
            item["K"], sr,
        )
        for i, item in enumerate(dataset)
    ]  # fmt: skip


def train(trainer: Any, config: Any) -> tuple[float, float]:
    """Milliseconds a step, and PSNR of the held-out photographs at the photographs' own size."""
    runner = trainer.Runner(0, 0, 1, config)
    torch.cuda.synchronize()
    began = time.perf_counter()
    runner.train()
    torch.cuda.synchronize()
    took = time.perf_counter() - began
    stats = sorted(Path(config.result_dir, "stats").glob("val_step*.json"))
    return 1000 * took / config.max_steps, float(json.loads(stats[-1].read_text())["psnr"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", required=True, help="the folder examples/ of gsplat's repository")
    parser.add_argument("--data-dir", required=True)
    parser.add_argument(
        "--data-factor", type=int, default=4, help="photographs are made so many times smaller: these are LR"
    )
    parser.add_argument("--sr", required=True, help="a folder of SR pictures four times as large, or an ONNX network")
    parser.add_argument("--strategies", default="clear", help="as after +strategy=")
    parser.add_argument("--steps", type=int, default=2_000)
    parser.add_argument("--result-dir", default="results/clear")
    chosen = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error(
            "gsplat's rasterizer needs CUDA, and torch sees no device; on a CPU: integration.examples.gsplat_loop."
        )
    sys.path.insert(0, chosen.examples)
    import simple_trainer as trainer

    sr: SuperResolve = Onnx(chosen.sr) if chosen.sr.endswith(".onnx") else Images(chosen.sr)

    def config(name: str, strategy: Any) -> Any:
        return trainer.Config(
            disable_viewer=True, disable_video=True, data_dir=chosen.data_dir, data_factor=chosen.data_factor,
            result_dir=f"{chosen.result_dir}/{name}", max_steps=chosen.steps, eval_steps=[chosen.steps],
            save_steps=[], strategy=strategy,
        )  # fmt: skip

    window = {"refine_start_iter": chosen.steps // 20, "refine_stop_iter": chosen.steps // 2}
    alone = config("alone", trainer.DefaultStrategy(**window))
    views = training_views(trainer, alone, sr)
    clear = ClearStrategy(views=views, conductor=conductor(chosen.strategies, iterations=chosen.steps), **window)
    for name, settings in (("alone", alone), (chosen.strategies, config("clear", clear))):
        ms, psnr = train(trainer, settings)
        sys.stdout.write(f"{name}: {ms:.2f} ms a step, PSNR {psnr:.2f} dB\n")


if __name__ == "__main__":
    main()
