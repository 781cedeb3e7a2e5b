"""The reader that gsplat 1.5's examples use, which shares its name with COLMAP's own package: of COLMAP's text files."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np


class SceneManager:
    def __init__(self, folder):
        self.folder = Path(folder)
        self.point3D_id_to_images, self.point3D_id_to_point3D_idx = {}, {}

    def _lines(self, name):
        lines = (self.folder / f"{name}.txt").read_text().split("\n")
        return [line.split() for line in lines if not line.startswith("#")]

    def load_cameras(self):
        self.cameras = {}
        for i, _, w, h, *pinhole in filter(None, self._lines("cameras")):
            fx, fy, cx, cy = map(float, pinhole)
            made = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": int(w), "height": int(h)}
            self.cameras[int(i)] = SimpleNamespace(camera_type="PINHOLE", **made)

    def load_images(self):
        self.images, self.name_to_image_id = {}, {}
        for words in filter(None, self._lines("images")[::2]):  # a line of the points seen follows each
            w, x, y, z, *t = map(float, words[1:8])
            rotation = np.array(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ]
            )
            image = {"R": lambda rotation=rotation: rotation, "tvec": np.array(t), "camera_id": int(words[8])}
            self.images[int(words[0])] = SimpleNamespace(name=words[9], **image)
            self.name_to_image_id[words[9]] = int(words[0])

    def load_points3D(self):
        rows = [list(map(float, words[1:8])) for words in filter(None, self._lines("points3D"))]
        points = np.array(rows)
        self.points3D, self.point3D_colors = points[:, :3], points[:, 3:6].astype(np.uint8)
        self.point3D_errors = points[:, 6]
