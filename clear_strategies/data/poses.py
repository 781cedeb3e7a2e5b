"""Conversion of the poses in files, camera-to-world matrices and rotations, to world-to-camera, with checks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta
from torch import Tensor

from clear_strategies.data.lenses import FARTHEST
from clear_strategies.errors import DataError

_Coordinate = Annotated[float, Meta(gt=-FARTHEST, lt=FARTHEST)]
_Rows = Annotated[
    list[Annotated[list[_Coordinate], Meta(min_length=4, max_length=4)]], Meta(min_length=3, max_length=4)
]


def pose_from_opengl(file: Path, where: str, matrix: object) -> Float[Tensor, "4 4"]:
    """Convert a camera-to-world matrix with OpenGL axes (x right, y up, z back) to world-to-camera with OpenCV axes."""
    remedy = "write camera-to-world matrices: a rotation, a translation, last row 0 0 0 1"
    try:
        rows = np.array(msgspec.convert(matrix, _Rows))
    except msgspec.ValidationError as error:
        raise DataError(file, where, "is no 3x4 or 4x4 matrix of finite numbers", remedy) from error
    if len(rows) == 4 and np.abs(rows[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DataError(file, where, f"has the last row {rows[3].tolist()}", remedy)
    rotation = rows[:3, :3] * np.array([1.0, -1.0, -1.0])  # OpenGL's y and z axes are opposite
    return rigid_inverse(file, where, rotation, rows[:3, 3])


def rigid_inverse(file: Path, where: str, rotation: np.ndarray, center: np.ndarray) -> Float[Tensor, "4 4"]:
    """World-to-camera of a camera with these axes (columns) and centre; a DataError unless the axes are orthonormal and
    right-handed within 1e-3.
    """
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or abs(np.linalg.det(rotation) - 1) > 1e-3:
        problem = f"holds no rotation (determinant {np.linalg.det(rotation):.4g})"
        raise DataError(file, where, problem, "remove scale and reflection from the camera-to-world matrices")
    left, _, right = np.linalg.svd(rotation)  # the nearest exact rotation, because files keep six digits
    pose = np.eye(4)
    pose[:3, :3] = (left @ right).T
    pose[:3, 3] = -pose[:3, :3] @ center
    return torch.from_numpy(pose)
