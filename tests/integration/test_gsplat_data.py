"""The datasets of gsplat's examples as views: names with folders, masks, SR images."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from clear_strategies import DataError
from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Images
from clear_strategies.geometry.projection import intrinsics
from integration.gsplat.data import photos_of, views_from_dataset
from integration.views import save_photos
from tests.helpers import gsplat_host, toy

NAMES = ("cam1/0001.png", "cam2/0001.png", "cam2/0002.png")
HIDDEN = slice(12, None)  # columns of 24


class Dataset:
    """The toy scene's photos in two folders; the first has a mask that hides its right half."""

    def __init__(self):
        self.train = toy.scene(24).train
        self.parser, self.indices = SimpleNamespace(image_names=["test.png", *NAMES]), [1, 2, 3]

    def __len__(self):
        return len(self.indices)

    def __getitem__(self, item):
        photo = self.train[item].lr
        found = {
            "K": intrinsics(photo.camera).float(), "image": photo.image * 255, "image_id": item,
            "camtoworld": torch.linalg.inv(photo.camera.world_to_camera),
        }  # fmt: skip
        if item == 0:
            found["mask"] = torch.ones(16, 24, dtype=torch.bool)
            found["mask"][:, HIDDEN] = False
        return found


@pytest.fixture
def dataset(tmp_path):
    made = Dataset()
    for name, view in zip(NAMES, made.train, strict=True):
        write_png(tmp_path / "sr" / name, images.quantize(view.hr.image))
    return made


def test_photos_of_one_name_in_two_folders_have_their_own_sr_images(dataset, tmp_path):
    views = views_from_dataset(dataset, Images(str(tmp_path / "sr")))
    assert [view.name for view in views] == list(NAMES)
    for view, expected in zip(views[1:], dataset.train[1:], strict=True):
        assert torch.allclose(view.hr.image, expected.hr.image, atol=1 / 255)
    for name, view in zip(NAMES, dataset.train, strict=True):
        write_png(tmp_path / "flat" / name.split("/")[1], images.quantize(view.hr.image))
    with pytest.raises(DataError, match="would be that of two views, cam1/0001 and cam2/0001"):
        views_from_dataset(dataset, Images(str(tmp_path / "flat")))


def test_photos_are_written_into_their_folders_with_their_masks(dataset, tmp_path):
    save_photos(photos_of(dataset), tmp_path / "lr")
    written = [read_image(tmp_path / "lr" / name) for name in NAMES]
    assert float(written[0][:, HIDDEN].max()) == 0
    assert torch.allclose(written[1], dataset.train[1].lr.image, atol=1 / 255)


def test_a_masked_pixel_is_hidden_at_both_scales(dataset, tmp_path):
    views = views_from_dataset(dataset, Images(str(tmp_path / "sr")))
    masks = {photo.name: photo.mask for photo in photos_of(dataset)}
    assert [mask is None for mask in masks.values()] == [False, True, True]
    assert float(views[0].hr.image[:, 4 * 12 :].abs().max()) == 0
    assert hr_gradient(views, masks[NAMES[0]]) > 0
    assert hr_gradient(views, torch.zeros(16, 24)) == 0


def hr_gradient(views, mask):
    """Σ |∂(L_base + L_HF) / ∂ means| of the first view."""
    scene = replace(toy.scene(24), train=views)
    host, _, render = gsplat_host.started(host=gsplat_host.Host(scene), scene=scene, masks={NAMES[0]: mask})
    (render() * 0).sum().backward()  # nothing of the photo
    return float(host.splats["means"].grad.abs().sum())
