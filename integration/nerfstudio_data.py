"""What nerfstudio has loaded, as the views that strategies know. Imports no nerfstudio: its data managers are only read.

The LR side of a view is the photo that splatfacto itself trains on, undistorted by its data manager; the SR side comes from
a folder or a network.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.priors import Bicubic, Images, Onnx, Prior, cached
from clear_strategies.errors import DataError
from integration.views import view


def prior(sr: Path | None) -> Prior:
    """Where I_HR comes from: a folder of pictures, an ONNX network, or, without either, bicubic interpolation."""
    if sr is None:
        return Bicubic()
    return cached(Onnx(str(sr))) if sr.suffix.lower() == ".onnx" else Images(str(sr))


def views(datamanager: Any, sr: Prior, factor: int, device: torch.device | str = "cpu") -> tuple[View, ...]:
    """The training views of a `FullImageDatamanager`, named like their files, on `device`.

    Args:
        sr: asked once a photo. factor: HR pixels per LR pixel.

    Raises:
        DataError: two photos would share an SR picture, a photo is masked, or an SR picture does not fit.
    """
    photos = datamanager.cached_train  # first: it undistorts, and corrects the cameras
    cameras, files = datamanager.train_dataset.cameras, datamanager.train_dataset.image_filenames
    Ks, poses = cameras.get_intrinsics_matrices(), world_to_camera(cameras.camera_to_worlds)
    _require_own_stems(files)
    found = []
    for i, photo in enumerate(photos):
        name = Path(files[i]).name
        if "mask" in photo:
            raise DataError(
                name, "mask", "would hide pixels from splatfacto's loss but not from those of the SR reference",
                "train without masks",
            )  # fmt: skip
        found.append(view(name, over_black(photo["image"]).to(device), poses[i].to(device), Ks[i], sr, factor))
    return tuple(found)


def save_lr(datamanager: Any, folder: Path) -> None:
    """Leave the photos as splatfacto trains on them, as PNG: what an SR tool must enlarge."""
    files = datamanager.train_dataset.image_filenames
    _require_own_stems(files)
    for file, photo in zip(files, datamanager.cached_train, strict=True):
        write_png(folder / f"{Path(file).stem}.png", over_black(photo["image"]))


def world_to_camera(camera_to_world: Float[Tensor, "*C 3 4"]) -> Float[Tensor, "*C 4 4"]:
    """World to camera with OpenCV axes, from nerfstudio's poses: camera to world, OpenGL axes (y up, z back)."""
    R = (camera_to_world[..., :3] * camera_to_world.new_tensor([1, -1, -1])).mT  # a column an axis, then its transpose
    pose = torch.eye(4).to(R).repeat(*R.shape[:-2], 1, 1)
    pose[..., :3, :3] = R
    pose[..., :3, 3:] = -R @ camera_to_world[..., 3:]
    return pose


def over_black(image: Tensor) -> Float[Tensor, "H W 3"]:
    """RGB in [0, 1] of an 8-bit or float photo, its alpha composited as splatfacto does it with a black background."""
    values = image.float() / 255 if image.dtype == torch.uint8 else image
    return values[..., :3] * values[..., 3:] if values.shape[-1] == 4 else values


def _require_own_stems(files: Any) -> None:
    """A view's SR picture is found by the stem of its photo."""
    first: dict[str, Path] = {}
    for file in map(Path, files):
        twin = first.setdefault(file.stem, file)
        if twin is not file:
            raise DataError(
                file,
                "file name",
                f"has the stem of {twin}, and SR images are found by it",
                "give each photo its own name",
            )
