"""The backend "warp" alone: where it runs, its blocks of many threads, and the counts that are read when an image is accessed."""

import dataclasses
import sys

import pytest
import torch

import rasterizers
from rasterizers import BackendUnavailable
from rasterizers.interface import over
from rasterizers.testing import gradient_of
from tests.helpers.backends import CLEAN, camera, cotangents, dense_scene, everything, needs, require_same_bits

installed = needs("warp")
no_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")


@installed
@pytest.mark.parametrize(
    ("tensor", "dtype", "n"),
    [
        (torch.rand(5), "float32", 1), (torch.rand(6, 8), "float32", 2), (torch.zeros(4, dtype=torch.bool), "bool", 1),
        (torch.rand(0, 3), "vec3", 1), (torch.rand(5, 3), "vec3", 1), (torch.rand(5, 2, 3)[:, 0], "vec3", 1),
        (torch.rand(6, 8, 3), "vec3", 2), (torch.rand(5, 3, 3), "mat33", 1), (torch.rand(5, 4)[1:], "vec4", 1),
    ],
)  # fmt: skip
def test_a_tensor_is_described_as_warp_describes_it(tensor, dtype, n):
    import warp as wp

    from rasterizers.warp_runtime import array

    kind = getattr(wp, dtype)
    assert bytes(array(tensor, wp.array(dtype=kind, ndim=n))) == bytes(wp.from_torch(tensor, kind, return_ctype=True))


@installed
def test_the_last_dimension_of_an_array_goes_through_several_of_a_tensor():
    import warp as wp

    from rasterizers.warp_runtime import array

    sh, flat, rows = torch.rand(5, 16, 3), wp.array(dtype=wp.float32, ndim=1), wp.array(dtype=wp.vec3, ndim=1)
    assert bytes(array(sh, flat)) == bytes(array(sh.view(-1), flat))
    assert bytes(array(sh[:, :1], rows)) == bytes(array(sh[:, 0], rows))
    assert bytes(array(torch.zeros(()), flat))[16:] == bytes(array(torch.zeros(1), flat))[16:]
    no_bands = torch.rand(5, 3, 16).mT[:, :0]  # without numbers any strides fit
    assert array(no_bands, wp.array(dtype=wp.vec3, ndim=2)).shape[:2] == [5, 0]
    for tensor, kind in ((sh[:, :2], flat), (sh[:, :2], rows), (torch.rand(3, 5).T, rows)):
        with pytest.raises(ValueError, match="copy it"):
            array(tensor, kind)


@installed
def test_numbers_of_another_type_than_a_kernel_reads_are_refused():
    """After those of the right type, whose description is kept."""
    from clear_strategies.kernels.gaussian_step.warp import passes
    from rasterizers.warp_runtime import struct

    struct(passes.Attribute, p=torch.rand(5, 3), width=3)
    with pytest.raises(TypeError, match="reads numbers of type float32, got float64: cast the tensor"):
        struct(passes.Attribute, p=torch.rand(5, 3, dtype=torch.float64), width=3)


@installed
def test_structures_of_the_same_shapes_have_their_own_addresses():
    from clear_strategies.kernels.gaussian_step.warp import passes
    from rasterizers.warp_runtime import struct

    p, m, longer = torch.rand(5, 3), torch.rand(5, 3), torch.rand(6, 3)
    made = [struct(passes.Attribute, p=x, m=y, v=None, width=3) for x, y in ((p, m), (m, p), (longer, m))]
    assert [(s.p.data, s.m.data, s.v.data) for s in made] == [
        (x.data_ptr(), y.data_ptr(), 0) for x, y in ((p, m), (m, p), (longer, m))
    ]
    assert [s.p.shape[0] for s in made] == [15, 15, 18]
    assert [struct(passes.Attribute, p=p, width=k).width for k in (3, 4, 3)] == [3, 4, 3]


@installed
@no_cuda
def test_without_cuda_the_error_says_what_to_install():
    with pytest.raises(BackendUnavailable, match=r"no CUDA device\. Install .* device=cpu runs here"):
        rasterizers.load("warp", device="cuda")
    assert rasterizers.load("warp").device == "cpu"


def test_without_warp_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)  # makes its import fail
    with pytest.raises(BackendUnavailable, match=r"not installed .*pip install -U 'clear-strategies\[warp\]'"):
        rasterizers.load("warp")


@installed
def test_a_warp_that_is_too_old_is_refused(monkeypatch):
    import warp as wp

    for version in ("1.9.1", "1.17.0"):
        monkeypatch.setattr(wp.config, "version", version)
        with pytest.raises(BackendUnavailable, match=rf"1\.18 or later, got {version}; pip install -U"):
            rasterizers.load("warp", device="cpu")
    for version in ("1.18.0rc1", "2.0.0"):
        monkeypatch.setattr(wp.config, "version", version)
        assert rasterizers.load("warp", device="cpu").device == "cpu"


@pytest.mark.parametrize(
    ("cuda", "order"), [(True, ["warp", "gsplat", "cpp", "torch"]), (False, ["cpp", "torch", "warp", "gsplat"])]
)
def test_warp_is_the_fastest_with_cuda_and_slower_than_cpp_without(monkeypatch, cuda, order):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(rasterizers, "load", lambda name: None)
    assert list(rasterizers.available()) == order
    assert rasterizers.fastest() == order[0]


@installed
@pytest.mark.parametrize("k", [1, 3])
def test_the_blending_vjp_is_the_same_with_32_threads_per_tile(whole_blocks, k):
    splats, view = dense_scene(600)
    v = cotangents(k, view.height, view.width)
    rasterizer = rasterizers.load("warp", device="cpu", **CLEAN)
    alone = rasterizer(splats, view).vjp(v)
    whole_blocks()
    together, again = (rasterizer(splats, view).vjp(v) for _ in range(2))
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN", "screen"):
        found, expected = gradient_of(together, name), gradient_of(alone, name)
        assert float((found - expected).norm()) <= 2e-6 * float(expected.norm()), name
        assert torch.equal(found, gradient_of(again, name))


@pytest.fixture
def sevens(monkeypatch):
    """Uninitialised memory holds sevens."""
    from rasterizers.warp_backend import frame

    empty = frame.WarpFrame.empty
    monkeypatch.setattr(frame.WarpFrame, "empty", lambda self, *s, dtype=None: empty(self, *s, dtype=dtype).fill_(7))


@installed
def test_unused_places_do_not_change_the_image(monkeypatch, sevens):
    """A compiler may round the count of tiles and their list differently; a Gaussian then has more places than tiles."""
    from rasterizers.warp_backend import frame

    splats, view = dense_scene(200)
    v = cotangents(2, view.height, view.width)
    expected = everything(rasterizers.load("warp", device="cpu")(splats, view), v)
    project = frame.WarpFrame.project
    unused = torch.arange(200) % 3

    def counting_too_many(self):
        found = project(self)
        counts = self.views[0].counts
        counts += unused * (counts > 0)
        return found

    monkeypatch.setattr(frame.WarpFrame, "project", counting_too_many)
    require_same_bits(everything(rasterizers.load("warp", device="cpu")(splats, view), v), expected)


@installed
@pytest.mark.parametrize("capacity", [None, 0, 1, 1000, 50_000])
def test_an_image_does_not_depend_on_the_capacity_of_its_lists(capacity, sevens):
    splats, view = dense_scene(200)
    jobs = [(splats, view), (splats, camera(64, 48))]
    v = [cotangents(2, c.height, c.width) for _, c in jobs]
    expected = [everything(rasterizers.load("warp", device="cpu")(*job), w) for job, w in zip(jobs, v, strict=True)]
    rasterizer = rasterizers.load("warp", device="cpu")
    rasterizer.render_scales(jobs)
    if capacity is not None:
        rasterizer.capacities.update(dict.fromkeys(rasterizer.capacities, capacity))
    found = [everything(r, w) for r, w in zip(rasterizer.render_scales(jobs), v, strict=True)]
    for one, other in zip(found, expected, strict=True):
        require_same_bits(one, other)


@installed
@needs("cpp")
def test_long_lists_and_large_gaussians_are_summed_in_short_chains():
    """A tile's list of 2,600, and a Gaussian on each of 12,000 tiles, whose sums are folded twice. Each kernel that goes through
    pairs has a block for each segment of them, and the others go through what is left of a tile or a Gaussian.
    """
    from clear_strategies.bench import scenes
    from rasterizers.warp_backend import frame, project
    from rasterizers.warp_backend.sizes import SEGMENT

    tails = scenes.load("tails")
    v = cotangents(1, tails.camera.height, tails.camera.width)
    found = frame.WarpFrame(rasterizers.load("warp", device="cpu", **CLEAN), [(tails.splats, tails.camera)], [False])
    (drawn,) = found.draw()
    exact = rasterizers.load("cpp", **CLEAN)(tails.splats.to(torch.float64), tails.camera)
    assert float((drawn.image - exact.image).abs().max()) < 2e-5
    g, expected = drawn.vjp(v), exact.vjp(v.double())
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        error = gradient_of(g, name).double() - gradient_of(expected, name)
        assert float(error.norm()) <= 2e-5 * float(gradient_of(expected, name).norm()), name
    counts, lists = found.views[0].counts, found.views[0].lists
    assert int((lists.ends - lists.starts).max()) > 30 * SEGMENT
    assert int((lists.ends // SEGMENT - lists.starts // SEGMENT).max()) < SEGMENT  # pieces of a tile
    assert int(counts.max()) > SEGMENT**2
    assert found.folds == (1, SEGMENT)
    assert all(count <= SEGMENT * project.stride_of(count) for count in counts.unique().tolist())


@installed
def test_errors_are_raised_when_an_image_is_accessed(sevens):
    from rasterizers.warp_backend import frame

    splats, view = dense_scene(200)
    rasterizer = rasterizers.load("warp", device="cpu", memory=1)
    rasterizer(splats, view)

    def launched(splats):  # not by `rasterizer(…)`: the tests' type checks would access the image that it returns
        return frame.WarpFrame(rasterizer, [(splats, view)], [False]).draw()[0]

    huge = launched(dataclasses.replace(splats, scales=splats.scales * 100))
    with pytest.raises(MemoryError, match="Raise `memory`"):
        huge.vjp(cotangents(1, view.height, view.width))
    splats.means[3] = float("nan")
    poisoned = launched(splats)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"splats\.means must be finite; Gaussian 3"):
            poisoned.image  # noqa: B018


@installed
def test_a_copy_over_another_background_has_the_capacities():
    """Random backgrounds make one in every iteration; without them the host waited for the device each time."""
    splats, view = dense_scene(200)
    rasterizer = rasterizers.load("warp", device="cpu")
    copied = over(rasterizer, (0.2, 0.4, 0.6))
    copied(splats, view).image  # noqa: B018
    assert copied.background == (0.2, 0.4, 0.6)
    assert rasterizer.capacity(view) == copied.capacity(view) > 0


@pytest.mark.slow
@installed
@pytest.mark.parametrize("ptx_of", [120], indirect=True)
def test_the_kernels_compile_for_cuda_on_a_machine_without(ptx_of):
    from rasterizers.warp_backend import bins, blend, colour, project

    for kernel in (bins.list_pairs, colour.basis, project.project):
        ptx_of(kernel.module)
    for depth in (False, True):
        ptx_of(blend.blend_pieces(depth, 64).module, 64)
        ptx_of(blend.blend(depth).module, 64)
    ptx_of(blend.blend_vjp(1, 32, True, absolute=True).module, 32)
    of_one = project.fold(1, absolute=True), project.project_vjp(1, absolute=True)
    for kernel in (*of_one, project.fold(3), project.project_vjp(3), project.project_vjp(3, summed=True)):
        ptx_of(kernel.module)


@pytest.mark.slow
@installed
def test_lanes_sum_their_gradients_by_shuffles(ptx_of):
    from rasterizers.warp_backend import blend

    for k, shuffles in ((1, 12), (3, 28)):
        assert ptx_of(blend.blend_vjp(k, 32, True).module, 32).count("shfl.sync") == shuffles


def test_numbered_devices_are_refused():
    with pytest.raises(ValueError, match="device must be cpu or cuda, got 'cuda:1'"):
        rasterizers.load("warp", device="cuda:1")
