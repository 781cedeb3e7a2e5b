"""gsplat's documented loop with CLEAR, on the built-in demo: `python -m integration.examples.gsplat_loop`.

The loop and DefaultStrategy are gsplat's; `# +` marks the added lines, which the README shows. On a GPU gsplat's own function
draws, on a CPU this package's in its place.
"""

from __future__ import annotations

import argparse
import logging
import sys
from typing import Any

import torch
from gsplat import rasterization as cuda_rasterization
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from clear_strategies.compose import conductor  # +
from clear_strategies.geometry import stereo
from clear_strategies.kernels import losses
from integration.examples.demo import Demo, Render, load_demo, splats_with_optimizers
from integration.gsplat import attach  # +
from integration.loss import with_gradients
from integration.views import view  # +
from rasterizers import native
from rasterizers.as_gsplat import rasterization as cpu_rasterization


def main(iterations: int, strategies: str | None, seed: int = 0) -> float:
    """Train on the demo; returns the mean PSNR of its test views at HR in dB."""
    demo, render = train(iterations, strategies, seed)
    return demo.psnr(render)


def train(iterations: int, strategies: str | None, seed: int = 0) -> tuple[Demo, Render]:
    """Train on the demo; returns it, and what draws the splats."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    demo = load_demo(device=device)
    photos = list(zip(demo.names, demo.images, demo.viewmats, demo.Ks, strict=True))
    points = stereo(demo.images, demo.viewmats, demo.Ks)
    splats, optimizers = splats_with_optimizers(points.means, points.colors)
    strategy = DefaultStrategy(  # its pruning by size, from `reset_every` on, would remove half of these points
        refine_start_iter=iterations // 20, refine_stop_iter=iterations // 2, refine_every=max(1, iterations // 40),
        reset_every=iterations, grow_grad2d=1.5e-3,
    )  # fmt: skip
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)

    rasterization = cuda_rasterization if device == "cuda" else cpu_rasterization
    if strategies is not None:
        clear = conductor(strategies, iterations=iterations)  # +
        views = [view(*photo, sr=clear.prior(demo.prior)) for photo in photos]  # +
        attached = attach(splats, optimizers, views, clear, strategy=strategy, seed=seed)  # +
        rasterization = attached.wrap(rasterization)  # +

    def render(viewmat: Tensor, K: Tensor, width: int, height: int) -> tuple[Tensor, dict[str, Any]]:
        p = splats
        image, _, info = rasterization(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat((p["sh0"], p["shN"]), 1),
            viewmat[None], K[None], width, height, sh_degree=3, packed=False, rasterize_mode="antialiased",
        )  # fmt: skip
        return image[0], info

    for step in range(iterations):
        _, target, viewmat, K = photos[step % len(photos)]
        image, info = render(viewmat, K, target.shape[1], target.shape[0])
        strategy.step_pre_backward(splats, optimizers, state, step, info)
        value, gradient = losses.photometric(image.detach(), target, 0.2)  # 0.8 L1 + 0.2 (1 - SSIM), the loss of 3DGS
        loss = with_gradients(value, [gradient], image)
        loss.backward()  # type: ignore[no-untyped-call]
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(splats, optimizers, state, step, info, packed=False)
        if (step + 1) % max(1, iterations // 5) == 0:
            logging.info("step %d: loss %.4f, %d Gaussians", step + 1, float(loss.detach()), len(splats["means"]))
    return demo, lambda *camera: render(*camera)[0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--strategies", default="clear", help="as in +strategy=; none: the loop alone")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.manual_seed(options.seed)  # gsplat splits Gaussians with torch's global generator
    # torch's threads would otherwise occupy the cores that the kernels use
    with native.kernel_threads(native.threads()):
        result = main(options.iterations, None if options.strategies == "none" else options.strategies, options.seed)
    sys.stdout.write(f"{options.strategies}: {result:.2f} dB on the test views at HR\n")
