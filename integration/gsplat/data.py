"""Photos and cameras of gsplat's examples (`examples/datasets/colmap.py`)."""

from __future__ import annotations

from typing import Any

import torch

from clear_strategies.core.view import View
from integration.views import HostPhoto, SuperResolve


def photos_of(dataset: Any, device: torch.device | str = "cpu") -> list[HostPhoto]:
    """The photos of a `Dataset`, in its order and in the world of its parser (photo i is `image_id` i).

    gsplat sets its rendering to 0 outside of a mask.
    """
    photos = []
    for i in range(len(dataset)):
        item, name = dataset[i], str(dataset.parser.image_names[dataset.indices[i]])
        image, mask = (item["image"] / 255).to(device), item.get("mask")
        shown = None if mask is None or bool(mask.all()) else mask.to(image)
        photos.append(HostPhoto(name, image, torch.linalg.inv(item["camtoworld"]).to(device), item["K"], shown))
    return photos


def views_from_dataset(
    dataset: Any, sr: SuperResolve, factor: int = 4, device: torch.device | str = "cpu"
) -> tuple[View, ...]:
    """The views of a `Dataset`; view i is that of `image_id` i.

    Args:
        sr: gives the SR images. factor: HR pixels per LR pixel.

    Raises:
        DataError: an SR image is missing, or is not `factor` times as large as its photo.
    """
    return tuple(photo.view(sr, factor) for photo in photos_of(dataset, device))
