"""The tensors of `Splats` have one dtype, one device and one row per Gaussian; every backend refuses others in a sentence."""

import math
from dataclasses import replace

import pytest
import torch

from rasterizers.cpp import CppRasterizer
from rasterizers.interface import Splats
from rasterizers.testing import scene
from tests.helpers.backends import EVERY, camera, cotangents, everything, needs, require_same_bits

OTHERS = ("quats", "scales", "opacities", "sh0", "shN", "rgb_offset")


@pytest.fixture(params=[pytest.param(make, id=name, marks=needs(name)) for name, make in EVERY.items()])
def draw(request):
    return request.param()


def changed(name: str, change) -> Splats:
    """Splats with a wrong tensor. Under pytest jaxtyping would refuse it in the constructor; elsewhere nobody does."""
    splats = scene(20)
    object.__setattr__(splats, name, change(getattr(splats, name)))
    return splats


WRONG = [
    *((n, torch.Tensor.double, TypeError, "must be float32 on .*, as splats.means is, got float64") for n in OTHERS),
    *((n, lambda x: x[:-1], ValueError, r"must have the shape \[20.*, got \[19.*$") for n in OTHERS),
    ("scales", lambda x: x.to("meta"), TypeError, r"must be float32 on (cpu|cuda:0), .* got float32 on meta"),
    ("shN", lambda x: x.new_zeros(20, 5, 3), ValueError, "must hold 0, 3, 8 or 15 bands, got 5"),
]


@pytest.mark.parametrize(("name", "change", "error", "message"), WRONG)
def test_a_tensor_of_another_dtype_device_or_shape_is_refused(draw, name, change, error, message):
    with pytest.raises(error, match=f"^splats.{name} {message}"):
        draw(changed(name, change), camera())


@pytest.mark.parametrize("dtype", [torch.float16, torch.int64])
def test_a_dtype_that_no_backend_draws_is_refused(draw, dtype):
    with pytest.raises(TypeError, match=r"draws float32.* got splats.means of "):
        draw(changed("means", lambda x: x.to(dtype)), camera())


def test_a_tensor_of_another_dtype_in_a_second_job_is_refused(draw):
    splats = scene(20)
    other = replace(splats, opacities=splats.opacities.double())
    with pytest.raises(TypeError, match=r"splats.opacities must be float32"):
        draw.render_scales([(splats, camera()), (other, camera().scaled(1))])


@pytest.mark.parametrize("name", ["means", *OTHERS])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_number_that_is_not_finite_is_refused(draw, name, bad):
    visible = int(draw(scene(20), camera()).visible.nonzero()[3])
    splats = changed(name, torch.Tensor.clone)
    getattr(splats, name)[visible].view(-1)[-1] = bad
    with pytest.raises(ValueError, match=f"splats.{name} must be finite; Gaussian {visible}"):
        assert draw(splats, camera()).image is None  # Warp looks when an image is read


@pytest.fixture
def other_defaults():
    """A host's defaults, as of `torch.set_default_device("cuda")`."""
    torch.set_default_device("meta")
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_device(None)
    torch.set_default_dtype(torch.float32)


def test_torchs_default_dtype_and_device_play_no_part(draw, request):
    splats, view = scene(20), camera()
    v = cotangents(1, view.height, view.width)
    expected = everything(draw(splats, view, depth=True), v)
    request.getfixturevalue("other_defaults")
    require_same_bits(everything(draw(splats, view, depth=True), v), expected)


@needs("cpp")
def test_the_compiled_module_takes_no_converted_copy():
    """Nanobind's converted copy is freed when the call returns, and the frame would read freed memory later."""
    frame = CppRasterizer()(scene(20), camera())._frame
    image, grids = torch.empty(47, 65, 3), [[9.0, 9.0, 5.0, 5.0, 65.0, 47.0]]

    def project(opacities):
        frame.native.project(*frame.shared, grids, opacities, [None], frame.means2d, frame.visible, 1)

    project(frame.opacities)
    frame.native.draw(0, image, torch.empty(47, 65), None, 1)
    with pytest.raises(TypeError, match="incompatible function arguments"):
        frame.native.draw(0, image.double(), torch.empty(47, 65), None, 1)
    with pytest.raises(TypeError, match="incompatible function arguments"):
        project([opacities.double() for opacities in frame.opacities])
