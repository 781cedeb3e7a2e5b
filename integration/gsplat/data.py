"""Photos and cameras of gsplat's examples (`examples/datasets/colmap.py`) as views."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from clear_strategies.core.view import View
from clear_strategies.data.photo_files import write_png
from integration.views import SuperResolve, view

_log = logging.getLogger(__name__)


def views_from_dataset(
    dataset: Any, sr: SuperResolve, factor: int = 4, device: torch.device | str = "cpu"
) -> tuple[View, ...]:
    """The views of a `Dataset`, in its order and in the world of its parser (view i is `image_id` i).

    Args:
        sr: gives the SR images. factor: HR pixels per LR pixel.

    Raises:
        DataError: an SR image is missing, or is not `factor` times as large as its photo.
    """
    views = []
    for i in range(len(dataset)):
        item = dataset[i]
        mask, image = mask_of(item), (item["image"] / 255).to(device)
        pose = torch.linalg.inv(item["camtoworld"]).to(device)
        shown = None if mask is None else mask.to(image)
        views.append(view(name_of(dataset, i), image, pose, item["K"], sr, factor, mask=shown))
    return tuple(views)


def masks_from_dataset(dataset: Any) -> dict[str, Tensor]:
    """The masks [h, w] by the names of their views; only the views that have one."""
    found = {name_of(dataset, i): mask_of(dataset[i]) for i in range(len(dataset))}
    return {name: mask for name, mask in found.items() if mask is not None}


def save_lr(dataset: Any, folder: Path | str) -> None:
    """Write the photos as the trainer uses them (its data_factor, undistorted), as PNG, for an SR tool to enlarge."""
    for i in range(len(dataset)):
        item = dataset[i]
        image, mask = item["image"] / 255, mask_of(item)
        file = (Path(folder) / name_of(dataset, i)).with_suffix(".png")
        write_png(file, image if mask is None else image * mask[..., None])
    _log.info(
        "%d LR photos written to %s. Enlarge them and pass the folder of the results as sr.", len(dataset), folder
    )


def name_of(dataset: Any, i: int) -> str:
    """The file name of a photo, with its folder."""
    return str(dataset.parser.image_names[dataset.indices[i]])


def mask_of(item: Any) -> Tensor | None:
    """The mask of an item, which gsplat sets its rendering to 0 outside of; None: nothing is hidden."""
    mask = item.get("mask")
    return None if mask is None or bool(mask.all()) else mask.float()
