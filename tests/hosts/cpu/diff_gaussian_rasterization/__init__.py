"""In place of the CUDA rasterizers of 3DGS-style trainers, drawn by this package's; the variable HOST says whose interface."""

import os

import torch

import rasterizers
from rasterizers import Camera, Splats, autograd
from rasterizers.geometry import SH_C0
from tests.helpers.host_parts import InNdc

HOST = os.environ["HOST"]


class GaussianRasterizationSettings:
    def __init__(self, **settings):
        self.__dict__.update(settings)


class GaussianRasterizer(torch.nn.Module):
    def __init__(self, raster_settings):
        super().__init__()
        self.settings = raster_settings

    def forward(self, means3D, means2D, opacities, shs, scales, rotations, **absent):
        if any(value is not None for value in absent.values()):
            raise NotImplementedError(f"{[name for name, value in absent.items() if value is not None]}")
        s, (w, h) = self.settings, (self.settings.image_width, self.settings.image_height)
        projection = torch.linalg.solve(s.viewmatrix.double(), s.projmatrix.double())
        centre = float((projection[2, 0] + 1) * w / 2), float((projection[2, 1] + 1) * h / 2)
        camera = Camera(s.viewmatrix.T.contiguous().detach(), w / 2 / s.tanfovx, h / 2 / s.tanfovy, *centre, w, h)
        smooth = {"kernel": float(getattr(s, "kernel_size", 0.3)), "antialiased": hasattr(s, "kernel_size")}
        background = tuple(float(x) for x in s.bg)
        scales, bands = scales * s.scale_modifier, (s.sh_degree + 1) ** 2

        def draw(colors, bands=1, background=(0.0, 0.0, 0.0), offset=None):
            rasterizer = rasterizers.load("torch", near=0.2, background=background, **smooth)
            splats = Splats(means3D, rotations, scales, opacities[:, 0], colors[:, :1], colors[:, 1:bands])
            return autograd.draw(rasterizer, splats, camera, offset, colors=colors)

        drawn = draw(shs, bands, background, InNdc.apply(means2D, w, h, HOST == "mip-splatting"))
        image, radii = drawn.image.permute(2, 0, 1).contiguous(), 3 * drawn.visible.int()
        if HOST in ("mip-splatting", "dropgaussian"):
            return image, radii
        z = (means3D @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3])[:, 2:].clamp_min(0.2)
        value = (1 / z if HOST == "3dgs" else z).expand(-1, 3)
        with torch.set_grad_enabled(HOST == "fsgs"):  # 3DGS's loss reads it only where a scene has depth maps
            depth = draw((value[:, None] - 0.5) / SH_C0).image.permute(2, 0, 1)[:1]
        return (image, radii, depth, drawn.alpha[None]) if HOST == "fsgs" else (image, radii, depth)
