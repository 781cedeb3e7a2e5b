"""A renderer with the interface of 3DGS, on a CPU."""

import torch

from rasterizers import Camera, Splats, autograd, fastest, load
from rasterizers.interface import over
from tests.helpers.host_parts import InNdc

ABSOLUTE = False
RASTERIZER = load(fastest("cpu"), near=0.01, kernel=0.3, antialiased=False)


def render(viewpoint_camera, pc, pipe, bg_color, scaling_modifier=1.0, columns=3):
    w, h = viewpoint_camera.image_width, viewpoint_camera.image_height
    focal = [size / 2 / torch.tan(torch.tensor(fov, dtype=torch.float64) / 2)
             for size, fov in ((w, viewpoint_camera.FoVx), (h, viewpoint_camera.FoVy))]  # fmt: skip
    # As the CUDA rasterizer: focal lengths from the fields of view, centres from the projection.
    pose, full = viewpoint_camera.world_view_transform, viewpoint_camera.full_proj_transform
    offset = torch.linalg.solve(pose.double(), full.double())[2, :2].tolist()
    centre = [round((x + 1) * size / 2, 3) for x, size in zip(offset, (w, h), strict=True)]
    camera = Camera(pose.T, *map(float, focal), *centre, w, h)
    xyz = pc.get_xyz
    dummy = torch.zeros(len(xyz), columns, dtype=xyz.dtype, requires_grad=True) + 0
    if dummy.requires_grad:
        dummy.retain_grad()
    features = pc.get_features
    bands = (pc.active_sh_degree + 1) ** 2
    scales = pc.get_scaling * scaling_modifier
    splats = Splats(xyz, pc.get_rotation, scales, pc.get_opacity[:, 0], features[:, :1], features[:, 1:bands])
    behind = None if bg_color is None else tuple(bg_color.tolist())
    drawn = autograd.draw(over(RASTERIZER, behind), splats, camera, InNdc.apply(dummy, w, h, ABSOLUTE), colors=features)
    return {
        "render": drawn.image.permute(2, 0, 1),
        "viewspace_points": dummy,
        "visibility_filter": drawn.visible,
        "radii": drawn.visible.int() * 3,
    }
