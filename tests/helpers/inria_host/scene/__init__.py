"""A scene with the interface of 3DGS: cameras with their photos, those of the toy scene, and the Gaussians."""

import math

import torch

from clear_strategies.core import images
from scene.gaussian_model import BasicPointCloud, GaussianModel
from tests.helpers import toy
from tests.helpers.host_parts import N

__all__ = ["Camera", "GaussianModel", "Scene"]


class Camera:
    def __init__(self, image_name, original_image, camera):
        self.image_name, self.original_image, self.alpha_mask = image_name, original_image, None
        _, self.image_height, self.image_width = original_image.shape
        self.FoVx = 2 * math.atan(camera.width / 2 / camera.fx)
        self.FoVy = 2 * math.atan(camera.height / 2 / camera.fy)
        self.world_view_transform = camera.world_to_camera.T
        near, far = 0.01, 100.0
        projection = torch.zeros(4, 4)
        projection[0, 0], projection[1, 1] = 1 / math.tan(self.FoVx / 2), 1 / math.tan(self.FoVy / 2)
        projection[2, 2], projection[3, 2], projection[2, 3] = far / (far - near), 1, -far * near / (far - near)
        self.full_proj_transform = self.world_view_transform @ projection.T
        self.camera_center = self.world_view_transform.inverse()[3, :3]


class Scene:
    def __init__(self, source, gaussians):
        made = toy.scene(N)
        self.cameras = [
            Camera(view.name, images.quantize(view.lr.image).permute(2, 0, 1), view.lr.camera) for view in made.train
        ]
        self.cameras_extent = 4.0
        gaussians.create_from_pcd(BasicPointCloud(made.cloud.means, made.cloud.colors, None), self.cameras_extent)

    def getTrainCameras(self, scale=1.0):
        return list(self.cameras)
