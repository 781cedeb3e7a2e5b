"""gsplat's documented loop with CLEAR, on the built-in demo and a CPU: `python -m integration.examples.gsplat_loop`.

The loop and DefaultStrategy are gsplat's; `# +` marks the added lines. On a GPU, use gsplat's own function (`from gsplat
import rasterization`) and put the tensors on the device. Nothing else changes.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable
from typing import Any

import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from clear_strategies.compose import conductor
from clear_strategies.core import images
from clear_strategies.data.points import CloudSettings
from clear_strategies.data.prepare import prepare
from clear_strategies.data.priors import DemoPrior
from clear_strategies.data.readers import demo
from clear_strategies.data.scene import Scene
from clear_strategies.data.view_settings import ViewSettings
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.kernels import losses
from integration.examples.demo import splats_with_optimizers
from integration.gsplat import attach
from integration.views import view
from rasterizers import native
from rasterizers.autograd import rasterization as cpu_rasterization
from rasterizers.interface import Camera


def main(iterations: int, strategies: str | None, seed: int = 0) -> float:
    """Train on the demo; returns the mean PSNR of its test views at HR in dB."""
    capture = demo.read(width=256, height=192, views=12, train=3)
    sr = DemoPrior(truth={frame.name: frame.load for frame in capture.frames})
    scene = prepare(capture, ViewSettings(train=3, test_every=8, photos_are="hr"), sr, CloudSettings())
    photos = {v.name: v.lr for v in scene.train}  # what a host has: LR photos and their cameras

    splats, optimizers = splats_with_optimizers(scene.cloud.means, scene.cloud.colors)
    strategy = DefaultStrategy(
        refine_start_iter=iterations // 20, refine_stop_iter=iterations // 2, refine_every=max(1, iterations // 40),
        grow_grad2d=1.5e-3,
    )  # fmt: skip
    strategy.check_sanity(splats, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)

    rasterization = cpu_rasterization
    if strategies is not None:
        chosen = conductor(strategies, iterations=iterations)  # +
        made_by = chosen.prior(sr)  # + the SR images, back-projected where the strategies say so
        views = [
            view(n, p.image, p.camera.world_to_camera, intrinsics(p.camera), made_by) for n, p in photos.items()
        ]  # +
        clear = attach(splats, optimizers, views, chosen, strategy=strategy, seed=seed)  # +
        rasterization = clear.wrap(rasterization)  # +

    def render(camera: Camera) -> tuple[Tensor, dict[str, Any]]:
        p = splats
        image, _, info = rasterization(
            p["means"], p["quats"], p["scales"].exp(), p["opacities"].sigmoid(), torch.cat((p["sh0"], p["shN"]), 1),
            camera.world_to_camera[None], intrinsics(camera).float()[None], camera.width, camera.height, sh_degree=3,
            packed=False, rasterize_mode="antialiased",
        )  # fmt: skip
        return image[0], info

    names = list(photos)
    for step in range(iterations):
        photo = photos[names[step % len(names)]]
        image, info = render(photo.camera)
        strategy.step_pre_backward(splats, optimizers, state, step, info)
        loss = Photometric.apply(image, photo.image)  # type: ignore[no-untyped-call]
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(splats, optimizers, state, step, info, packed=False)
        if (step + 1) % max(1, iterations // 5) == 0:
            logging.info("step %d: loss %.4f, %d Gaussians", step + 1, float(loss.detach()), len(splats["means"]))
    with torch.no_grad():
        return psnr(scene, render)


class Photometric(torch.autograd.Function):
    """0.8 L1 + 0.2 (1 - SSIM), the loss of 3DGS."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        loss = losses.photometric(image.detach().contiguous(), target, 0.2)
        ctx.gradient = loss.gradient
        return image.new_tensor(float(loss.value))

    @staticmethod
    def backward(ctx: Any, scale: Tensor) -> tuple[Tensor, None]:
        return ctx.gradient * scale, None


def psnr(scene: Scene, render: Callable[[Camera], tuple[Tensor, Any]]) -> float:
    values = []
    for test in scene.test:
        if test.truth is not None:
            image, _ = render(test.hr.camera)
            values.append(-10 * float((images.quantize(image.clamp(0, 1)) - test.truth).square().mean().log10()))
    return sum(values) / len(values)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--strategies", default="clear", help="as in +strategy=; none: the loop alone")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.manual_seed(options.seed)  # gsplat splits Gaussians with torch's global generator
    with native.kernel_threads(
        native.threads()
    ):  # torch's threads would otherwise occupy the cores that the kernels use
        result = main(options.iterations, None if options.strategies == "none" else options.strategies, options.seed)
    sys.stdout.write(f"{options.strategies}: {result:.2f} dB on the test views at HR\n")
