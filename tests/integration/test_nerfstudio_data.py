"""The parts of the nerfstudio method that need no nerfstudio: reading a data manager, and splatfacto's tensor shapes.

test_nerfstudio_method.py tests the method itself, where nerfstudio is installed.
"""

import functools
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from clear_strategies import GCO, P2G, Conductor
from clear_strategies.data.photo_files import write_png
from clear_strategies.data.priors import Bicubic, Cached, Images
from clear_strategies.errors import DataError, SettingError
from clear_strategies.geometry import stereo
from clear_strategies.geometry.projection import intrinsics
from integration.nerfstudio.data import over_black, photos_of, prior, seed_with_stereo, views_from_datamanager
from integration.views import save_photos
from tests.helpers import gsplat_host, toy
from tests.helpers.gsplat_host import Host
from tests.helpers.host_parts import HR_FROM_START


class DataManager:
    """nerfstudio's data manager of the toy scene, as far as it is read. Its first access corrects photos and cameras."""

    def __init__(
        self, kind=lambda image: (image * 255).round().to(torch.uint8), files=("a/0.jpg", "a/1.jpg", "a/2.jpg"),
        **extra,
    ):  # fmt: skip
        photos = [view.lr for view in toy.scene(24).train]
        flip = torch.tensor([1.0, -1, -1, 1])
        Ks = torch.stack([intrinsics(photo.camera) for photo in photos])
        self.lens = Ks / 2
        cameras = SimpleNamespace(
            camera_to_worlds=torch.stack([p.camera.world_to_camera.inverse() * flip for p in photos])[:, :3],
            get_intrinsics_matrices=lambda: self.lens,
        )
        self.train_dataset, self._corrected = SimpleNamespace(cameras=cameras, image_filenames=list(files)), Ks
        self.photos = [{"image": kind(photo.image)} | extra for photo in photos]
        old = {"points3D_xyz": torch.zeros(5, 3), "points3D_rgb": torch.zeros(5, 3), "points3D_error": torch.zeros(5)}
        self.train_dataparser_outputs = SimpleNamespace(metadata={"scale": 1.0} | old)

    @functools.cached_property
    def cached_train(self):
        self.lens = self._corrected
        return self.photos


def test_views_are_the_photos_that_splatfacto_trains_on():
    manager = DataManager()
    views = views_from_datamanager(manager, Bicubic(), 4)
    assert [view.name for view in views] == ["0.jpg", "1.jpg", "2.jpg"]
    for view, item, expected in zip(views, manager.photos, toy.scene(24).train, strict=True):
        assert torch.equal(view.lr.image, item["image"].float() / 255)
        camera, own = view.hr.camera, expected.hr.camera
        assert camera.fx == pytest.approx(own.fx)  # as undistorted
        assert (camera.fy, camera.cx, camera.cy) == pytest.approx((own.fy, own.cx, own.cy))
        assert torch.allclose(camera.world_to_camera, own.world_to_camera.float(), atol=1e-5)
        assert view.hr.image.shape == (64, 96, 3)


def test_the_sr_setting_chooses_the_prior_and_sr_images_are_found_by_the_photos_stem(tmp_path):
    for i in range(3):
        write_png(tmp_path / f"{i}.png", torch.full((64, 96, 3), 0.2 * i))
    for i, view in enumerate(views_from_datamanager(DataManager(), prior(tmp_path), 4)):
        assert view.hr.image.unique().tolist() == pytest.approx([0.2 * i])
    with pytest.raises(DataError, match="is 96x64 where 48x32 is expected"):
        views_from_datamanager(DataManager(), prior(tmp_path), 2)
    assert isinstance(prior(None), Bicubic)
    assert isinstance(prior(tmp_path), Images)
    assert isinstance(prior(tmp_path / "span.ONNX"), Cached)


def test_masks_equal_stems_and_photos_that_stay_on_disk_are_refused(tmp_path):
    with pytest.raises(DataError, match="mask"):
        views_from_datamanager(DataManager(mask=torch.ones(16, 24, 1)), Bicubic(), 4)
    twins = DataManager(files=("a/0.jpg", "b/0.jpg", "a/1.jpg"))
    with pytest.raises(DataError, match="is that of two photos"):
        views_from_datamanager(twins, Bicubic(), 4)
    with pytest.raises(DataError, match="is that of two photos"):
        save_photos(photos_of(twins), tmp_path)
    manager = DataManager()
    manager.config = SimpleNamespace(cache_images="disk")
    with pytest.raises(SettingError, match="cache_images: clear-splatfacto needs cpu or gpu, got disk"):
        views_from_datamanager(manager, Bicubic(), 4)


def test_seed_points_are_the_stereo_cloud_of_the_undistorted_photos():
    manager = DataManager()
    cameras = [view.lr.camera for view in toy.scene(24).train]
    seed_with_stereo(manager)
    metadata = manager.train_dataparser_outputs.metadata
    assert set(metadata) == {"scale", "points3D_xyz", "points3D_rgb"}
    expected = stereo(
        [item["image"] for item in manager.photos], torch.stack([camera.world_to_camera for camera in cameras]),
        torch.stack([intrinsics(camera) for camera in cameras]),
    )  # fmt: skip
    assert metadata["points3D_xyz"].shape == metadata["points3D_rgb"].shape == expected.means.shape
    near = (metadata["points3D_xyz"] - expected.means).norm(dim=1) < 0.01
    assert near.float().mean() > 0.95
    assert metadata["points3D_rgb"].dtype == torch.uint8
    assert ((metadata["points3D_rgb"] / 255 - expected.colors).abs().amax(1)[near] < 0.01).all()


@pytest.mark.parametrize("by", ["mask", "alpha", "both"])
def test_hidden_pixels_give_no_seed_points(by):
    half = torch.ones(16, 24)
    half[:, 12:] = 0

    def with_alpha(image):
        return torch.cat((image, (half if by == "alpha" else torch.ones(16, 24))[..., None]), -1)

    kind = (lambda image: image) if by == "mask" else with_alpha
    mask = {} if by == "alpha" else {"mask": half[..., None].bool()}
    assert 0 < len(seed_with_stereo(DataManager(kind, **mask))) < 0.8 * len(seed_with_stereo(DataManager()))


def test_alpha_is_composited_over_black():
    eight_bit = torch.tensor([[[255, 102, 0, 51]]], dtype=torch.uint8)
    assert over_black(eight_bit).flatten().tolist() == pytest.approx([0.2, 0.08, 0])
    assert over_black(torch.ones(1, 1, 3)).flatten().tolist() == [1, 1, 1]


class Splatfacto(Host):
    """A host with splatfacto's shapes, names and keyword call."""

    names = {"sh0": "features_dc", "shN": "features_rest"}  # noqa: RUF012

    def __init__(self, scene):
        super().__init__(scene)
        p = self.splats
        p["features_dc"], p["features_rest"] = torch.nn.Parameter(p.pop("sh0")[:, 0].detach()), p.pop("shN")
        p["opacities"] = torch.nn.Parameter(p["opacities"].detach()[:, None])
        self.optimizers = {k: torch.optim.Adam([x], lr=1e-3) for k, x in p.items()}

    def render(self, camera, step):
        p = self.splats
        return self.rasterization(
            means=p["means"], quats=p["quats"], scales=p["scales"].exp(), opacities=p["opacities"].sigmoid().squeeze(-1),
            colors=torch.cat((p["features_dc"][:, None], p["features_rest"]), 1), viewmats=camera.world_to_camera[None],
            Ks=intrinsics(camera)[None], width=camera.width, height=camera.height, sh_degree=min(3, step), packed=False,
        )  # fmt: skip


def test_splatfactos_shapes_give_the_same_gradients_as_gsplats():
    scene = toy.scene(30)
    scene = replace(scene, train=tuple(replace(v, hr=replace(v.hr, image=v.hr.image.flip(1))) for v in scene.train))
    splatfacto, plain = Splatfacto(scene), Host(scene)
    for host, names in ((splatfacto, Splatfacto.names), (plain, None)):
        conductor = Conductor(GCO(), P2G(patch=4), objective=HR_FROM_START)
        clear = gsplat_host.trained(host, scene, conductor, [scene.train[0].name], names=names)
        assert clear.attachment.log["corrected"] > 0
    for name, expected in plain.grads.items():
        g = splatfacto.grads[Splatfacto.names.get(name, name)]
        assert torch.allclose(g.reshape(expected.shape), expected, atol=1e-5 * float(expected.abs().max())), name
