"""What the stand-ins for other trainers share."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from clear_strategies import Objective
from clear_strategies.core import images
from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.data.photo_files import write_png
from clear_strategies.geometry.projection import intrinsics
from clear_strategies.kernels import losses
from clear_strategies.schedules import WarmupDecay
from integration import AutogradShot
from rasterizers import Camera, Splats, autograd
from tests.helpers import toy

FROM_START = ["objective.lambda_hr.start=0", "objective.lambda_hr.full=0", "strategies.p2g.patch=4"]
"""Settings of a run that is too short for the warm-up, and photos that are too small for P2G's patches."""
FOLDER = Path(__file__).parent / "inria_host"
N = 24  # points of the scene of the 3DGS-style host in FOLDER and of simple_trainer
HR_FROM_START = Objective(lambda_hr=WarmupDecay(start=0, full=1, decay_from=100, end=100))
WITHOUT_HR = Objective(lambda_hr=WarmupDecay(peak=0, final=0))


def photometric(image: Tensor, target: Tensor) -> Tensor:
    """A number whose gradient is that of 0.8 L1 + 0.2 (1 - SSIM), the hosts' loss; images [H, W, 3]."""
    return (
        image * losses.photometric(image.detach().contiguous(), target.contiguous(), 0.2, kernels="torch").gradient
    ).sum()


def as_item(photo, i):
    """A photo as the datasets of gsplat's examples give it."""
    pose = torch.linalg.inv(photo.camera.world_to_camera)
    return {"K": intrinsics(photo.camera).float(), "camtoworld": pose, "image": photo.image * 255, "image_id": i}


def shot_of(
    params: Mapping[str, Tensor], camera: Camera, offset: Tensor | None = None, centres: Tensor | None = None, **computed: Tensor
) -> AutogradShot:  # fmt: skip
    """A rendering of raw parameters by torch's autograd.

    Args:
        offset: of the colours. centres: see `autograd.draw`. computed: what takes the place of activated parameters.
    """
    drawn = {**params, "scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid(), **computed}
    found = autograd.draw(toy.RASTERIZER, Splats(*map(drawn.get, PARAMETERS), offset), camera, centres)
    return AutogradShot(found.image, found.means2d, found.visible, params)


class InNdc(torch.autograd.Function):
    """Zero offsets of the projected centres; their gradient goes to a tensor of zeros, in NDC."""

    @staticmethod
    def forward(ctx, dummy, width, height, absolute=False):
        ctx.size, ctx.columns, ctx.absolute = (width, height), dummy.shape[1], absolute
        return dummy.new_zeros(len(dummy), 2)

    @staticmethod
    def backward(ctx, g):
        ndc = g.new_zeros(len(g), ctx.columns)
        ndc[:, :2] = g * g.new_tensor(ctx.size) / 2
        if ctx.columns == 4:  # some forks keep absolute gradients here
            ndc[:, 2:] = 3 * ndc[:, :2].abs()
        elif ctx.absolute:  # and Mip-Splatting keeps their norm in the third column
            ndc[:, 2] = 3 * ndc[:, :2].norm(dim=1)
        return ndc, None, None, None


def write_sr(folder: Path) -> None:
    """The SR images of the scene of both trainers, in sr/."""
    for view in toy.scene(N).train:
        write_png(folder / "sr" / f"{view.name}.png", images.quantize(view.hr.image))


def options(host, folder, **settings):
    """The options of the host's train.py."""
    opt = host.parser().parse_args(["-s", str(folder)])
    for name, value in settings.items():
        setattr(opt, name, value)
    return opt


def loop(host, clear, opt, gaussians, scene, **settings):
    """The host's loop with its global `render` replaced; the host's own function is back afterwards."""
    own, host.render = host.render, clear.wrap(host.render)
    try:
        host.loop(opt, gaussians, scene, **settings)
    finally:
        host.render = own
