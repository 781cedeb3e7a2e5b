"""What stands in for CUDA: the modules against independent computations, and the launcher as a program."""

import importlib
import math
import re
import runpy
import sys
from contextlib import suppress
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from clear_strategies.errors import HostError
from integration.on_cpu import diff_gaussian_rasterization, gsplat_functions
from integration.on_cpu.__main__ import REFUSED, _knn, _OwnRasterizers, main
from integration.on_cpu.diff_gaussian_rasterization import GaussianRasterizationSettings, GaussianRasterizer
from integration.on_cpu.fused_ssim import fused_ssim
from integration.on_cpu.simple_knn import distances_and_indices
from tests.helpers import command_line
from tests.helpers.host_parts import FOLDER, FROM_START
from tests.helpers.paths import ROOT

WIDTH, HEIGHT, FOCAL = 48, 36, 50.0
FORKS = {
    "3dgs": {"antialiasing": False},
    "mip-splatting": {"kernel_size": 0.1, "subpixel_offset": torch.zeros(HEIGHT, WIDTH, 2)},
    "dropgaussian": {},
    "fsgs": {"confidence": torch.ones(9, 1)},
}
MORE = {"3dgs": ["depth"], "mip-splatting": [], "dropgaussian": [], "fsgs": ["depth", "alpha"]}


def settings(fork, cx=WIDTH / 2, bg=(0.0, 0.0, 0.0), **more):
    """The settings by name, as the trainers give them."""
    view = torch.eye(4)
    view[2, 3] = 4.0
    near, far = 0.01, 100.0
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1] = 2 * FOCAL / WIDTH, 2 * FOCAL / HEIGHT
    projection[0, 2] = 2 * cx / WIDTH - 1
    projection[2, 2:], projection[3, 2] = torch.tensor([far / (far - near), -far * near / (far - near)]), 1.0
    return GaussianRasterizationSettings(**{
        "image_height": HEIGHT, "image_width": WIDTH, "tanfovx": WIDTH / 2 / FOCAL, "tanfovy": HEIGHT / 2 / FOCAL,
        "bg": torch.tensor(bg), "scale_modifier": 1.0, "viewmatrix": view.T, "projmatrix": view.T @ projection.T,
        "sh_degree": 1, "campos": torch.tensor([0.0, 0.0, -4.0]), "prefiltered": False, "debug": False,
        **FORKS[fork], **more,
    })  # fmt: skip


def cloud(n=9, seed=0):
    """The arguments of a rasterizer, as leaves."""
    torch.manual_seed(seed)
    made = {
        "means3D": torch.rand(n, 3) - 0.5, "means2D": torch.zeros(n, 3), "opacities": 0.3 + 0.5 * torch.rand(n, 1),
        "shs": torch.randn(n, 4, 3) * 0.3, "scales": 0.1 + 0.1 * torch.rand(n, 3),
        "rotations": F.normalize(torch.randn(n, 4), dim=1),
    }  # fmt: skip
    return {name: x.requires_grad_() for name, x in made.items()}


def in_colours(rgb, **changes):
    """The same arguments with colours in place of spherical harmonics."""
    return {name: x for name, x in cloud().items() if name != "shs"} | {"colors_precomp": rgb} | changes


@pytest.mark.parametrize("fork", FORKS)
def test_each_fork_gets_what_its_own_rasterizer_returns(fork):
    image, radii, *more = GaussianRasterizer(raster_settings=settings(fork))(**cloud())
    assert image.shape == (3, HEIGHT, WIDTH)
    assert radii.shape == (9,)
    assert radii.dtype == torch.int32
    assert [x.shape for x in more] == [(1, HEIGHT, WIDTH) for _ in MORE[fork]]
    reused = GaussianRasterizer(settings(fork, bg=(1.0, 0.5, 0.0)))(**cloud())[0]
    assert torch.allclose(reused[2], image[2], atol=1e-5)  # over black in blue alone
    assert bool((reused[0] >= image[0] - 1e-5).all())


@pytest.mark.parametrize("fork", FORKS)
def test_viewspace_points_get_the_gradient_of_the_centres_in_ndc(fork):
    """All centres moved by dx pixels are the image of a camera whose principal point is dx further."""
    weights = torch.randn(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    weights = F.avg_pool2d(weights, 9, 1, 4)
    given = cloud()
    (GaussianRasterizer(settings(fork))(**given)[0] * weights).sum().backward()
    ndc = given["means2D"].grad
    by_camera = [
        float((GaussianRasterizer(settings(fork, cx=WIDTH / 2 + dx))(**cloud())[0] * weights).sum().detach())
        for dx in (0.1, -0.1)
    ]
    assert float(ndc[:, 0].sum()) * 2 / WIDTH == pytest.approx((by_camera[0] - by_camera[1]) / 0.2, rel=0.05)
    if fork != "mip-splatting":
        assert not bool(ndc[:, 2].any())
    assert all(given[name].grad.abs().sum() > 0 for name in ("means3D", "opacities", "shs", "scales", "rotations"))


def test_mip_splattings_third_column_sums_absolute_gradients_over_pixels():
    def of(pixels):
        given = cloud()
        image = GaussianRasterizer(settings("mip-splatting"))(**given)[0]
        sum(image[1, y, x] for y, x in pixels).backward()
        return given["means2D"].grad

    pixels = [(y, x) for y in (14, 18, 22) for x in (18, 22, 26, 30)]
    together = of(pixels)
    each = sum(of([pixel])[:, :2].abs().sum(1) for pixel in pixels)
    assert torch.allclose(together[:, 2], each, rtol=1e-4)
    assert float((each / together[:, :2].abs().sum(1).clamp_min(1e-9)).max()) > 1.5


def test_radii_are_three_deviations_in_pixels_and_0_where_nothing_is_seen():
    z, sigma = 5.0, 0.3
    means = torch.tensor([[0.0, 0, z - 4], [0, 0, -9], [90, 0, z - 4]])
    one = in_colours(torch.ones(3, 3), means3D=means, means2D=torch.zeros(3, 3), opacities=torch.ones(3, 1) * 0.9,
                     scales=torch.full((3, 3), sigma), rotations=torch.eye(4)[:1].expand(3, 4))  # fmt: skip
    rasterizer = GaussianRasterizer(settings("3dgs"))
    _, radii, _ = rasterizer(**one)
    largest = (FOCAL * sigma / z) ** 2 + 0.3 + math.sqrt(0.1)  # 3DGS's bound of the eigenvalue
    assert radii.tolist() == [math.ceil(3 * math.sqrt(largest)), 0, 0]
    assert rasterizer.markVisible(means).tolist() == [True, False, True]


@pytest.mark.parametrize(("fork", "of_z"), [("3dgs", lambda z: 1 / z), ("fsgs", lambda z: z)])
def test_depth_is_the_sum_of_the_gaussians_depths_and_can_be_learned_from(fork, of_z):
    rasterizer, given = GaussianRasterizer(settings(fork)), cloud()
    depth = rasterizer(**given)[2]
    values = of_z(given["means3D"][:, 2:].detach() + 4)
    assert torch.allclose(depth[0], rasterizer(**in_colours(values.expand(-1, 3)))[0][0], atol=1e-5)
    depth.sum().backward()
    expected, given_again = given["means3D"].grad.clone(), cloud()
    changes = {name: x for name, x in given_again.items() if name != "shs"}
    again = rasterizer(**changes, colors_precomp=of_z(given_again["means3D"][:, 2:] + 4).expand(-1, 3))[0][0]
    again.sum().backward()
    assert torch.allclose(expected, given_again["means3D"].grad, rtol=1e-3, atol=1e-4)
    assert torch.allclose(given["means2D"].grad, given_again["means2D"].grad, rtol=1e-3, atol=1e-4)
    assert given["shs"].grad is None


def test_colours_may_have_any_sign():
    rgb = torch.randn(9, 3)
    draw = GaussianRasterizer(settings("dropgaussian"))
    assert torch.allclose(draw(**in_colours(rgb))[0], -draw(**in_colours(-rgb))[0], atol=1e-5)


def test_what_only_the_cuda_rasterizers_have_is_refused():
    with pytest.raises(ValueError, match="subpixel_offset must be 0"):
        GaussianRasterizer(settings("mip-splatting", subpixel_offset=torch.ones(HEIGHT, WIDTH, 2)))
    with pytest.raises(ValueError, match="confidence must be 1"):
        GaussianRasterizer(settings("fsgs", confidence=torch.zeros(9, 1)))
    draw = GaussianRasterizer(settings("3dgs"))
    with pytest.raises(ValueError, match="exactly one of shs and colors_precomp"):
        draw(**cloud(), colors_precomp=torch.ones(9, 3))
    with pytest.raises(ValueError, match="cov3D_precomp"):
        draw(**{k: x for k, x in cloud().items() if k not in ("scales", "rotations")}, cov3D_precomp=torch.ones(9, 6))


def test_distances_are_those_of_the_three_nearest():
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    squared = torch.cdist(points.double(), points.double()).square().fill_diagonal_(torch.inf)
    nearest = squared.topk(3, largest=False)
    mean, indices = distances_and_indices(points.requires_grad_())
    assert torch.allclose(mean, nearest.values.mean(1).float())
    assert torch.equal(indices.long(), nearest.indices)
    with pytest.raises(ValueError, match="at least 4 points"):
        distances_and_indices(points[:3])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["compiled", "torch"])
@pytest.mark.parametrize("padding", ["same", "valid"])
def test_fused_ssim_and_its_gradient_are_those_of_the_definition(padding, dtype):
    torch.manual_seed(0)
    x = torch.rand(2, 3, 70, 61, dtype=dtype)
    y, a = (x + 0.3 * torch.randn_like(x)).clamp(0, 1), x.clone().requires_grad_()
    b = x.double().requires_grad_()
    line = torch.exp(-((torch.arange(11.0, dtype=torch.float64) - 5) ** 2) / 4.5)
    window = (torch.outer(line, line) / line.sum() ** 2).expand(3, 1, 11, 11)

    def mean(image):
        return F.conv2d(image, window, padding=5 if padding == "same" else 0, groups=3)

    t, mx, my = y.double(), mean(b), mean(y.double())
    vx, vy, xy = mean(b * b) - mx**2, mean(t * t) - my**2, mean(b * t) - mx * my
    value = ((2 * mx * my + 1e-4) * (2 * xy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean()
    ours = fused_ssim(a, y, padding=padding)
    assert float(ours) == pytest.approx(float(value), abs=1e-6)
    (3 * ours).backward()
    (3 * value).backward()
    assert torch.allclose(a.grad.double(), b.grad, atol=2e-6 * float(b.grad.abs().max()) + 1e-9, rtol=1e-4)
    with pytest.raises(ValueError, match="'same' or 'valid'"):
        fused_ssim(a, y, padding="reflect")


def test_gsplats_adam_steps_visible_rows_alone():
    pytest.importorskip("gsplat")
    p, m, v = torch.ones(3, 2), torch.zeros(3, 2), torch.zeros(3, 2)
    seen = torch.tensor([True, False, True])
    gsplat_functions.function("adam")(p, torch.full((3, 2), 2.0), m, v, seen, 0.1, 0.9, 0.99, 1e-8)
    stepped = 1 - 0.1 * 0.2 / math.sqrt(0.04)
    assert torch.allclose(p, torch.tensor([[stepped] * 2, [1.0] * 2, [stepped] * 2]))
    assert m[1].tolist() == v[1].tolist() == [0, 0]


@pytest.mark.parametrize("packed", [False, True])
def test_before_gsplat_1_5_a_gaussian_has_one_radius(packed):
    def theirs(means, quats, scales, opacities, colors, viewmats, Ks, width, height, packed=True):
        raise NotImplementedError

    given = cloud()
    pose, K = torch.eye(4)[None], torch.tensor([[[9.0, 0, 8], [0, 9, 8], [0, 0, 1]]])
    pose[:, 2, 3] = 4
    splats = given["means3D"], given["rotations"], given["scales"], given["opacities"][:, 0], given["means3D"]
    one, two = (
        gsplat_functions.rasterization_like(theirs, one_radius=one)(*splats, pose, K, 16, 16, packed=packed)[2]
        for one in (True, False)
    )
    assert one["radii"].shape == one["means2d"].shape[:-1]
    assert torch.equal(one["radii"], two["radii"].amax(-1))


@pytest.mark.parametrize(
    ("file", "text", "returns_indices"),
    [
        ("submodules/simple-knn/spatial.h", "std::tuple<torch::Tensor, torch::Tensor> distCUDA2(const torch::Tensor&);", True),
        ("submodules/simple-knn/spatial.h", "torch::Tensor distCUDA2(const torch::Tensor& points);", False),
        ("scene/gaussian_model.py", "dist, nearest_indices = distCUDA2(self.get_xyz)", True),
        ("scene/gaussian_model.py", "dist2 = torch.clamp_min(distCUDA2(points), 0.0000001)", False),
    ],
)  # fmt: skip
def test_distances_come_with_indices_where_a_fork_has_them_also_without_its_submodules(
    file, text, returns_indices, tmp_path
):
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text(text)
    assert isinstance(_knn(tmp_path / "gaussian_renderer").distCUDA2(torch.rand(9, 3)), tuple) == returns_indices


# ---- the launcher
def test_the_how_to_lists_what_is_refused():
    page = (ROOT / "docs" / "how-to" / "on-a-laptop.md").read_text()
    assert {option for option in REFUSED if f"`{option}`" not in page} == set()


TRAINER = """
import sys, threading
import torch
from helper import NAME
from diff_gaussian_rasterization import GaussianRasterizer
from fused_ssim import fused_ssim
from simple_knn._C import distCUDA2

if __name__ == "__main__":
    print("argv", sys.argv[1:], "file", __file__ == sys.argv[0], "first", sys.path[0], NAME)
    torch.cuda.set_device(torch.device("cuda:0")); torch.cuda.manual_seed_all(0)
    began, ended = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    began.record()
    x = torch.zeros((2, 3), device="cuda:0").to("cuda", non_blocking=True).to(0)
    x = torch.nn.Parameter(x.cuda() + torch.ones(3, pin_memory=True).pin_memory().cuda(0))
    net = torch.nn.Linear(3, 1).cuda().to(torch.device("cuda"))
    optimizer, scaler = torch.optim.Adam([x], lr=0.1), torch.amp.GradScaler("cuda")
    data = torch.utils.data.DataLoader([torch.ones(3)] * 4, num_workers=1, pin_memory=True)
    for row in data:
        with torch.autocast("cuda", enabled=True):
            loss = (net(x) * row.to("cuda").sum()).sum()
        scaler.scale(loss).backward(); scaler.step(optimizer); scaler.update()
    ended.record(); torch.cuda.synchronize(); torch.cuda.empty_cache()
    assert began.elapsed_time(ended) > 0
    assert torch.cuda.max_memory_allocated() > 1e7
    torch.save({"x": x}, sys.argv[1])
    assert torch.load(sys.argv[1], map_location=lambda storage, loc: storage.cuda(0))["x"].shape == (2, 3)
    assert torch.load(sys.argv[1], map_location="cuda:0")["x"].device == torch.device("cuda")
    seen = []
    thread = threading.Thread(target=lambda: seen.append(torch.ones(2, device="cuda").device.type))
    thread.start(); thread.join()
    assert not torch.compile(lambda: torch.compiler.is_compiling())()
    sh0 = torch.nn.ParameterDict({"sh0": torch.nn.Parameter(torch.zeros(4, 16, 3)[:, :1])}).to("cuda:0")["sh0"]
    sh0.grad = torch.ones_like(sh0)
    torch.optim.Adam([sh0], lr=0.1, fused=True).step()  # it would miss most of rows with gaps
    assert torch.allclose(sh0, torch.tensor(-0.1))
    assert sh0.is_contiguous() and torch.zeros(4, 16, 3)[:, :1].cuda().is_contiguous()
    across = torch.zeros(2, 3).T
    assert across.to("cuda") is across and across[:, :1].to(torch.float32).stride() == (1, 3)
    with torch.cuda.device(0):
        seen.append(torch.cuda.FloatTensor([1.0]).device.type)
    print("seen", seen, torch.cuda.is_available(), distCUDA2(torch.rand(9, 3, device="cuda")).shape)
    sys.exit(3)
"""


OF_GSPLAT = """
import torch, gsplat
from gsplat.distributed import cli
from gsplat.relocation import compute_relocation
from gsplat.rendering import rasterization

def main(local_rank, world_rank, world_size, config):
    means = torch.randn(5, 3, device=f"cuda:{local_rank}").requires_grad_()
    quats, scales, opacities = torch.ones(5, 4).cuda(), torch.ones(5, 3).cuda(), torch.full((5,), 0.5).cuda()
    pose, K = torch.eye(4)[None].cuda(), torch.tensor([[[9.0, 0, 8], [0, 9, 8], [0, 0, 1]]]).cuda()
    pose[:, 2, 3] = 6
    images, _, info = rasterization(means, quats, scales, opacities, means, pose, K, 16, 16)
    images.sum().backward()
    print(images.shape, info["means2d"].shape, means.grad.abs().sum() > 0)
    new, _ = compute_relocation(opacities, scales, torch.full((5,), 2).cuda(), torch.ones(51, 51).cuda())
    print(torch.allclose(1 - (1 - new) ** 2, opacities))
    gsplat.rasterization_2dgs(means, quats, scales, opacities, means, pose, K, 16, 16)

cli(main, None, verbose=True)
"""


def launched(folder, *arguments, source=TRAINER):
    """The launcher as a program; a script in a folder of its own, beside a module that it imports."""
    (folder / "trainer").mkdir(exist_ok=True)
    (folder / "trainer" / "train.py").write_text(source)
    (folder / "trainer" / "helper.py").write_text("NAME = 'beside'")
    return command_line.run(*map(str, arguments), cwd=folder, module="integration.on_cpu")


def test_cuda_is_the_cpu_and_the_script_is_run_as_python_runs_it(tmp_path):
    done = launched(tmp_path, "trainer/train.py", tmp_path / "x.pt", "--sr", "theirs")
    assert done.returncode == 3, done.stderr
    argv, seen = done.stdout.splitlines()
    theirs = [str(tmp_path / "x.pt"), "--sr", "theirs"]
    assert argv == f"argv {theirs} file True first {tmp_path / 'trainer'} beside"
    assert seen == "seen ['cpu', 'cpu'] False torch.Size([9])"


@pytest.mark.parametrize(
    ("use", "named"),
    [
        (lambda: importlib.import_module("diff_surfel_rasterization"), "the module diff_surfel_rasterization"),
        (lambda: diff_gaussian_rasterization.compute_relocation, "compute_relocation"),
        (lambda: GaussianRasterizationSettings(f_count=True), "f_count"),
        (lambda: GaussianRasterizer(settings("3dgs"))(**cloud(), scores=None), "scores"),
    ],
)
def test_a_fork_that_needs_its_own_rasterizer_is_told_so(use, named, monkeypatch):
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path, _OwnRasterizers])
    with pytest.raises(HostError, match=f"needs its own CUDA rasterizer, for {named}, and with it a GPU"):
        use()


RENDERER = """
def render(rasterizer, given, otherwise=False):
    if otherwise:
        image, radii, depth, alpha = rasterizer(**given)
    number, _, _ = [len(rasterizer(**given))] * 3
    {unpacked} = rasterizer(
        **given)
    return {unpacked}
"""


@pytest.mark.parametrize(
    ("unpacked", "drawn"),
    [
        ("rendered_image, radii", []),
        ("image, radii, depth", ["depth"]),
        ("image, radii, alpha", ["alpha"]),
        ("self.image, self.radii, invdepth", ["inverse"]),
        ("rendered_image, radii, rendered_depth,\\\n        rendered_alpha", ["depth", "alpha"]),
        ("image, *_, depth", ["depth"]),
        ("*_, radii, rendered_depth, alpha", ["depth", "alpha"]),
        ("image, *more", []),
        ("image, radii, depth, *more", ["depth"]),
        ("rendered_image, radii, pixels", None),
        ("image, *_, pixels", None),
        ("image, radii, pixels, *_", None),
        ("image, radii, depth, alpha, idx, weights", None),
    ],
)
def test_a_fork_with_3dgss_settings_gets_what_its_call_unpacks_or_is_refused(unpacked, drawn, tmp_path):
    """Binocular3DGS, SCGaussian; Pixel-GS and LoopSparseGS have rasterizers of their own. Other calls unpack what they want."""
    (tmp_path / "renderer.py").write_text(RENDERER.format(unpacked=unpacked))
    render = runpy.run_path(str(tmp_path / "renderer.py"), {"self": SimpleNamespace()})["render"]
    draw, given = GaussianRasterizer(settings("dropgaussian")), cloud()
    if drawn is None:
        with pytest.raises(HostError, match=f"for what it returns .*{re.escape(unpacked)}.*, and with it a GPU"):
            render(draw, given)
        return
    depth, alpha = GaussianRasterizer(settings("fsgs"))(**given)[2:]
    inverse = GaussianRasterizer(settings("3dgs"))(**given)[2]
    expected = {"depth": depth, "alpha": alpha, "inverse": inverse}
    _, _, *more = render(draw, given)
    assert len(more) == len(drawn)
    assert all(torch.equal(x, expected[kind]) for x, kind in zip(more, drawn, strict=True))


@pytest.mark.parametrize(
    ("needs", "own"),
    [
        ("import diff_gaussian_rasterization_ms", "the module diff_gaussian_rasterization_ms"),
        ("import diff_gaussian_rasterization._C", "the module diff_gaussian_rasterization._C"),
        ("from simple_knn._C import distIndex2", "simple_knn._C.distIndex2"),
    ],
)
def test_a_fork_may_do_without_what_it_tries_to_import(needs, own, tmp_path):
    """3DGS tries its SparseGaussianAdam. What ends a script is one line."""
    source = f"try:\n    from diff_gaussian_rasterization import SparseGaussianAdam\nexcept ImportError:\n    {needs}"
    done = launched(tmp_path, "trainer/train.py", source=source)
    assert done.returncode == 2
    assert f"for {own}" in done.stderr
    assert "Traceback" not in done.stderr


def test_gsplats_functions_are_there_without_cuda_and_those_that_are_not_are_named(tmp_path):
    pytest.importorskip("gsplat")
    done = launched(tmp_path, "trainer/train.py", source=OF_GSPLAT)
    assert done.stdout.split("\n")[:2] == [
        "torch.Size([1, 16, 16, 3]) torch.Size([5, 2]) tensor(True)",  # packed, as gsplat's default is
        "True",
    ], done.stderr
    assert done.returncode == 2
    assert re.search(r"gsplat's CUDA function \w*projection\w*_2dgs\w* has no counterpart", done.stderr)
    assert "Traceback" not in done.stderr


def test_with_strategies_it_does_what_the_trainers_launcher_does(inria_capture, inria_launched):
    """The trainer of tests/helpers/inria_host, in both."""
    options = ["--strategies", "clear", "--sr", "sr", *(f"--overrides={row}" for row in FROM_START)]
    script = [
        FOLDER / "train.py",
        "-s",
        inria_capture,
        "--save",
        "ours.safetensors",
        "--iterations",
        "6",
        "--densify_until_iter",
        "0",
    ]
    done = launched(inria_capture, *options, *script)
    assert done.returncode == 0, done.stderr
    file = inria_capture / "theirs.safetensors"
    assert inria_launched("--save", file, "--iterations", "6", "--densify_until_iter", "0") == 0
    ours, theirs = load_file(inria_capture / "ours.safetensors"), load_file(file)
    assert ours.keys() == theirs.keys()
    assert all(torch.allclose(ours[name], theirs[name], atol=1e-5) for name in ours)


@pytest.mark.parametrize(("arguments", "said"), [
    (["train.py", "x", "--with-ut"], "--with_ut needs CUDA; on a CPU, leave it out"),
    (["train.py", "--optimizer_type", "sparse_adam"], "--optimizer_type=sparse_adam needs CUDA"),
    (["train.py", "--camera_model", "ortho"], "--camera_model=ortho needs CUDA"),
    (["--sr", "sr", "train.py"], "--sr has no effect without --strategies"),
    (["--strategies", "gco,svs", "train.py"], "train.py clear-splatfacto --pipeline.model.strategies gco,svs"),
])  # fmt: skip
def test_what_cannot_work_is_named_at_the_start(arguments, said, tmp_path, monkeypatch, capsys, caplog):
    """Nerfstudio's scripts have a method with the strategies."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "train.py").write_text("raise ValueError\nfrom nerfstudio.scripts.train import entrypoint\n")
    with suppress(SystemExit):  # as argparse ends a program
        assert main(arguments) == 2
    assert said in capsys.readouterr().err + caplog.text
