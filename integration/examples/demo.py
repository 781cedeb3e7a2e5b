"""The built-in demo as the loop of a host needs it: LR photos with their cameras, a prior, and gsplat's two dictionaries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import images
from clear_strategies.core.points import PointCloud
from clear_strategies.data.priors import DemoPrior
from clear_strategies.data.readers import demo
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.training.field import GaussianField

RATES: Final = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
_FACTOR: Final = 4

Render = Callable[[Tensor, Tensor, int, int], Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class Demo:
    """The demo's training photos, reduced to LR, and the truth of its other views.

    Args:
        viewmats: world to camera, OpenCV axes. Ks: in pixels of the LR photos.
        prior: makes the SR images, four times as large: the true photos with seeded errors.
        tests: (viewmat, K, truth at HR) of the views that are not trained on.
    """

    names: list[str]
    images: Float[Tensor, "V h w 3"]
    viewmats: Float[Tensor, "V 4 4"]
    Ks: Float[Tensor, "V 3 3"]
    prior: DemoPrior
    tests: list[tuple[Float[Tensor, "4 4"], Float[Tensor, "3 3"], Float[Tensor, "H W 3"]]]

    @torch.no_grad()
    def psnr(self, render: Render) -> float:
        """The mean PSNR of the test views at HR, dB.

        Args:
            render: (viewmat, K, width, height) -> image [height, width, 3].
        """
        errors = [
            (render(viewmat, K, truth.shape[1], truth.shape[0]).clamp(0, 1) - truth).square().mean()
            for viewmat, K, truth in self.tests
        ]
        return float(torch.stack(errors).log10().mean() * -10)


def load_demo(width: int = 256, height: int = 192, device: torch.device | str = "cpu") -> Demo:
    """The demo's twelve views, three of them for training.

    Args:
        width, height: of the HR images, px; multiples of 4, by which the training photos are reduced (bicubic).
        device: of the photos and the cameras.
    """
    frames = demo.read(width=width, height=height).frames
    trained = [frame for frame in frames if frame.split == "train"]
    return Demo(
        [frame.name for frame in trained],
        torch.stack([images.downsample(frame.load().image, _FACTOR) for frame in trained]).to(device),
        torch.stack([frame.camera.world_to_camera.float() for frame in trained]).to(device),
        torch.stack([intrinsics(frame.camera.scaled(1 / _FACTOR)).float() for frame in trained]).to(device),
        DemoPrior(truth={frame.name: lambda frame=frame: frame.load().image for frame in trained}),  # type: ignore[misc]
        [
            (c.world_to_camera.float().to(device), intrinsics(c).float().to(device), image.to(device))
            for c, image in ((f.camera, f.load().image) for f in frames if f.split == "test")
        ],
    )


def splats_with_optimizers(
    means: Float[Tensor, "N 3"], colors: Float[Tensor, "N 3"]
) -> tuple[dict[str, torch.nn.Parameter], dict[str, torch.optim.Adam]]:
    """The dictionaries of parameters and optimizers of a gsplat loop, as `create_splats_with_optimizers` of gsplat's
    simple_trainer.py makes them: round Gaussians as large as the distance to their neighbours, opacity 0.1.

    Args:
        means: world units. colors: RGB in [0, 1].
    """
    start = GaussianField.from_cloud(PointCloud(means.cpu(), colors.cpu(), "given"), max_degree=3).raw()
    splats = {name: torch.nn.Parameter(start[name].to(means).clone()) for name in RATES}
    return splats, {name: torch.optim.Adam([p], lr=RATES[name], eps=1e-15) for name, p in splats.items()}
