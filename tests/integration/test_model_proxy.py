"""A proxy of a host's model: opacities and colours are changed once, however the host's getters call each other."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from integration.inria.cameras import enlarged_camera
from integration.inria.model_proxy import Overrides, proxy
from rasterizers.geometry import SH_C0

N = 8
ROLES = (
    ("get_opacity", "gate"), ("get_opacity_with_3D_filter", "gate"), ("get_scaling_n_opacity_with_3D_filter", "gate"),
    ("get_opacities", "gate"), ("_features_dc", "detail"),
)  # fmt: skip


class Model:
    """Getters as in Mip-Splatting, where one calls another, and a method."""

    def __init__(self):
        g = torch.Generator().manual_seed(0)
        self._opacity, self._features_dc = torch.randn(N, 1, generator=g), torch.randn(N, 1, 3, generator=g)
        self.scaling = torch.rand(N, 3, generator=g)

    @property
    def get_opacity(self):
        return self._opacity.sigmoid()

    @property
    def get_opacity_with_3D_filter(self):
        return 0.5 * self.get_opacity

    @property
    def get_scaling_n_opacity_with_3D_filter(self):
        return 2 * self.scaling, self.get_opacity_with_3D_filter

    def get_opacities(self, factor):
        return factor * self.get_opacity

    @property
    def get_features(self):
        return torch.cat((self._features_dc, torch.zeros(N, 3, 3)), 1)


def test_opacities_are_gated_once():
    model, z = Model(), torch.arange(N) / N
    overrides = Overrides(gate=z)
    gated = proxy(model, overrides, ROLES)
    assert isinstance(gated, Model)
    expected = 0.5 * model.get_opacity * z[:, None]
    assert torch.equal(gated.get_opacity_with_3D_filter, expected)
    scales, opacities = gated.get_scaling_n_opacity_with_3D_filter
    assert torch.equal(opacities, expected)
    assert torch.equal(scales, 2 * model.scaling)
    assert torch.equal(gated.get_opacities(3.0), 3.0 * model.get_opacity * z[:, None])
    assert overrides.used == {"gate"}


def test_the_detail_feature_is_added_to_the_constant_band():
    model = Model()
    difference = proxy(model, Overrides(detail=torch.ones(N, 3)), ROLES).get_features - model.get_features
    assert torch.allclose(difference[:, 0], torch.full((N, 3), 1 / SH_C0))
    assert bool((difference[:, 1:] == 0).all())


def test_an_attribute_that_the_model_lacks_is_still_missing():
    with pytest.raises(AttributeError, match="Model has no shs_dc"):
        _ = proxy(Model(), Overrides(), (("shs_dc", "detail"),)).shs_dc


def test_only_pixel_sizes_of_a_camera_are_enlarged():
    camera = SimpleNamespace(image_width=24, image_height=16, fx=torch.tensor(20.0), FoVx=0.9)
    assert vars(enlarged_camera(camera, 4)) == {"image_width": 96, "image_height": 64, "fx": 80.0, "FoVx": 0.9}
    assert camera.image_width == 24
