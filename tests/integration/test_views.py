"""A host's photos as views: masks, names with folders, what is refused; and the demo for a host's loop."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from clear_strategies import P2G
from clear_strategies.core import images
from clear_strategies.data.photo_files import read_image, write_png
from clear_strategies.data.priors import Images
from clear_strategies.errors import DataError, SettingError
from clear_strategies.geometry.projection import intrinsics
from integration.examples.demo import load_demo, splats_with_optimizers
from integration.gsplat.simple_trainer import photos_of
from integration.views import save_photos, view
from tests.helpers import gsplat_host, toy
from tests.helpers.host_parts import as_item

# ---- A host's photos as views: what a mask hides, and what is refused
PHOTO = toy.scene(20).train[0].lr


def of_host(
    name="photo", sr=lambda name, image, factor: image.repeat_interleave(4, 0).repeat_interleave(4, 1), **settings
):
    photo = {"image": PHOTO.image, "world_to_camera": PHOTO.camera.world_to_camera, "K": intrinsics(PHOTO.camera)}
    return view(**{"name": name, "sr": sr} | photo | settings)


def test_what_a_mask_hides_is_hidden_at_both_scales():
    mask = torch.ones(16, 24)
    mask[:, :6] = 0
    masked = of_host(mask=mask)
    assert torch.equal(masked.lr.shown, mask.bool())
    assert int((~masked.hr.shown).sum()) == 16 * int((~masked.lr.shown).sum())
    assert float(masked.hr.image[:, :24].abs().max()) == 0
    assert of_host().lr.shown is None


@pytest.mark.parametrize("level", [0.0, 1 / 255])
def test_a_hosts_masks_that_hide_everything_are_refused(level):
    scene = toy.scene(20)
    hidden = [of_host(name=v.name, mask=torch.full((16, 24), level)) for v in scene.train]
    with pytest.raises(DataError, match="masks or alpha: show nothing of"):
        gsplat_host.started(host=gsplat_host.Host(scene), scene=replace(scene, train=tuple(hidden)))


def test_sr_images_may_overshoot_but_not_have_other_values_and_names_are_unique():
    assert float(of_host(sr=lambda *a: torch.full((64, 96, 3), 1.03)).hr.image.max()) == 1
    with pytest.raises(DataError, match=r"SR image: must lie in \[0, 1\], has values from 200 to 200"):
        of_host(sr=lambda *a: torch.full((64, 96, 3), 200.0))
    sharp = of_host(image=1.1 * PHOTO.image - 0.03)
    assert float(sharp.lr.image.min()) >= 0
    P2G(patch=4).patch_maps(sharp)
    scene = toy.scene(20)
    with pytest.raises(DataError, match="view0: name: is that of two photos"):
        gsplat_host.started(scene=replace(scene, train=scene.train[:1] * 2))


def test_arrays_of_numpy_are_taken_as_tensors_are():
    arrays = {"image": PHOTO.image.numpy()[::-1], "mask": np.ones((16, 24), np.float32)}
    arrays |= {"world_to_camera": PHOTO.camera.world_to_camera.double().numpy(), "K": intrinsics(PHOTO.camera).tolist()}
    found = of_host(**arrays)
    assert torch.equal(found.lr.image, PHOTO.image.flip(0))
    assert found.lr.camera.fx == pytest.approx(PHOTO.camera.fx)
    bytes_of = (PHOTO.image * 255).round().to(torch.uint8).numpy()
    assert float((of_host(image=bytes_of).lr.image - PHOTO.image).abs().max()) < 1 / 255


POSE = PHOTO.camera.world_to_camera
MISFITS = {
    "a 3x3 pose": (
        {"world_to_camera": POSE[:3, :3]},
        r"world_to_camera: must have shape \[4, 4\], got \[3, 3\]: add the last row",
    ),
    "a 3x4 pose": ({"world_to_camera": POSE[:3]}, r"world_to_camera: must have shape \[4, 4\], got \[3, 4\]"),
    "a pose with scale": ({"world_to_camera": POSE * 2}, r"photo: world_to_camera and K: world_to_camera must be a rotation"),
    "no focal length": ({"K": torch.diag(torch.tensor([0.0, 0, 1]))}, r"and K: focal lengths and image sizes must be positive"),
    "a path": ({"image": "a.png"}, r"photo: image: must be a tensor or an array of numbers, got a str"),
    "no pose": ({"world_to_camera": None}, r"world_to_camera: must be a tensor or an array of numbers, got a NoneType"),
    "levels": ({"image": 255 * PHOTO.image}, r"image: must lie in \[0, 1\]"),
    "NaN": ({"image": PHOTO.image / 0}, r"image: has 1,152 numbers that are not finite"),
    "half a factor": ({"factor": 2.5}, "factor: must be a whole number of at least 1, got 2.5"),
    "a folder as sr": ({"sr": "sr_x4"}, "sr: must be a function or a prior, got 'sr_x4': of a folder"),
    "channels first": ({"image": PHOTO.image.permute(2, 0, 1)}, r"image: must have shape \[h, w, 3\], got \[3, 16, 24\]"),
    "skew": ({"K": torch.ones(3, 3)}, r"photo: K: must be \[\[fx, 0, cx\]"),
    "a 4x4 K": ({"K": torch.eye(4)}, r"K: must have shape \[3, 3\], got \[4, 4\]"),
    "a mask of one channel": ({"mask": torch.ones(16, 24, 1)}, r"mask: must have shape \[16, 24\], got \[16, 24, 1\]"),
    "a mask of levels": ({"mask": torch.full((16, 24), 255, dtype=torch.uint8)}, r"mask: must lie in \[0, 1\]"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISFITS)
def test_what_is_no_photo_with_a_camera_is_refused_with_the_rule(name):
    settings, message = MISFITS[name]
    with pytest.raises((DataError, SettingError), match=message):
        of_host(**settings)


# ---- the demo as the loop of a host needs it
def test_the_demo_has_photos_cameras_and_sr_images_that_fit():
    demo = load_demo(width=64, height=48)
    assert demo.images.shape == (3, 12, 16, 3)
    assert len(demo.tests) == 9
    for photo in zip(demo.names, demo.images, demo.viewmats, demo.Ks, strict=True):
        one = view(*photo, sr=demo.prior)
        assert one.hr.image.shape == (48, 64, 3)
    assert demo.psnr(lambda viewmat, K, w, h: torch.zeros(h, w, 3)) < 15
    truths = iter([truth for _, _, truth in demo.tests])
    assert demo.psnr(lambda viewmat, K, w, h: next(truths) + 0.01) == pytest.approx(40, abs=1)


def test_a_single_point_has_a_size():
    splats, _ = splats_with_optimizers(torch.zeros(1, 3), torch.zeros(1, 3))
    assert splats["scales"].isfinite().all()


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
        found = as_item(self.train[item].lr, item)
        if item == 0:
            found["mask"] = torch.ones(16, 24, dtype=torch.bool)
            found["mask"][:, HIDDEN] = False
        return found


@pytest.fixture
def dataset(tmp_path):
    made = Dataset()
    for name, one in zip(NAMES, made.train, strict=True):
        write_png(tmp_path / "sr" / name, images.quantize(one.hr.image))
    return made


def views_of(dataset, folder):
    sr = Images(str(folder))
    return tuple(photo.view(sr, 4) for photo in photos_of(dataset))


def test_photos_of_one_name_in_two_folders_have_their_own_sr_images(dataset, tmp_path):
    views = views_of(dataset, tmp_path / "sr")
    assert [one.name for one in views] == list(NAMES)
    for one, expected in zip(views[1:], dataset.train[1:], strict=True):
        assert torch.allclose(one.hr.image, expected.hr.image, atol=1 / 255)
    for name, one in zip(NAMES, dataset.train, strict=True):
        write_png(tmp_path / "flat" / name.split("/")[1], images.quantize(one.hr.image))
    with pytest.raises(DataError, match=r"would be that of two views, cam1/0001.png and cam2/0001.png"):
        views_of(dataset, tmp_path / "flat")


def test_photos_are_written_with_their_masks_which_hide_at_both_scales(dataset, tmp_path):
    save_photos(photos_of(dataset), tmp_path / "lr")
    written = [read_image(tmp_path / "lr" / name) for name in NAMES]
    assert float(written[0][:, HIDDEN].max()) == 0
    assert torch.allclose(written[1], dataset.train[1].lr.image, atol=1 / 255)
    views = views_of(dataset, tmp_path / "sr")
    masks = {photo.name: photo.mask for photo in photos_of(dataset)}
    assert [mask is None for mask in masks.values()] == [False, True, True]
    assert float(views[0].hr.image[:, 4 * 12 :].abs().max()) == 0
    assert hr_gradient(views, masks[NAMES[0]]) > 0
    assert hr_gradient(views, torch.zeros(16, 24)) == 0


def hr_gradient(views, mask):
    """Σ |∂(L_base + L_HF) / ∂ means| of the first view."""
    scene = replace(toy.scene(24), train=views)
    host, _, render = gsplat_host.started(scene=scene, masks={NAMES[0]: mask})
    (render() * 0).sum().backward()  # nothing of the photo
    return float(host.splats["means"].grad.abs().sum())
