"""A GaussianModel with the interface of 3DGS: one Adam with named groups; a changed structure replaces the parameters."""

from typing import Any, NamedTuple

import torch
from safetensors.torch import save_file

from clear_strategies.core.points import PointCloud
from clear_strategies.training.field import GaussianField
from rasterizers.geometry import rotation_matrix

GROUPS = {
    "xyz": "_xyz", "f_dc": "_features_dc", "f_rest": "_features_rest", "opacity": "_opacity", "scaling": "_scaling",
    "rotation": "_rotation",
}  # fmt: skip


class BasicPointCloud(NamedTuple):
    points: Any
    colors: Any
    normals: Any


class GaussianModel:
    def __init__(self):
        self.active_sh_degree, self.max_sh_degree, self.optimizer = 0, 3, None

    def create_from_pcd(self, pcd: BasicPointCloud, spatial_lr_scale: float):
        self.spatial_lr_scale = spatial_lr_scale
        points, colors = (torch.as_tensor(x).float() for x in (pcd.points, pcd.colors))
        raw = GaussianField.from_cloud(PointCloud(points, colors, source="points")).raw()
        tensors = (raw["means"], raw["sh0"], raw["shN"], raw["opacities"][:, None], raw["scales"], raw["quats"])
        for attribute, tensor in zip(GROUPS.values(), tensors, strict=True):
            setattr(self, attribute, torch.nn.Parameter(tensor.clone()))
        self._reset_statistics()

    def training_setup(self, opt):
        rates = {
            "xyz": opt.position_lr, "f_dc": 2.5e-3, "f_rest": 1.25e-4, "opacity": 0.05, "scaling": 5e-3,
            "rotation": 1e-3,
        }  # fmt: skip
        groups = [{"params": [getattr(self, a)], "lr": rates[name], "name": name} for name, a in GROUPS.items()]
        self.optimizer = torch.optim.Adam(groups, lr=0.0, eps=1e-15)

    def capture(self):
        tensors = [getattr(self, a) for a in GROUPS.values()]
        return (self.active_sh_degree, *tensors, self.xyz_gradient_accum, self.denom, self.optimizer.state_dict())

    def restore(self, model_args, opt):
        self.active_sh_degree, *tensors, accum, denom, optimizer = model_args
        for attribute, tensor in zip(GROUPS.values(), tensors, strict=True):
            setattr(self, attribute, tensor)
        self.training_setup(opt)
        self.xyz_gradient_accum, self.denom = accum, denom
        self.optimizer.load_state_dict(optimizer)

    @property
    def get_xyz(self):
        return self._xyz

    @property
    def get_scaling(self):
        return self._scaling.exp()

    @property
    def get_rotation(self):
        return torch.nn.functional.normalize(self._rotation)

    @property
    def get_features(self):
        return torch.cat((self._features_dc, self._features_rest), dim=1)

    @property
    def get_opacity(self):
        return self._opacity.sigmoid()

    def oneupSHdegree(self):
        self.active_sh_degree = min(self.active_sh_degree + 1, self.max_sh_degree)

    def add_densification_stats(self, viewspace_point_tensor, update_filter):
        norm = viewspace_point_tensor.grad[update_filter, :2].norm(dim=-1, keepdim=True)
        self.xyz_gradient_accum[update_filter] += norm.view_as(self.xyz_gradient_accum[update_filter])
        self.denom[update_filter] += 1

    def densify_and_prune(self, max_grad, min_opacity, extent, max_screen_size):
        grads = (self.xyz_gradient_accum / self.denom).nan_to_num(0)[:, 0]
        large = self.get_scaling.amax(1) > 0.01 * extent
        small, split = (grads >= max_grad) & ~large, (grads >= max_grad) & large
        self.densification_postfix(*(getattr(self, a)[small].detach() for a in GROUPS.values()))
        split = torch.cat((split, torch.zeros(int(small.sum()), dtype=torch.bool)))
        two = {
            a: getattr(self, a)[split].detach().repeat(2, *[1] * (getattr(self, a).dim() - 1)) for a in GROUPS.values()
        }
        offsets = torch.randn_like(two["_xyz"]) * two["_scaling"].exp()
        two["_xyz"] += (rotation_matrix(two["_rotation"]) @ offsets[..., None])[..., 0]
        two["_scaling"] -= torch.tensor(1.6).log()
        self.densification_postfix(*two.values())
        self.prune_points(torch.cat((split, torch.zeros(2 * int(split.sum()), dtype=torch.bool))))
        self.prune_points((self.get_opacity < min_opacity)[:, 0])

    def densification_postfix(self, xyz, features_dc, features_rest, opacities, scaling, rotation):
        new = dict(zip(GROUPS, (xyz, features_dc, features_rest, opacities, scaling, rotation), strict=True))
        self._take(self.cat_tensors_to_optimizer(new))
        self._reset_statistics()

    def cat_tensors_to_optimizer(self, new):
        return self._replaced(
            lambda name, rows, fresh: torch.cat((rows, torch.zeros_like(new[name]) if fresh else new[name]))
        )

    def prune_points(self, mask):
        self._take(self._prune_optimizer(~mask))
        self.xyz_gradient_accum, self.denom = self.xyz_gradient_accum[~mask], self.denom[~mask]

    def _prune_optimizer(self, keep):
        return self._replaced(lambda name, rows, fresh: rows[keep])

    def _take(self, optimizable_tensors):
        for name, parameter in optimizable_tensors.items():
            setattr(self, GROUPS[name], parameter)

    def _replaced(self, made):
        """New parameters in the optimizer; as in 3DGS, those of the model are replaced by the caller."""
        for group in self.optimizer.param_groups:
            old, name = group["params"][0], group["name"]
            state = self.optimizer.state.pop(old, {})
            parameter = group["params"][0] = torch.nn.Parameter(made(name, old.detach(), False))
            if state:
                moments = {k: made(name, m, True) if m.dim() else m for k, m in state.items()}
                self.optimizer.state[parameter] = moments
        return {group["name"]: group["params"][0] for group in self.optimizer.param_groups}

    def reset_opacity(self):
        (group,) = (g for g in self.optimizer.param_groups if g["name"] == "opacity")
        self.optimizer.state.pop(group["params"][0], None)
        limit = torch.logit(torch.tensor(0.01))
        self._opacity = group["params"][0] = torch.nn.Parameter(self._opacity.detach().clamp_max(limit))

    def save_ply(self, path):
        """Writes the raw tensors by name."""
        save_file({name: getattr(self, a).detach().contiguous() for name, a in GROUPS.items()}, path)

    def _reset_statistics(self):
        self.xyz_gradient_accum = torch.zeros(len(self._xyz), 1)
        self.denom = torch.zeros(len(self._xyz), 1)


class WithExposures(GaussianModel):
    """The signature of 3DGS since 2024, which keeps an exposure for each photo by its name."""

    def create_from_pcd(self, pcd: BasicPointCloud, cam_infos: int, spatial_lr_scale: float, degree=0, **_):
        super().create_from_pcd(pcd, spatial_lr_scale)
        self.exposed = [info.image_name for info in cam_infos]
