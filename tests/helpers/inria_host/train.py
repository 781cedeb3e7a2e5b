"""A 3DGS-style training loop in its own order: backward, densify, step. Contains nothing of CLEAR."""

import argparse

import torch
from gaussian_renderer import render
from scene import GaussianModel, Scene

from tests.helpers import host_parts


def photometric(image, target):
    """Of images [3, H, W]."""
    return host_parts.photometric(image.permute(1, 2, 0), target.permute(1, 2, 0))


@torch.no_grad()
def densify(gaussians, opt, iteration, package):
    if iteration >= opt.densify_until_iter:
        return
    gaussians.add_densification_stats(package["viewspace_points"], package["visibility_filter"].squeeze(-1))
    if iteration > opt.densify_from_iter and iteration % opt.densification_interval == 0:
        gaussians.densify_and_prune(opt.densify_grad_threshold, 0.005, opt.extent, None)
    if iteration % opt.opacity_reset_interval == 0:
        gaussians.reset_opacity()


def training(opt):
    """As in 3DGS, everything happens in this function, and `render` is the name of the module."""
    gaussians = GaussianModel()
    scene = Scene(opt.source_path, gaussians)
    gaussians.training_setup(opt)
    first = 0
    if opt.start_checkpoint:
        model_params, first = torch.load(opt.start_checkpoint, weights_only=False)
        gaussians.restore(model_params, opt)
    loop(opt, gaussians, scene, first=first)
    if opt.save:
        gaussians.save_ply(opt.save)


def loop(opt, gaussians, scene, names=None, between=lambda iteration: None, first=0):
    background, pipe = torch.zeros(3), None
    for iteration in range(first + 1, opt.iterations + 1):
        if iteration % opt.sh_interval == 0:
            gaussians.oneupSHdegree()
        cameras = scene.getTrainCameras()
        if names is None:
            camera = cameras[iteration % len(cameras)]
        else:
            (camera,) = (c for c in cameras if c.image_name == names[iteration - 1])
        package = render(camera, gaussians, pipe, background)
        image = package["render"]
        if camera.alpha_mask is not None:
            image *= camera.alpha_mask
        loss = photometric(image, camera.original_image)
        loss.backward()
        between(iteration)
        if not opt.step_first:
            densify(gaussians, opt, iteration, package)
        gaussians.optimizer.step()
        gaussians.optimizer.zero_grad(set_to_none=True)
        if opt.step_first:
            densify(gaussians, opt, iteration, package)
        if iteration == opt.checkpoint_iteration:
            torch.save((gaussians.capture(), iteration), opt.checkpoint)


def parser():
    p = argparse.ArgumentParser()
    p.add_argument("-s", "--source_path")
    p.add_argument("--step_first", action="store_true")
    for name in ("save", "start_checkpoint", "checkpoint"):
        p.add_argument(f"--{name}")
    for name, value in {
        "iterations": 30, "position_lr": 1.6e-4, "extent": 4.0, "densify_grad_threshold": 2e-4, "densify_from_iter": 4,
        "densify_until_iter": 24, "densification_interval": 5, "opacity_reset_interval": 1000, "sh_interval": 10,
        "checkpoint_iteration": 0,
    }.items():  # fmt: skip
        p.add_argument(f"--{name}", type=type(value), default=value)
    return p


def setup(opt):
    """The first lines of `training`, for tests that attach by hand."""
    torch.manual_seed(0)
    gaussians = GaussianModel()
    scene = Scene(opt.source_path, gaussians)
    gaussians.training_setup(opt)
    return gaussians, scene


if __name__ == "__main__":
    torch.manual_seed(0)
    training(parser().parse_args())
