"""The reference rasterizer: the public checks, and values worked out by hand."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

import rasterizers
from rasterizers import PRESETS, Camera, Splats
from rasterizers.geometry import rotation_matrix, spherical_harmonics
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import CHECKS, ContractError, check_rasterizer, scene
from tests.helpers.backends import balls


def test_a_rasterizer_that_ignores_the_background_fails_the_checks():
    with pytest.raises(ContractError, match="background"):
        check_rasterizer(lambda **settings: ReferenceRasterizer(**{**settings, "background": (0.0, 0.0, 0.0)}))


@pytest.mark.parametrize("name", ["means2d", "alpha"])
def test_the_contract_looks_at_centres_and_alpha(name):
    check = next(check for check in CHECKS if check.__name__ == "check_agrees_with_the_reference")

    class Other(ReferenceRasterizer):
        def __call__(self, *given, **settings):
            drawn = super().__call__(*given, **settings)
            parts = {part: getattr(drawn, part) for part in dir(drawn) if not part.startswith("_")}
            return SimpleNamespace(**parts | {name: parts[name].flip(1)})

    with pytest.raises(ContractError, match=f"{name}.* is off by"):
        check(Other)


def odd_camera(focal=40.0) -> Camera:
    """The centre of pixel (10, 10) looks straight ahead."""
    return Camera(torch.eye(4), focal, focal, 10.5, 10.5, 21, 21)


def test_a_ball_has_the_opacity_that_mip_splatting_gives_it():
    # σ' = 40 · 0.05 = 2 px; with the kernel σ'² = 4.1; compensation √(16 / 16.81) = 4 / 4.1.
    rendering = rasterizers.load("torch")(balls(2.0, opacity=0.8, scale=0.05), odd_camera())
    assert rendering.alpha[10, 10] == pytest.approx(0.8 * 4 / 4.1, rel=1e-12)
    assert rendering.image[10, 10, 0] == pytest.approx(0.5 * 0.8 * 4 / 4.1, rel=1e-12)
    assert rendering.alpha[10, 12] == pytest.approx(0.8 * 4 / 4.1 * math.exp(-0.5 * 4 / 4.1), rel=1e-12)
    assert rendering.means2d[0].tolist() == [10.5, 10.5]


def test_the_nearer_ball_covers_the_farther_alpha_is_capped_and_a_pixel_ends_before_its_limit():
    near, far = balls(2.0, opacity=0.5, color=1.0), balls(3.0, opacity=0.9, color=0.2)
    both = Splats(*(torch.cat((getattr(far, f), getattr(near, f))) for f in Splats.__slots__[:6]))
    settings = {"kernel": 0.0, "antialiased": False}
    pixel = rasterizers.load("torch", **settings)(both, odd_camera()).image[10, 10, 0]
    assert pixel == pytest.approx(0.5 * 1.0 + 0.5 * 0.9 * 0.2, rel=1e-12)
    rendering = rasterizers.load("torch", kernel=0.0)(balls(2.0, opacity=1.25, scale=0.05), odd_camera())
    assert rendering.alpha[10, 10] == pytest.approx(0.99)
    assert rendering.alpha[10, 12] == pytest.approx(1.25 * math.exp(-0.5), rel=1e-12)
    five = balls(*[2.0] * 5, opacity=0.9)
    # The transmittance goes 0.1, 0.01, 0.001, …: the last one not below the limit stays.
    for limit, left in ((5e-4, 1e-3), (5e-3, 1e-2), (0.5, 1.0)):
        rasterizer = rasterizers.load("torch", kernel=0.0, transmittance_min=limit)
        assert 1 - rasterizer(five, odd_camera()).alpha[10, 10] == pytest.approx(left, rel=1e-9)


@pytest.mark.parametrize("lanes", [1, 4096, 1 << 20])
def test_batches_do_not_change_the_picture(lanes):
    splats, camera = scene(200, dtype=torch.float64), Camera(torch.eye(4), 40.0, 40.0, 20.0, 15.0, 41, 33)
    expected = rasterizers.load("torch")(splats, camera)
    found = rasterizers.load("torch", lanes=lanes)(splats, camera)
    assert torch.allclose(found.image, expected.image, atol=1e-14)
    v = torch.ones(1, 33, 41, 3, dtype=torch.float64)
    assert torch.allclose(found.vjp(v).means, expected.vjp(v).means, rtol=1e-9, atol=1e-12)


def test_a_preset_sets_the_cut_offs_and_where_no_rasterizer_draws_the_error_says_so():
    assert rasterizers.available()["torch"] is None
    with pytest.raises(rasterizers.BackendUnavailable, match="no rasterizer draws tensors on 'mps'; move the splats"):
        rasterizers.fastest(torch.device("mps"))
    assert rasterizers.fastest(torch.device("cpu")) == rasterizers.fastest("cpu:0") == rasterizers.fastest("cpu")
    assert rasterizers.load("torch", preset="fast") == rasterizers.load("torch")
    cuts = []
    for name, preset in PRESETS.items():
        rasterizer = rasterizers.load("torch", preset=name)
        cuts.append((rasterizer.alpha_min, rasterizer.transmittance_min))
        assert cuts[-1] == (preset["alpha_min"], preset["transmittance_min"])
        assert rasterizers.load("torch", preset=name, alpha_min=1 / 64) == replace(rasterizer, alpha_min=1 / 64)
    assert cuts == sorted(cuts, reverse=True)  # coarsest first
    with pytest.raises(ValueError, match="alpha_max <= 1 - 1e-7 must hold"):
        rasterizers.load("torch", alpha_max=1 - 1e-8)  # in float32 it is 1, which divides by 0


def test_a_scaled_camera_has_the_same_field_of_view():
    camera = Camera(torch.eye(4), 40.0, 44.0, 17.0, 15.0, 40, 32)
    small = camera.scaled(1 / 4)
    assert (small.fx, small.fy, small.cx, small.cy, small.width, small.height) == (10.0, 11.0, 4.25, 3.75, 10, 8)
    with pytest.raises(ValueError, match="whole number of pixels"):
        camera.scaled(1 / 3)


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.mul_(0), lambda p: p[:3, :3].mul_(2), lambda p: p[0].neg_(), lambda p: p[0, 1].add_(0.1),
        lambda p: p[3, 3].mul_(2),
    ],
    ids=["zero", "scaled", "reflected", "sheared", "last row"],
)  # fmt: skip
def test_a_pose_that_is_not_rigid_is_refused(change):
    pose = torch.eye(4)
    change(pose)
    with pytest.raises(ValueError, match="must be a rotation and a translation"):
        Camera(pose, 10.0, 10.0, 5.0, 5.0, 10, 10)


@pytest.mark.parametrize("scale", [1e-12, 1e-30])
def test_an_ellipse_that_is_too_small_for_any_pixel_has_no_gradient(scale):
    """Without Mip's kernel: the derivative of its conic overflows, and the gradient of the conic is 0."""
    splats = scene(6, bands=0)
    tiny = replace(splats, scales=torch.cat((torch.full((1, 3), scale), splats.scales[1:])))
    rendering = ReferenceRasterizer(kernel=0.0)(tiny, Camera(torch.eye(4), 30.0, 30.0, 16.0, 12.0, 32, 24))
    gradients = rendering.vjp(torch.ones_like(rendering.image)[None])
    for name in ("means", "quats", "scales", "opacities"):
        assert not getattr(gradients, name)[0, 0].any()
        assert getattr(gradients, name).isfinite().all()


def test_quaternions_of_any_norm_give_the_same_rotation_and_spherical_harmonics_are_orthonormal():
    q = torch.tensor([[0.3, -0.2, 0.8, 0.1]])
    expected = rotation_matrix(q)
    for scale in (1e-30, 1e-10, 1e10, 1e18):
        assert torch.allclose(rotation_matrix(q * scale), expected, atol=1e-6)
    zero = torch.zeros(1, 4, requires_grad=True)
    matrix = rotation_matrix(zero)
    assert torch.equal(matrix[0], torch.eye(3))
    (gradient,) = torch.autograd.grad(matrix.sum(), zero)
    assert torch.equal(gradient, torch.zeros(1, 4))
    g = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(200_000, 3, generator=g, dtype=torch.float64), dim=-1)
    Y = spherical_harmonics(directions, 15)
    gram = 4 * math.pi * Y.T @ Y / len(Y)
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=0.03)


@pytest.mark.parametrize("pixels", [1e3, 1e5, 1e7, 1e9])
@pytest.mark.parametrize("shape", [(1.0, 0.7, 0.4), (1.0, 0.01, 0.01)])
def test_float32_gradients_of_huge_footprints_agree_with_float64(pixels, shape):
    """The opacity's compensation is then 1 minus a tiny number, whose gradient must not be a difference of large ones."""
    camera = Camera(torch.eye(4), 100.0, 100.0, 33.0, 24.0, 65, 47)
    v = torch.randn(1, 47, 65, 3, generator=torch.Generator().manual_seed(0))
    splats = replace(
        balls(1.0, dtype=torch.float32), means=torch.tensor([[0.05, -0.02, 1.0]]),
        quats=torch.tensor([[0.8, -0.3, 0.5, 0.2]]), scales=torch.tensor([shape]) * pixels / 100,
    )  # fmt: skip
    found, exact = (ReferenceRasterizer()(s, camera).vjp(v.to(s.means)) for s in (splats, splats.to(torch.float64)))
    for name in ("means", "quats", "scales", "opacities", "sh0", "screen"):
        a, b = getattr(found, name).double(), getattr(exact, name)
        assert float((a - b).norm()) <= 2e-5 * float(b.norm()), name
