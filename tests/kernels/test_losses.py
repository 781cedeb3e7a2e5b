"""Image losses: values, gradients and the hard inputs."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch._subclasses import FakeTensor, FakeTensorMode

from clear_strategies.kernels import losses, native
from clear_strategies.kernels.losses import reference
from clear_strategies.kernels.losses.images import image_pair
from clear_strategies.merging.objective import Objective
from rasterizers.interface import BackendUnavailable
from rasterizers.native import load_kernels
from tests.helpers.backends import needs, why_not


def image(height, width, seed=0, dtype=torch.float64):
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed)).to(dtype)


def rough(x, amount, seed=9):
    """The image and a noisy copy."""
    noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed))
    return x, x + amount * noise


def photo(height, width, seed=5):
    """Blobs of all sizes, edges and fine grain, as in a photograph."""
    scales = (2, 5, 17, 60)
    layers = [image(height // s + 1, width // s + 1, seed + s).float() for s in scales]
    grown = [
        z.repeat_interleave(s, 0).repeat_interleave(s, 1)[:height, :width] for z, s in zip(layers, scales, strict=True)
    ]
    return (0.2 * grown[0] + 0.1 * grown[1] + 0.3 * grown[2] + 0.4 * grown[3]).contiguous()


LOSSES = {
    "photometric": lambda x, y, name="auto": losses.photometric(x, y, 0.2, kernels=name),
    "l1": lambda x, y, name="auto": losses.photometric(x, y, 0.0, kernels=name),
    "1 - ssim": lambda x, y, name="auto": losses.photometric(x, y, 1.0, kernels=name),
    "haar": lambda x, y, name="auto": losses.haar_l1(x, y, 1, kernels=name),
    "haar of three levels": lambda x, y, name="auto": losses.haar_l1(x, y, 3, kernels=name),
}
"""The losses that training uses, at their ends too. All are 0 for equal images, with gradient 0."""


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("size", [(12, 16), (9, 7), (3, 30), (1, 1)])
def test_gradients_are_finite_differences(loss, size):
    x, y = image(*size, seed=1), image(*size, seed=2)
    g = torch.Generator().manual_seed(3)
    gradient = loss(x, y).gradient
    for _ in range(4):
        d = torch.randn(x.shape, generator=g, dtype=torch.float64)
        numeric = float(loss(x + 1e-7 * d, y).value - loss(x - 1e-7 * d, y).value) / 2e-7
        assert float((gradient * d).sum()) == pytest.approx(numeric, rel=1e-5, abs=1e-8)


def test_ssim_is_the_mean_that_scikit_image_computes_inside():
    from skimage.metrics import structural_similarity

    # Only the border differs (they reflect, 3DGS pads with zeros), so the images get a black frame.
    framed = [torch.nn.functional.pad(image(40, 50, seed), (0, 0, 20, 20, 20, 20)) for seed in (1, 2)]
    _, theirs = structural_similarity(
        *(z.numpy() for z in framed), full=True, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=2,
    )  # fmt: skip
    assert float(reference.ssim(*framed).value) == pytest.approx(float(theirs.mean()), abs=1e-9)
    for ssim in (losses.ssim, reference.ssim):
        for inset in (-1, 40):  # of 80 rows
            with pytest.raises(ValueError, match="no window lies so far inside"):
                ssim(*(z.float() for z in framed), inset)


def sky(height=96, width=90):
    """A flat sky above a flat wall of another brightness, with a textured corner."""
    x = torch.full((height, width, 3), 0.93)
    x[height // 2 :] = 0.12
    x[height // 3 :, : width // 3] = image(height - height // 3, width // 3, 3).float()
    return x


def flat(level):
    return torch.full((20, 20, 3), level)


def noise(height, width):
    return image(height, width, 1).float(), image(height, width, 2).float()


DARK, NOISE = torch.zeros(30, 40, 3), noise(30, 40)[0]
PAIRS = {
    **{
        f"{level:.3g} against {more:g} more": (flat(level), flat(level) + more)
        for level in (0.0, 1 / 255, 0.5, 0.6, 1.0)
        for more in (0.0, 1e-7, 1e-3)
    },
    **{
        f"{x:.3g} against a far {y:.3g}": (flat(x), flat(y))
        for x, y in itertools.permutations((0.0, 3e-4, 1 / 255, 0.5, 1.0), 2)
    },
    **{f"noise of {h} x {w}": noise(h, w) for h, w in ((1, 1), (3, 30), (11, 11), (40, 1), (30, 48), (141, 1101))},
    "noise against black": (NOISE, DARK),
    "black against noise": (DARK, NOISE),
    "noise against grey": (NOISE, DARK + 0.4),
    "noise against its hundredth": (NOISE, 0.01 * NOISE),
    "sky and rough copy": rough(sky(), 0.05),
    "sky and close copy": rough(sky(), 1e-3),
    "sky and other sky": (sky(), 1.1 * sky()),
    "photo and rough copy": rough(photo(133, 350), 0.1),
    "photo and close copy": rough(photo(77, 91), 1e-3),
    "photo and itself": (photo(50, 60), photo(50, 60)),
    "photo inverted": (photo(50, 60), 1 - photo(50, 60)),
    "beyond [0, 1]": (3 * photo(50, 60) - 1, photo(50, 60, 6)),
}
RUNNING = [name for name in ("cpp", "warp") if why_not(name) is None]
COMPILED = [pytest.param(name, marks=needs(name)) for name in ("cpp", "warp")]
every_compiled = pytest.mark.parametrize("name", COMPILED)
every_implementation = pytest.mark.parametrize("name", [*COMPILED, "torch"])


@pytest.mark.parametrize(("x", "y"), PAIRS.values(), ids=PAIRS)
def test_every_implementation_agrees_with_the_reference(x, y):
    for share in (0.0, 0.2, 1.0):
        exact = reference.photometric(x.double(), y.double(), share)
        for name in (*RUNNING, "torch"):
            value, gradient = losses.photometric(x, y, share, kernels=name)
            assert float(value) >= -1e-6, name
            assert float(value) == pytest.approx(float(exact.value), abs=1e-6), name
            assert_close(gradient, exact.gradient, 1e-5)
    for levels in (1, 2, 3, 7):
        value = float(reference.haar_l1(x.double(), y.double(), levels).value)
        expected = reference.haar_l1(x, y, levels)  # in float32: a detail that rounding makes 0 must be 0 in both
        for name in RUNNING:
            found = losses.haar_l1(x, y, levels, kernels=name)
            assert float(found.value) == pytest.approx(value, abs=1e-6), name
            assert_close(found.gradient, expected.gradient, 1e-6)


def assert_close(gradient, exact, relative):
    error = float((gradient.double() - exact.double()).abs().max())
    assert error <= relative * float(exact.abs().max()) + 1e-12


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@needs("cpp")
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_the_bits_do_not_depend_on_threads(loss, threads):
    x, y = rough(photo(261, 350), 0.1)
    results = []
    for n in (1, 2, 3, 4, 8, 8, 1):
        threads(n)
        results.append(loss(x, y, "cpp"))
    threads(2)
    with ThreadPoolExecutor(3) as callers:  # only one caller gets the pool
        results += callers.map(lambda _: loss(x, y, "cpp"), range(6))
    for value, gradient in results[1:]:
        assert torch.equal(value, results[0].value)
        assert torch.equal(gradient, results[0].gradient)


@needs("cpp")
@pytest.mark.parametrize("isa", ["baseline", "avx2"])
def test_every_instruction_set_agrees(isa, monkeypatch):
    if isa not in [*native.module().instruction_sets(), "baseline"]:
        pytest.skip(f"this processor has no {isa}")
    x, y = rough(photo(141, 353), 0.1)
    fastest, module = [loss(x, y, "cpp") for loss in LOSSES.values()], load_kernels("clear_strategies.kernels", isa)
    assert module.isa == isa
    monkeypatch.setattr(native, "module", lambda: module)
    for loss, mine in zip(LOSSES.values(), fastest, strict=True):
        value, gradient = loss(x, y, "cpp")
        assert float(value) == pytest.approx(float(mine.value), rel=1e-6)
        assert_close(gradient, mine.gradient, 2e-6)


@every_compiled
def test_images_of_any_layout_are_supported(name):
    x, y = photo(40, 50), photo(40, 50, 6)
    expected = losses.photometric(x, y, 0.2, kernels=name)
    planar = x.movedim(-1, 0).contiguous().movedim(0, -1).requires_grad_()
    value, gradient = losses.photometric(planar, y.flip(0).flip(0), 0.2, kernels=name)
    assert torch.equal(value, expected.value)
    assert torch.equal(gradient, expected.gradient)
    assert gradient.is_contiguous()


@every_implementation
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_a_loss_is_a_float32_scalar_where_its_images_are_outside_of_autograd(name, loss):
    x, y = photo(20, 30), photo(20, 30, 6)
    with torch.device("meta"):  # torch's default plays no part
        value, gradient = loss(x, y, name)
    assert value.shape == ()
    for result in (value, gradient):
        assert (result.dtype, result.device, result.requires_grad) == (torch.float32, x.device, False)


@every_implementation
def test_gradients_are_written_to_out(name):
    x, y = photo(20, 30), photo(20, 30, 6)
    out = torch.full((2, 20, 30, 3), torch.nan)
    ssim = losses.photometric(x, y, 0.2, kernels=name, out=out[0])
    haar = losses.haar_l1(x, y, kernels=name, out=out[1])
    assert ssim.gradient.data_ptr() == out[0].data_ptr()
    assert torch.equal(haar.gradient, out[1])
    assert torch.equal(out[0], losses.photometric(x, y, 0.2, kernels=name).gradient)


@pytest.mark.parametrize("dssim", [0.0, 1.0])
@pytest.mark.parametrize("name", [pytest.param("cpp", marks=needs("cpp"))])
def test_without_a_gradient_the_kernel_computes_ssim_alone(name, dssim):
    x, y = photo(20, 30), photo(20, 30, 6)
    means = native.module().photometric(x, y, None, 1.0, dssim, 0, 1)
    assert means == (0.0, pytest.approx(1 - float(losses.ssim(x, y).value), abs=1e-6))


@pytest.mark.parametrize(
    ("x", "y", "error", "message"),
    [
        (torch.rand(4, 5, 3).double(), torch.rand(4, 5, 3), TypeError, "x must be float32 on cpu, .* got .*float64"),
        (torch.rand(4, 5, 3), torch.rand(4, 5, 3).half(), TypeError, "y must be float32"),
        (torch.rand(4, 5, 3), torch.rand(4, 5, 3, device="meta"), TypeError, "on meta"),
        (torch.rand(4, 5, 3), torch.rand(5, 4, 3), ValueError, "as large as x"),
        (torch.rand(4, 5, 4), torch.rand(4, 5, 4), ValueError, r"\[H, W, 3\]"),
        (torch.rand(0, 5, 3), torch.rand(0, 5, 3), ValueError, "with pixels"),
    ],
)
def test_the_compiled_kernels_refuse_other_images(x, y, error, message):
    with pytest.raises(error, match=message):  # the public functions' shape annotations would raise first under pytest
        image_pair(("cpu",), x, y, None)


def test_images_on_different_devices_are_refused():
    with pytest.raises(TypeError, match=r"y must be float32 .* where x is, got .* on meta"):
        image_pair(("cpu", "meta"), torch.rand(4, 5, 3), torch.rand(4, 5, 3, device="meta"), None)


def test_auto_uses_torch_for_images_that_the_compiled_kernels_refuse():
    x, y = image(6, 7, 1), image(6, 7, 2)
    assert losses.photometric(x, y, 0.2).value.dtype == torch.float64
    assert torch.equal(losses.haar_l1(x, y).gradient, reference.haar_l1(x, y).gradient)


def test_without_compiled_kernels_torch_is_used(monkeypatch):
    def absent():
        raise BackendUnavailable("the compiled kernels are not installed")

    monkeypatch.setattr(native, "module", absent)
    x, y = photo(20, 30), photo(20, 30, 6)
    assert torch.equal(Objective().lr(x, y).cotangents[0], reference.photometric(x, y, 0.2).gradient)
    with pytest.raises(BackendUnavailable, match="not installed"):
        Objective(kernels="cpp")


@every_compiled
@pytest.mark.parametrize("clamp", [False, True])
def test_the_objective_is_the_same_compiled_and_in_torch(name, clamp):
    x, y = rough(photo(60, 70), 0.1)
    compiled, exact = (Objective(kernels=k, haar_levels=2, clamp_render=clamp).hr(x, y) for k in (name, "torch"))
    assert compiled.values == pytest.approx(exact.values, abs=1e-6)
    for found, expected in zip(compiled.cotangents, exact.cotangents, strict=True):
        assert_close(found, expected, 1e-5)


@every_implementation
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_equal_images_have_no_loss_and_no_gradient(name, loss):
    x = photo(60, 70)
    value, gradient = loss(x, x.clone(), name)
    bound = 1e-15 if name == "torch" else 0.0
    assert abs(float(value)) <= bound
    assert float(gradient.abs().max()) <= bound


def test_haar_worked_out_by_hand():
    # One 2x2 block (1 2; 3 5) per channel: details (1-2+3-5)/2, (1+2-3-5)/2, (1-2-3+5)/2.
    x = torch.tensor([[1.0, 2.0], [3.0, 5.0]])[..., None].expand(2, 2, 3)
    assert float(losses.haar_l1(x, torch.zeros_like(x)).value) == pytest.approx((1.5 + 2.5 + 0.5) / 3)


def test_the_objective_gives_its_losses_in_order():
    x, y = image(8, 8, 1), image(8, 8, 2)
    values, cotangents = Objective().hr(x, y)
    assert list(values) == ["base", "hf"]
    assert cotangents.shape == (2, 8, 8, 3)
    assert list(Objective(lambda_hf=0.0).hr(x, y).values) == ["base"]
    clamped = Objective(clamp_render=True).lr(x * 2, y)
    assert not clamped.cotangents[0][(x * 2) > 1].any()


def on_cuda(dtype=torch.float32):
    """A fake image on CUDA, without data."""
    with FakeTensorMode() as mode:
        return FakeTensor(mode, torch.empty(4, 5, 3, dtype=dtype, device="meta"), torch.device("cuda:0"))


def chosen(x, y):
    """The implementation that "auto" stands for."""
    return losses._chosen("auto", x, y).__name__.rpartition(".")[2]


def test_auto_uses_warp_on_cuda_only_where_it_runs(monkeypatch):
    x = torch.rand(4, 5, 3)
    monkeypatch.setattr(native, "runs_warp", lambda: False)
    assert chosen(on_cuda(), on_cuda()) == "reference"
    monkeypatch.setattr(native, "runs_warp", lambda: True)
    assert chosen(on_cuda(), on_cuda()) == "warp"
    assert chosen(on_cuda(), x) == "reference"
    assert chosen(on_cuda(torch.float64), on_cuda(torch.float64)) == "reference"
    assert chosen(x, x) == ("cpp" if native.available() else "reference")


@needs("warp")
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_repeated_losses_have_the_same_bits(loss):
    x, y = rough(photo(61, 150), 0.1)
    value, gradient = loss(x, y, "warp")
    for _ in range(3):
        torch.full((1 << 20,), torch.nan)  # the allocator then reuses memory that is not zero
        again = loss(x, y, "warp")
        assert torch.equal(again.value, value)
        assert torch.equal(again.gradient, gradient)


@pytest.mark.slow
@needs("warp")
@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_blocks_of_many_threads_agree_with_one_thread(whole_blocks, loss):
    x, y = rough(photo(15, 90), 0.1)
    alone = loss(x, y, "warp")
    whole_blocks()
    together = loss(x, y, "warp")
    assert float(together.value) == pytest.approx(float(alone.value), rel=1e-6)
    assert torch.allclose(together.gradient, alone.gradient, rtol=1e-5, atol=1e-6 * float(alone.gradient.abs().max()))


@pytest.mark.slow
@needs("warp")
def test_the_kernels_compile_for_cuda_on_a_machine_without(ptx_of):
    from clear_strategies.kernels.losses.warp import LANES, haar, similarity

    for kernel in (haar.details, similarity.similarity(LANES), similarity.gradient(LANES)):
        assert ".local" not in ptx_of(kernel.module, LANES)  # no spills: rows of numbers are in registers
