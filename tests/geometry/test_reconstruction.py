"""`stereo`: the trainer's cloud from plain tensors, in the light core too, and refusals that say what to give instead."""

import re
import sys
from collections.abc import Sequence
from typing import Any

import pytest
import torch

from clear_strategies.core.view import Photo
from clear_strategies.data.cloud import CloudSettings, initial_points
from clear_strategies.data.readers import demo
from clear_strategies.errors import DataError, SettingError
from clear_strategies.geometry import Stereo, StereoSettings, depth_maps, stereo
from clear_strategies.geometry.projection import intrinsics
from tests.helpers.planes import plane_photos, same_maps

QUICK = StereoSettings(enlarge=1, max_planes=32)


def reconstruct(photos: Sequence[Photo], **settings: Any) -> Stereo:
    return stereo(**{**arguments(photos), **settings})


def arguments(photos: Sequence[Photo]) -> dict[str, Any]:
    cameras = [photo.camera for photo in photos]
    return {
        "images": [photo.image for photo in photos],
        "world_to_camera": torch.stack([camera.world_to_camera for camera in cameras]),
        "Ks": torch.stack([intrinsics(camera) for camera in cameras]),
        "settings": QUICK,
    }


def same(a: Stereo, b: Stereo) -> bool:
    return same_maps(a.depths, b.depths) and torch.equal(a.means, b.means) and torch.equal(a.colors, b.colors)


@pytest.fixture(scope="module")
def plane() -> Stereo:
    return reconstruct(plane_photos(3, 64, 48))


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)


def test_the_cloud_of_the_demo_is_the_trainers_to_the_bit() -> None:
    frames = demo.read(width=64, height=48, views=6, train=3).frames[:3]
    photos = [frame.load() for frame in frames]
    trained = initial_points(CloudSettings(init="stereo", densify=True), photos)
    assert same(
        reconstruct(photos, settings=None), Stereo(trained.depths, trained.cloud.means, trained.cloud.colors, "")
    )


def test_a_warning_says_that_float32_blurs_positions_far_from_the_origin(caplog: pytest.LogCaptureFixture) -> None:
    given = arguments(plane_photos(2, 64, 48))
    given["world_to_camera"][:, 2, 3] -= 1e5
    stereo(**given)
    assert "1e+05 from the origin" in caplog.text


def test_torchs_default_device_plays_no_part(plane: Stereo) -> None:
    given = arguments(plane_photos(3, 64, 48))
    with torch.device("meta"):  # a host's may be a GPU
        assert same(stereo(**given), plane)


def test_means_lie_on_the_plane_and_the_summary_says_how_much_is_known(plane: Stereo) -> None:
    assert ((plane.means[:, 2] / 4 - 1).abs() < 0.03).float().mean() > 0.9
    assert plane.colors.min() >= 0
    assert plane.colors.max() <= 1
    shares = ", ".join(f"{depth.coverage:.0%}" for depth in plane.depths)
    assert plane.summary.startswith(f"{len(plane.means):,} points in all: ")
    assert f"between the 3 photos (depth known at {shares}), less " in plane.summary
    counts = re.findall(r"([\d,]+) (?:points|outliers|at completed)", plane.summary)
    total, found, outliers, added = (int(count.replace(",", "")) for count in counts)
    assert total == found - outliers + added
    assert "without" not in plane.summary


def test_one_tensor_is_a_list_of_photos_uint8_is_divided_by_255_and_depth_maps_are_stereos(plane: Stereo) -> None:
    photos = plane_photos(2, 64, 48)
    eight = [(photo.image * 255).round().to(torch.uint8) for photo in photos]
    listed = reconstruct(photos, images=[image.float() / 255 for image in eight])
    assert same(reconstruct(photos, images=torch.stack(eight)), listed)
    assert same(reconstruct(photos, images=eight), listed)
    maps = depth_maps(plane_photos(3, 64, 48), settings=QUICK)
    assert same(plane, Stereo(tuple(maps), plane.means, plane.colors, ""))
    with pytest.raises(SettingError, match="background: must be three numbers"):
        reconstruct(plane_photos(2, 64, 48), background=(255, 255, 255))


def test_given_features_take_the_place_of_triangulated_ones_and_the_background_gets_no_points() -> None:
    behind = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)) * 0.1 - torch.tensor([0.0, 0, 5])
    given = reconstruct(plane_photos(3, 64, 48), features=(behind, torch.ones(30, 3)), fill=False)
    kept = (given.means[:, 2] < 0).nonzero()[:, 0]  # no photo sees them, so they stay
    assert len(kept) > 20
    assert (given.colors[kept] == 1).all()
    assert "filled" not in given.summary
    photos = plane_photos(3, 64, 48)
    for photo in photos:
        photo.image[:10] = 1.0
    assert not any(depth.known[:10].any() for depth in reconstruct(photos, background=(1, 1, 1)).depths)


def test_hidden_pixels_give_no_points_and_their_colours_do_not_matter(plane: Stereo) -> None:
    photos = plane_photos(3, 64, 48)
    assert same(reconstruct(photos, masks=[None] * 3), plane)
    masks = [torch.ones(48, 64), None, torch.ones(48, 64)]
    masks[0][:, :32] = masks[2][20:] = 0
    result = reconstruct(photos, masks=masks)
    assert not result.depths[0].known[:, :32].any()
    assert not result.depths[2].known[20:].any()
    assert result.depths[0].known[:, 32:].any()
    photos[0].image[:, :32], photos[2].image[20:] = 0.3, torch.rand(28, 64, 3)
    assert same(reconstruct(photos, masks=masks), result)
    with pytest.raises(DataError, match="confirms no depth"):
        reconstruct(photos, masks=[torch.zeros(48, 64)] * 3)


def test_without_opencv_and_kornia_the_cameras_give_the_range(monkeypatch, caplog):
    without(monkeypatch, "cv2", "kornia")
    result = reconstruct(plane_photos(3, 64, 48))
    assert all(depth.coverage > 0.4 for depth in result.depths)
    assert "no triangulated features without opencv-contrib-python-headless, kornia" in result.summary
    (line,) = [record.message for record in caplog.records if "features" in record.message]
    assert line.endswith("pip install 'clear-strategies[train]'")


def test_without_scipy_nothing_is_filled_or_removed(monkeypatch, caplog):
    without(monkeypatch, "scipy")
    result = reconstruct(plane_photos(3, 64, 48))
    assert len(result.means) > 500
    assert "neither cleaned nor filled without scipy" in result.summary
    assert sum("nothing is filled without scipy" in record.message for record in caplog.records) == 1


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "one photo": ({"images": [torch.rand(48, 64, 3)]}, "images: must be at least 2 photos, got 1"),
    "poses": ({"world_to_camera": torch.eye(4)}, r"world_to_camera: must have shape \[2, 4, 4\], got \[4, 4\]"),
    "Ks": ({"Ks": torch.eye(3).expand(3, 3, 3)}, r"Ks: must have shape \[2, 3, 3\]"),
    "alpha": ({"images": torch.rand(2, 48, 64, 4)}, r"images\[0\]: must have shape \[h, w, 3\], got \[48, 64, 4\]: .*alpha"),
    "whole numbers": ({"images": torch.ones(2, 4, 4, 3, dtype=torch.long)}, "must be uint8 or floating point"),
    "8 bits as floats": ({"images": 255 * torch.ones(2, 4, 4, 3)}, r"must lie in \[0, 1\], has values from 255 to 255: divide"),
    "nan": ({"images": torch.full((2, 4, 4, 3), torch.nan)}, r"images\[0\]: has 48 numbers that are not finite"),
    "skew": ({"Ks": torch.ones(2, 3, 3)}, r"Ks\[0\]: must be \[\[fx, 0, cx\]"),
    "no rotation": ({"world_to_camera": 2 * torch.eye(4).expand(2, 4, 4)}, r"Ks\[0\]: world_to_camera must be a rotation"),
    "normalized K": ({"Ks": torch.diag(torch.tensor([0.0, 0, 1])).expand(2, 3, 3)}, r"Ks\[0\]: focal lengths"),
    "features": ({"features": (torch.zeros(2, 3), torch.zeros(3, 3))}, "features: must be positions"),
    "features far away": ({"features": (torch.full((1, 3), torch.inf), torch.zeros(1, 3))}, "have finite positions"),
    "colours": ({"features": (torch.zeros(1, 3), torch.full((1, 3), 255.0))}, r"must have colours in \[0, 1\]"),
    "too few masks": ({"masks": [None]}, "masks: must be one for each of 2 photos, got 1"),
    "mask of another size": ({"masks": [None, torch.ones(64, 48)]}, r"masks\[1\]: must have shape \[48, 64\]"),
    "one place": ({"world_to_camera": torch.eye(4).expand(2, 4, 4)}, "images: stereo confirms no depth in any of the 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_used_is_refused_with_a_remedy(case: str) -> None:
    changed, message = REFUSED[case]
    with pytest.raises(DataError, match=message):
        reconstruct(plane_photos(2, 64, 48), **changed)
