"""The module with its model, renderer and cameras, and the calls of a lightning Trainer."""

import io
from dataclasses import dataclass
from types import SimpleNamespace

import torch

from clear_strategies.training.field import GaussianField
from rasterizers import Camera as Pinhole
from rasterizers import Splats, autograd, load
from tests.helpers.host_parts import photometric

NAMES = {"means": "means", "shs_dc": "sh0", "shs_rest": "shN", "scales": "scales", "rotations": "quats"}
RASTERIZER = load("torch", near=0.01, kernel=0.3, antialiased=False)


@dataclass
class Camera:
    """All fields are tensors; world_to_camera is for row vectors."""

    fx: torch.Tensor
    fy: torch.Tensor
    cx: torch.Tensor
    cy: torch.Tensor
    width: torch.Tensor
    height: torch.Tensor
    world_to_camera: torch.Tensor


class VanillaGaussianModel(torch.nn.Module):
    def __init__(self, cloud):
        super().__init__()
        raw = GaussianField.from_cloud(cloud).raw()
        self.gaussians = torch.nn.ParameterDict({k: torch.nn.Parameter(raw[v].clone()) for k, v in NAMES.items()})
        self.gaussians["opacities"] = torch.nn.Parameter(raw["opacities"][:, None].clone())
        self.active_sh_degree = 3

    def get_property_names(self):
        return (*NAMES, "opacities")

    @property
    def properties(self):
        return {name: self.gaussians[name] for name in self.get_property_names()}

    @properties.setter
    def properties(self, properties):
        for name in self.get_property_names():
            self.gaussians[name] = properties[name]

    @property
    def n_gaussians(self):
        return len(self.gaussians["means"])

    @property
    def shs_dc(self):
        return self.gaussians["shs_dc"]

    def get_shs(self):
        return torch.cat((self.shs_dc, self.gaussians["shs_rest"]), 1)

    def get_opacities(self):
        return self.gaussians["opacities"].sigmoid()

    def training_setup(self):
        rates = {"shs_dc": 2.5e-3, "shs_rest": 1.25e-4, "opacities": 0.05, "scales": 5e-3, "rotations": 1e-3}
        means = torch.optim.Adam([{"params": [self.gaussians["means"]], "name": "means"}], lr=1.6e-4)
        groups = [{"params": [self.gaussians[k]], "lr": lr, "name": k} for k, lr in rates.items()]
        return [means, torch.optim.Adam(groups, lr=0.0, eps=1e-15)]


class Renderer(torch.nn.Module):
    """Keeps centres in pixels, like the host's gsplat renderers, or in NDC, like 3DGS."""

    def __init__(self, pixels=True):
        super().__init__()
        self.pixels = pixels

    def forward(self, viewpoint_camera, pc, bg_color, scaling_modifier=1.0, **kwargs):
        c, g = viewpoint_camera, pc.gaussians
        intrinsics = (float(x) for x in (c.fx, c.fy, c.cx, c.cy))
        size = int(c.width), int(c.height)
        camera = Pinhole(c.world_to_camera.T, *intrinsics, *size)
        shs, half = pc.get_shs(), torch.tensor([size]) / 2
        splats = Splats(g["means"], g["rotations"], g["scales"].exp(), pc.get_opacities()[:, 0], shs[:, :1], shs[:, 1:])
        points = torch.zeros(len(shs), 2, requires_grad=True) + 0
        drawn = autograd.draw(RASTERIZER, splats, camera, points * 1 if self.pixels else points * half)
        scale = {"viewspace_points_grad_scale": half} if self.pixels else {}
        return {
            "render": drawn.image.permute(2, 0, 1), "viewspace_points": points, "visibility_filter": drawn.visible,
            "radii": drawn.visible.int(), **scale,
        }  # fmt: skip

    def training_forward(self, step, module, viewpoint_camera, pc, bg_color, scaling_modifier=1.0, **kwargs):
        return self(viewpoint_camera=viewpoint_camera, pc=pc, bg_color=bg_color, scaling_modifier=scaling_modifier)


class Exposure:
    """Multiplies the image of a training step by a brightness."""

    def __init__(self):
        self.brightness, self.sizes = torch.tensor(1.0), []

    def training_forward(self, batch, outputs):
        self.sizes.append(int(batch[0].width))
        outputs["render"] = outputs["render"] * self.brightness


class GaussianSplatting(torch.nn.Module):
    def __init__(self, cloud, density, renderer):
        super().__init__()
        self.gaussian_model, self.renderer = VanillaGaussianModel(cloud), renderer
        self.density_controller, self.output_processor = density.instantiate(), Exposure()
        self.hparams = {
            "renderer": renderer,
            "density": density,
        }  # as LightningModule.save_hyperparameters() keeps them
        self.on_train_start_hooks, self.on_train_batch_end_hooks, self.extra_train_metrics = [], [], []
        self.saved = []
        self.grads = {}

    def forward(self, camera):
        if self.training:
            step = self.trainer.global_step
            return self.renderer.training_forward(step, self, camera, self.gaussian_model, bg_color=torch.zeros(3))
        return self.renderer(camera, self.gaussian_model, bg_color=torch.zeros(3))

    def training_step(self, batch, batch_idx):
        camera, (_, gt_image, masked_pixels), _ = batch
        global_step = self.trainer.global_step + 1
        for optimizer in self.gaussian_optimizers:
            optimizer.zero_grad(set_to_none=True)
        outputs = self(camera)
        self.output_processor.training_forward(batch, outputs)
        metrics, prog_bar = {}, {}
        for hook in self.extra_train_metrics:
            hook(outputs, batch, self.gaussian_model, global_step, self, metrics, prog_bar)
        self.logged = metrics
        arguments = (outputs, batch, self.gaussian_model, self.gaussian_optimizers, global_step, self)
        self.density_controller.before_backward(*arguments)
        if masked_pixels is not None:
            outputs["render"], gt_image = outputs["render"] * masked_pixels, gt_image * masked_pixels
        photometric(outputs["render"].permute(1, 2, 0), gt_image.permute(1, 2, 0)).backward()
        self.grads = {k: p.grad for k, p in self.gaussian_model.gaussians.items() if p.requires_grad}
        self.points = outputs["viewspace_points"]
        self.density_controller.after_backward(*arguments)
        for optimizer in self.gaussian_optimizers:
            optimizer.step()

    def on_save_checkpoint(self, checkpoint):
        pass

    def on_load_checkpoint(self, checkpoint):
        pass

    def save_checkpoint(self):
        """The bytes of a checkpoint, as a lightning Trainer writes them: hyperparameters are pickled."""
        checkpoint = {
            "global_step": self.trainer.global_step, "hyper_parameters": self.hparams, "state_dict": self.state_dict(),
            "optimizer_states": [o.state_dict() for o in self.gaussian_optimizers],
        }  # fmt: skip
        self.on_save_checkpoint(checkpoint)
        file = io.BytesIO()
        torch.save(checkpoint, file)
        return file.getvalue()

    def save_gaussians(self):
        self.saved.append(self.gaussian_model.gaussians["shs_dc"].detach().clone())
        self.checkpoint = self.save_checkpoint()


def fit(module, photos, steps, start=0, mask=None, checkpoint=None):
    """Setup, optimizers and one batch per step, from step `start` or a checkpoint; each photo is (name, camera, image)."""
    batches = [(camera, (name, image, mask), None) for name, camera, image in photos]
    loader = SimpleNamespace(dataset=batches)
    module.trainer = SimpleNamespace(global_step=start, max_steps=steps, train_dataloader=loader)
    module.density_controller.setup("fit", module)
    module.gaussian_optimizers = module.gaussian_model.training_setup()
    if checkpoint is not None:
        stored = torch.load(io.BytesIO(checkpoint), weights_only=False)
        module.on_load_checkpoint(stored)
        module.load_state_dict(stored["state_dict"])
        for optimizer, state in zip(module.gaussian_optimizers, stored["optimizer_states"], strict=True):
            optimizer.load_state_dict(state)
        module.trainer.global_step = stored["global_step"]
    for hook in module.on_train_start_hooks:
        hook(module.gaussian_model, module)
    while module.trainer.global_step < steps:
        module.training_step(batches[module.trainer.global_step % len(batches)], 0)
        module.trainer.global_step += 1
        for hook in module.on_train_batch_end_hooks:
            hook(None, None, module.gaussian_model, module.trainer.global_step, module)
    module.save_gaussians()
