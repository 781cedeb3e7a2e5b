"""Clones Gaussians with large screen gradients and prunes transparent ones; replaces the parameters of all optimizers."""

from dataclasses import dataclass

import torch

from .density_controller import DensityController, DensityControllerImpl


@dataclass
class VanillaDensityController(DensityController):
    densify_from_iter: int = 4
    densify_until_iter: int = 24
    densification_interval: int = 5
    densify_grad_threshold: float = 2e-4

    def instantiate(self, *args, **kwargs):
        return VanillaDensityControllerImpl(self)


class VanillaDensityControllerImpl(DensityControllerImpl):
    def setup(self, stage, pl_module):
        self.reset_statistics(pl_module.gaussian_model.n_gaussians)

    def reset_statistics(self, n):
        self.register_buffer("xyz_gradient_accum", torch.zeros(n), persistent=True)
        self.register_buffer("denom", torch.zeros(n), persistent=True)

    def before_backward(self, outputs, batch, gaussian_model, optimizers, global_step, pl_module):
        outputs["viewspace_points"].retain_grad()

    @torch.no_grad()
    def after_backward(self, outputs, batch, gaussian_model, optimizers, global_step, pl_module):
        if global_step >= self.config.densify_until_iter:
            return
        visible = outputs["visibility_filter"]
        gradient = outputs["viewspace_points"].grad[:, :2] * outputs.get("viewspace_points_grad_scale", 1)
        self.xyz_gradient_accum[visible] += gradient[visible].norm(dim=-1)
        self.denom[visible] += 1
        if global_step > self.config.densify_from_iter and global_step % self.config.densification_interval == 0:
            mean = (self.xyz_gradient_accum / self.denom).nan_to_num(0)
            kept = gaussian_model.get_opacities()[:, 0] > 0.005
            rows = torch.cat((kept.nonzero()[:, 0], (mean >= self.config.densify_grad_threshold).nonzero()[:, 0]))
            self.gather(gaussian_model, optimizers, rows, kept.sum())
            self.reset_statistics(len(rows))

    def gather(self, gaussian_model, optimizers, rows, old):
        """Every property at these rows, of which the first `old` keep their moments."""
        changed = {k: torch.nn.Parameter(v[rows], requires_grad=False) for k, v in gaussian_model.properties.items()}
        for optimizer in optimizers:
            for group in optimizer.param_groups:
                before = group["params"][0]
                state = optimizer.state.pop(before, {})
                after = group["params"][0] = changed[group["name"]].requires_grad_(True)
                for name, moment in state.items():
                    if moment.dim():
                        state[name] = moment[rows]
                        state[name][old:] = 0
                optimizer.state[after] = state
        gaussian_model.properties = changed
