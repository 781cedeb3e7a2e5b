"""A scene with the interface of 3DGS: cameras with their photos, and the Gaussians."""

import json
import math
from pathlib import Path

import torch

from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from scene.gaussian_model import BasicPointCloud, GaussianModel

__all__ = ["Camera", "GaussianModel", "Scene", "write"]


class Camera:
    def __init__(self, image_name, original_image, pose, fov_x, fov_y):
        self.image_name, self.original_image, self.alpha_mask = image_name, original_image, None
        _, self.image_height, self.image_width = original_image.shape
        self.FoVx, self.FoVy = fov_x, fov_y
        self.world_view_transform = pose.T
        near, far = 0.01, 100.0
        projection = torch.zeros(4, 4, dtype=pose.dtype)
        projection[0, 0], projection[1, 1] = 1 / math.tan(fov_x / 2), 1 / math.tan(fov_y / 2)
        projection[2, 2], projection[3, 2], projection[2, 3] = far / (far - near), 1, -far * near / (far - near)
        self.full_proj_transform = self.world_view_transform @ projection.T
        self.camera_center = self.world_view_transform.inverse()[3, :3]


class Scene:
    def __init__(self, source, gaussians):
        source = Path(source)
        stored = json.loads((source / "scene.json").read_text())
        self.cameras = [
            Camera(
                name, read_image(source / "images" / f"{name}.png").permute(2, 0, 1), torch.tensor(c["pose"]), *c["fov"]
            )
            for name, c in stored["cameras"].items()
        ]
        self.cameras_extent = 4.0
        points, colors = torch.tensor(stored["points"]), torch.tensor(stored["colors"])
        gaussians.create_from_pcd(BasicPointCloud(points, colors, None), self.cameras_extent)

    def getTrainCameras(self, scale=1.0):
        return list(self.cameras)


def write(folder, scene):
    """Write LR photos to images/ and SR images to sr/."""
    cameras = {}
    for view in scene.train:
        c = view.lr.camera
        fov = [2 * math.atan(c.width / 2 / c.fx), 2 * math.atan(c.height / 2 / c.fy)]
        cameras[view.name] = {"pose": c.world_to_camera.tolist(), "fov": fov}
        write_png(folder / "images" / f"{view.name}.png", images.quantize(view.lr.image))
        write_png(folder / "sr" / f"{view.name}.png", images.quantize(view.hr.image))
    points, colors = scene.cloud.means.tolist(), scene.cloud.colors.tolist()
    (folder / "scene.json").write_text(json.dumps({"cameras": cameras, "points": points, "colors": colors}))
