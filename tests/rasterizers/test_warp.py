"""What only Warp has to show: where it runs, why it does not, and that a warp a tile finds what one thread finds."""

from __future__ import annotations

import ast
import builtins
import dataclasses
import sys
from pathlib import Path

import pytest
import torch

import rasterizers
from rasterizers import BackendUnavailable
from rasterizers.testing import gradient_of
from tests.helpers.agreement import require_same_bits
from tests.helpers.backends import CLEAN, camera, cotangents, dense_scene, everything, why_not

installed = pytest.mark.skipif(bool(why_not("warp")), reason=str(why_not("warp")))
no_cuda = pytest.mark.skipif(torch.cuda.is_available(), reason="there is CUDA")


@installed
@no_cuda
def test_without_cuda_the_remedy_is_named():
    with pytest.raises(BackendUnavailable, match=r"no CUDA device\. Install .* device=cpu runs here"):
        rasterizers.load("warp", device="cuda")
    assert rasterizers.load("warp").device == "cpu"


def test_without_warp_the_remedy_is_named(monkeypatch):
    real = builtins.__import__

    def missing(name, *arguments, **options):
        if name == "warp":
            raise ModuleNotFoundError("No module named 'warp'", name="warp")
        return real(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(BackendUnavailable, match=r"not installed .*pip install 'clear-strategies\[warp\]'"):
        rasterizers.load("warp")


@pytest.mark.parametrize(
    ("cuda", "order"), [(True, ["warp", "gsplat", "cpp", "torch"]), (False, ["cpp", "torch", "warp", "gsplat"])]
)
def test_warp_is_the_fastest_on_cuda_and_no_choice_without(monkeypatch, cuda, order):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(rasterizers, "load", lambda name: None)
    assert list(rasterizers.available()) == order
    assert rasterizers.fastest() == order[0]


@installed
def test_an_unknown_device_is_refused():
    with pytest.raises(ValueError, match="cpu or cuda, got 'tpu'"):
        rasterizers.load("warp", device="tpu")


@installed
@pytest.mark.parametrize("k", [1, 3])
def test_a_warp_a_tile_sends_what_one_thread_sends(monkeypatch, k):
    """The way back as CUDA runs it, 32 lanes that add up together: on a CPU, where Warp can imitate them."""
    import warp as wp

    from rasterizers.warp_backend import frame

    if not hasattr(wp.config, "enable_cpu_blocks"):
        pytest.skip("this Warp has no blocks of several threads on a CPU")
    splats, view = dense_scene(600)
    v = cotangents(k, view.height, view.width)
    rasterizer = rasterizers.load("warp", device="cpu", **CLEAN)
    alone = rasterizer(splats, view).vjp(v)
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    monkeypatch.setitem(frame._LANES, "cpu", 32)
    together, again = (rasterizer(splats, view).vjp(v) for _ in range(2))
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN", "screen"):
        found, expected = gradient_of(together, name), gradient_of(alone, name)
        assert float((found - expected).norm()) <= 2e-6 * float(expected.norm()), name
        assert torch.equal(found, gradient_of(again, name))


@installed
def test_places_left_over_change_nothing(monkeypatch):
    """A compiler may round the count of tiles and their list differently: then a Gaussian has more places than tiles."""
    from rasterizers.warp_backend import frame

    splats, view = dense_scene(200)
    v = cotangents(2, view.height, view.width)
    expected = everything(rasterizers.load("warp", device="cpu")(splats, view), v)
    project, empty = frame._Frame._project, frame._Frame.empty
    left_over = torch.arange(200) % 3

    def counting_too_many(self):
        keys = project(self)
        counts = self.screens[0].counts
        counts += left_over * (counts > 0)
        self._totals[0] = counts.sum()
        return keys

    monkeypatch.setattr(frame._Frame, "_project", counting_too_many)
    monkeypatch.setattr(
        frame._Frame, "empty", lambda self, *s, dtype=torch.float32: empty(self, *s, dtype=dtype).fill_(7)
    )
    require_same_bits(everything(rasterizers.load("warp", device="cpu")(splats, view), v), expected)


@pytest.fixture
def late(monkeypatch):
    """Numbers are read late, as on CUDA; what nobody has written holds sevens."""
    from rasterizers.warp_backend import frame

    empty = frame._Frame.empty
    monkeypatch.setitem(frame._LATE, "cpu", True)
    monkeypatch.setattr(
        frame._Frame, "empty", lambda self, *s, dtype=torch.float32: empty(self, *s, dtype=dtype).fill_(7)
    )


@installed
@pytest.mark.parametrize("room", [None, 0, 1, 1000, 50_000])
def test_a_picture_is_the_same_whatever_room_its_lists_were_given(room, late):
    splats, view = dense_scene(200)
    jobs = [(splats, view), (splats, camera(64, 48))]
    v = [cotangents(2, c.height, c.width) for _, c in jobs]
    expected = [everything(rasterizers.load("warp", device="cpu")(*job), w) for job, w in zip(jobs, v, strict=True)]
    rasterizer = rasterizers.load("warp", device="cpu")
    rasterizer.render_scales(jobs)
    if room is not None:
        rasterizer._rooms.update(dict.fromkeys(rasterizer._rooms, room))
    found = [everything(r, w) for r, w in zip(rasterizer.render_scales(jobs), v, strict=True)]
    for one, other in zip(found, expected, strict=True):
        require_same_bits(one, other)


@installed
def test_what_is_wrong_is_said_at_the_first_look(late):
    from rasterizers.warp_backend import frame

    splats, view = dense_scene(200)
    rasterizer = rasterizers.load("warp", device="cpu", memory=1)
    rasterizer(splats, view)

    def launched(splats):  # by itself: the tests' type checks would look at what `rasterizer` returns
        return frame._Frame(rasterizer, [(splats, view)], [None]).draw()[0]

    huge = launched(dataclasses.replace(splats, scales=splats.scales * 100))
    with pytest.raises(MemoryError, match="Raise `memory`"):
        huge.vjp(cotangents(1, view.height, view.width))
    splats.means[3] = float("nan")
    poisoned = launched(splats)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"splats\.means must be finite; Gaussian 3"):
            poisoned.image  # noqa: B018


@installed
def test_room_follows_the_pictures(late):
    splats, view = dense_scene(200)
    rasterizer = rasterizers.load("warp", device="cpu")
    rasterizer(splats, view).image  # noqa: B018
    many = rasterizer.room(view)
    assert rasterizer.room(camera(64, 48)) == -1
    few = dataclasses.replace(splats, scales=splats.scales * 0.1)
    rooms = []
    for _ in range(200):
        rasterizer(few, view).image  # noqa: B018
        rooms.append(rasterizer.room(view))
    assert rooms[0] == many * 63 // 64
    assert rooms[-1] == rooms[-2] < many / 2


@installed
def test_nothing_is_said_on_stdout(capfd):
    rasterizers.load("warp", device="cpu")(dense_scene(10)[0], camera())
    assert capfd.readouterr().out == ""


@installed
def test_no_local_name_hides_a_constant_of_warp():
    # Warp's hash of a kernel would take `e.A` for a property of Euler's number until it has compiled `e`: no cache hit.
    import warp as wp

    from clear_strategies.kernels.gaussian_step import warp as warp_step
    from clear_strategies.kernels.losses import warp as losses
    from rasterizers import warp_backend

    constants = {name for name in dir(wp) if isinstance(getattr(wp, name), (int, float))}
    assert {"e", "pi", "inf"} <= {name.lower() for name in constants}
    folders = [Path(package.__file__).parent for package in (warp_backend, losses, warp_step)]
    for path in (path for folder in folders for path in folder.glob("*.py")):
        names = {
            n.id
            for n in ast.walk(ast.parse(path.read_text()))
            if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)
        }
        assert not names & constants, path.name


@installed
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp for macOS brings no compiler for CUDA")
def test_the_kernels_compile_for_cuda_without_one(monkeypatch, tmp_path):
    import warp as wp

    from rasterizers.warp_backend import bins, blend, colour, project

    back = blend.blend_vjp(1, 32)
    monkeypatch.setitem(back.module.options, "block_dim", 32)
    for kernel in (bins.list_pairs, blend.blend, colour.basis, project.project, back, project.vjp(1)):
        wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path / kernel.key, use_ptx=True)
        (compiled,) = (tmp_path / kernel.key).glob("*.ptx")
        assert ".target sm_90" in compiled.read_text()
