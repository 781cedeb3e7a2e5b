"""`rasterization`, with gsplat's signature: every call that gsplat's own test makes, against pixels composited one by one."""

import inspect
import itertools
import pickle

import pytest
import torch

import rasterizers
from rasterizers import Camera, as_gsplat, rasterization
from rasterizers.geometry import spherical_harmonics
from rasterizers.reference.projection import footprints
from rasterizers.sending import color_on
from tests.helpers.backends import needs

WIDTH, HEIGHT, N, CAMERAS = 20, 14, 24, 2
BACKENDS = [pytest.param("torch", id="torch"), pytest.param("cpp", marks=needs("cpp"), id="cpp")]
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]
GRID = [
    pytest.param(per_view, sh_degree, mode, packed, batch, id=f"{per_view}-{sh_degree}-{mode}-{packed}-{batch}")
    for per_view, sh_degree, mode, packed, batch in itertools.product(
        [True, False], [None, 3], MODES, [True, False], [(), (1, 2)]
    )
]
"""Those of gsplat 1.5.3's `test_rasterization`, and with expected depth."""


def gaussians(batch=(), dtype=torch.float64, seed=0):
    g = torch.Generator().manual_seed(seed)

    def random(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(*batch, *shape, dtype=dtype, generator=g)

    splats = {
        "means": random(N, 3, low=-1), "quats": random(N, 4, low=-1), "scales": random(N, 3, low=0.05, high=0.4),
        "opacities": random(N, low=0.2),
    }  # fmt: skip
    return {name: x.requires_grad_() for name, x in splats.items()}


def cameras(batch=(), dtype=torch.float64):
    angles = torch.linspace(0.1, 0.5, CAMERAS, dtype=torch.float64)
    poses = torch.eye(4, dtype=torch.float64).repeat(CAMERAS, 1, 1)
    poses[:, 0, 0] = poses[:, 2, 2] = angles.cos()
    poses[:, 0, 2], poses[:, 2, 0] = angles.sin(), -angles.sin()
    poses[:, :3, 3] = torch.tensor([0.1, -0.2, 4.0])
    K = torch.tensor([[24.0, 0, WIDTH / 2], [0, 23, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    viewmats, Ks = poses.expand(*batch, CAMERAS, 4, 4), K.expand(*batch, CAMERAS, 3, 3)
    return viewmats.to(dtype).clone().requires_grad_(), Ks.to(dtype).clone()


def colours(per_view, sh_degree, batch=(), channels=3, dtype=torch.float64):
    g = torch.Generator().manual_seed(7)
    lead = (*batch, CAMERAS, N) if per_view else (*batch, N)
    shape = (*lead, channels) if sh_degree is None else (*lead, 16, 3)
    x = 2 * torch.rand(*shape, dtype=dtype, generator=g) - (1 if sh_degree is None else 0.5)
    return x.requires_grad_()


def composited(splats, colors, pose, K, background=None, sh_degree=None, antialiased=False, kernel=0.3):
    """One camera's channels, accumulated depth and alpha: each pixel by autograd over all Gaussians, nearest first."""
    camera = Camera(pose, *K.diagonal()[:2].tolist(), *K[:2, 2].tolist(), WIDTH, HEIGHT)
    f = footprints(splats["means"], splats["quats"], splats["scales"], camera, kernel)
    opacities = splats["opacities"] * (f.compensation if antialiased else 1)
    if sh_degree is not None:
        directions = torch.nn.functional.normalize(splats["means"] - camera.center, dim=-1)
        basis = spherical_harmonics(directions, (sh_degree + 1) ** 2 - 1)
        colors = ((basis[..., None] * colors[:, : basis.shape[1]]).sum(1) + 0.5).clamp_min(0)
    order = f.depths.argsort()
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    dx, dy = (p.double()[..., None] - f.means2d[order, i] for i, p in enumerate((x, y)))
    A, B, C = f.conics[order].unbind(-1)
    alpha = opacities[order] * torch.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy)
    alpha = torch.where(alpha >= 1 / 255, alpha.clamp_max(0.999), 0.0)
    through = torch.cumprod(torch.cat((torch.ones_like(alpha[..., :1]), 1 - alpha), -1), -1)
    weights = through[..., :-1] * alpha
    image = weights @ colors[order] if background is None else weights @ colors[order] + through[..., -1:] * background
    return image, (weights @ f.depths[order])[..., None], 1 - through[..., -1:]


def expected(splats, colors, viewmats, Ks, mode, sh_degree=None, backgrounds=None, **settings):
    """All cameras of all scenes."""
    batch, per_view = viewmats.shape[:-3], colors.dim() == viewmats.dim() + (sh_degree is not None)
    images, alphas = [], []
    for scene in itertools.product(*map(range, batch)):
        for c in range(viewmats.shape[-3]):
            own = {name: x[scene] for name, x in splats.items()}
            picture, depth, alpha = composited(
                own, colors[(*scene, c)] if per_view else colors[scene], viewmats[(*scene, c)], Ks[(*scene, c)],
                None if backgrounds is None else backgrounds[(*scene, c)], sh_degree, **settings,
            )  # fmt: skip
            depth = depth / alpha.clamp_min(1e-10) if "ED" in mode else depth
            images.append(torch.cat([*[picture][: "RGB" in mode], *[depth][: mode != "RGB"]], -1))
            alphas.append(alpha)
    lead = viewmats.shape[:-2]
    return torch.stack(images).view(*lead, *images[0].shape), torch.stack(alphas).view(*lead, *alphas[0].shape)


def gradients(image, alpha, inputs):
    """Of a loss that depends on everything that was drawn."""
    g = torch.Generator().manual_seed(3)
    weights = [torch.rand(x.shape, dtype=torch.float64, generator=g) for x in (image, alpha)]
    loss = sum((w * x.double() ** 2).sum() for w, x in zip(weights, (image, alpha), strict=True))
    return torch.autograd.grad(
        loss, list(inputs.values()), allow_unused=True, materialize_grads=True, retain_graph=True
    )


def drawn(splats, colors, viewmats, Ks, **call):
    return rasterization(*splats.values(), colors, viewmats, Ks, WIDTH, HEIGHT, **call)


def moved(viewmats, motion):
    """The cameras after a small rigid motion each: [..., 6]."""
    generator = motion.new_zeros(*motion.shape[:-1], 4, 4)
    rows, columns, signs = [2, 0, 1, 1, 2, 0], [1, 2, 0, 2, 0, 1], [1, 1, 1, -1, -1, -1]
    for i, (row, column, sign) in enumerate(zip(rows, columns, signs, strict=True)):
        generator[..., row, column] = sign * motion[..., i % 3]
    generator[..., :3, 3] = motion[..., 3:]
    return torch.linalg.matrix_exp(generator) @ viewmats


def require_close(found, exact, tolerance, names):
    for name, x, y in zip(names, found, exact, strict=True):
        error = float((x - y).abs().max() / y.abs().max().clamp_min(1e-12))
        assert error <= tolerance, f"{name}: {error}"


@pytest.mark.parametrize(("per_view", "sh_degree", "mode", "packed", "batch"), GRID)
@needs("cpp")
def test_every_call_of_gsplats_own_test(per_view, sh_degree, mode, packed, batch):
    splats, colors, (viewmats, Ks) = gaussians(batch), colours(per_view, sh_degree, batch), cameras(batch)
    call = {"sh_degree": sh_degree, "render_mode": mode, "packed": packed, "backend": "cpp"}
    motion = torch.zeros(*batch, CAMERAS, 6, dtype=torch.float64, requires_grad=True)
    inputs = {**splats, "colors": colors, "motion": motion}
    poses = moved(viewmats.detach(), motion)
    image, alpha, info = drawn(splats, colors, poses, Ks, **call)
    exact, exact_alpha = expected(splats, colors, poses, Ks, mode, sh_degree)
    require_close((image, alpha), (exact, exact_alpha), 1e-6, ("image", "alpha"))
    exact_gradients = gradients(exact, exact_alpha, inputs)
    require_close(gradients(image, alpha, inputs), exact_gradients, 1e-5, inputs)
    m = len(info["gaussian_ids"]) if packed else None
    lead = (m,) if packed else (*batch, CAMERAS, N)
    assert [info[name].shape for name in ("means2d", "radii", "depths", "conics", "opacities")] == [
        (*lead, 2), (*lead, 2), lead, (*lead, 3), lead
    ]  # fmt: skip


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_any_number_of_channels_of_any_range_over_a_background_that_is_trained(backend, channels, mode):
    """Normals are rendered so: numbers below 0 and above 1 are not cut off."""
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, None, channels=channels), cameras()
    colors.data.mul_(2)
    backgrounds = (3 * torch.rand(CAMERAS, channels, dtype=torch.float64) - 1).requires_grad_()
    inputs = {**splats, "colors": colors, "backgrounds": backgrounds}
    call = {"backgrounds": backgrounds, "render_mode": mode, "rasterize_mode": "antialiased", "backend": backend}
    image, alpha, _ = drawn(splats, colors, viewmats, Ks, **call)
    exact, exact_alpha = expected(splats, colors, viewmats, Ks, mode, backgrounds=backgrounds, antialiased=True)
    require_close((image, alpha), (exact, exact_alpha), 1e-6, ("image", "alpha"))
    require_close(gradients(image, alpha, inputs), gradients(exact, exact_alpha, inputs), 1e-5, inputs)


@pytest.mark.parametrize("backend", BACKENDS)
def test_in_float32_values_and_gradients_are_those_of_float64(backend):
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, 3), cameras()
    exact = expected(splats, colors, viewmats, Ks, "RGB+D", 3)
    inputs = {name: x.detach().float().requires_grad_() for name, x in {**splats, "colors": colors}.items()}
    image, alpha, _ = rasterization(
        *inputs.values(), viewmats.detach().float(), Ks.float(), WIDTH, HEIGHT, sh_degree=3, render_mode="RGB+D",
        backend=backend,
    )  # fmt: skip
    require_close((image, alpha), exact, 1e-4, ("image", "alpha"))
    exact_gradients = gradients(*exact, {**splats, "colors": colors})
    require_close(gradients(image, alpha, inputs), exact_gradients, 1e-3, inputs)


def test_a_camera_and_a_background_of_an_evaluation_can_be_trained_by():
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, 3), cameras()
    viewmats, colour = viewmats.detach().clone(), (0.125, 0.25, 0.5)
    viewmats[:, :3, 3] += 0.0123  # which no other test has

    def image():
        behind = color_on(colour, viewmats.device, viewmats.dtype).expand(len(viewmats), 3)
        return drawn(splats, colors, viewmats, Ks, backgrounds=behind, backend="torch", sh_degree=3)[0]

    with torch.inference_mode():
        image()
    image().sum().backward()


ABSOLUTE = [*BACKENDS, pytest.param("warp", marks=needs("warp"), id="warp")]


@pytest.mark.parametrize(
    ("backend", "packed", "mode"),
    [
        *[pytest.param(*x.values, packed, "RGB", marks=x.marks) for x in ABSOLUTE for packed in (True, False)],
        *[pytest.param(*x.values, False, "RGB+ED", marks=x.marks) for x in BACKENDS],  # Warp sums those of depth apart
    ],
)
def test_absolute_gradients_are_summed_over_pixels(backend, packed, mode):
    """Each pixel's gradient of the centres, one backward pass for each of some pixels; the loss does not depend on the others."""
    dtype = torch.float32 if backend == "warp" else torch.float64
    splats, colors, (viewmats, Ks) = gaussians(dtype=dtype), colours(False, 3, dtype=dtype), cameras(dtype=dtype)
    call = {"sh_degree": 3, "packed": packed, "backend": backend, "render_mode": mode}
    image, _, info = drawn(splats, colors, viewmats, Ks, absgrad=True, **call)
    weights, rows, columns = torch.zeros_like(image), range(1, HEIGHT, 5), range(0, WIDTH, 4)
    some = weights[:, rows.start :: rows.step, columns.start :: columns.step]
    some.copy_(torch.randn(some.shape, dtype=dtype, generator=torch.Generator().manual_seed(5)))
    (image * weights).sum().backward(retain_graph=True)
    found, total = info["means2d"].absgrad.clone(), torch.zeros_like(info["means2d"])
    for camera, y, x in itertools.product(range(CAMERAS), rows, columns):
        (of_pixel,) = torch.autograd.grad(
            (image * weights)[camera, y, x].sum(), info["means2d"], retain_graph=True, allow_unused=True
        )
        total += of_pixel.abs()
    assert total.abs().max() > 0
    assert torch.allclose(found, total, rtol=1e-4, atol=1e-5 * float(total.max()))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("antialiased", [True, False])
def test_info_has_gsplats_projections_and_radii_as_far_as_the_opacity_lets_them_reach(backend, packed, antialiased):
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, None), cameras()
    splats["opacities"] = torch.linspace(0.003, 1.5, N, dtype=torch.float64)  # above 1 under inverted dropout
    splats["scales"] = splats["scales"] * torch.logspace(-2, 0, N, dtype=torch.float64)[:, None]
    mode = "antialiased" if antialiased else "classic"
    _, _, info = drawn(splats, colors, viewmats, Ks, packed=packed, rasterize_mode=mode, backend=backend)
    covariances, _ = torch_impl._quat_scale_to_covar_preci(splats["quats"], splats["scales"], True, False)
    _, means2d, depths, conics, compensations = torch_impl._fully_fused_projection(
        splats["means"], covariances, viewmats, Ks, WIDTH, HEIGHT, calc_compensations=True
    )
    blurred = torch.linalg.inv(conics[..., [0, 1, 1, 2]].unflatten(-1, (2, 2)))
    opacities = splats["opacities"] * (compensations if antialiased else 1)
    # As gsplat's kernel; its torch function always takes 3.33.
    reach = (2 * (255 * opacities).log()).clamp(0, 3.33**2).sqrt()
    radii = (reach[..., None] * blurred.diagonal(dim1=-2, dim2=-1).sqrt()).ceil().int()
    assert "radii" in info  # as gsplat's strategies ask before they read it
    ids = (info["camera_ids"], info["gaussian_ids"]) if packed else (info["radii"] > 0).all(-1).nonzero(as_tuple=True)
    assert CAMERAS * N > len(ids[0]) > N
    found = {
        name: info[name] if packed else info[name][ids]
        for name in ("radii", "means2d", "depths", "conics", "opacities")
    }
    assert torch.equal(found["radii"], radii[ids])
    for name, of_gsplat in {"means2d": means2d, "depths": depths, "conics": conics, "opacities": opacities}.items():
        assert torch.allclose(
            found[name], of_gsplat.expand(depths.shape)[ids] if name == "opacities" else of_gsplat[ids]
        ), name
    gradients = [
        torch.autograd.grad((z * conic.sum(-1)).sum(), splats["means"])[0]
        for z, conic in ((found["depths"], found["conics"]), (depths[ids], conics[ids]))
    ]
    assert torch.allclose(*gradients, rtol=1e-6)


def test_names_of_info_make_nothing_and_what_reads_it_as_a_dictionary_has_the_whole():
    splats, (viewmats, Ks) = gaussians(), cameras()
    _, _, info = drawn(splats, colours(False, None), viewmats, Ks, packed=False)
    assert len(info) == len(list(info)) == len(set(info))
    assert {"means2d", "radii", "conics"} <= info.keys()
    assert not any(dict.__contains__(info, name) for name in ("radii", "conics", "depths"))
    info["conics"] = None  # a loop's own
    for whole in ({**info}, dict(info), dict(info.items()), info.copy(), {} | info, info | {}):
        assert whole.keys() == info.keys()
        assert whole["radii"] is info["radii"]
        assert whole["depths"] is info["depths"]
        assert whole["conics"] is None
    assert info.get("nothing") is None
    assert "nothing" not in info


@pytest.mark.parametrize("packed", [False, True])
def test_an_image_of_tensors_without_gradients_has_none(packed):
    """`image.numpy()` works, and images stack in the workers of a DataLoader."""
    viewmats, Ks = (x.detach() for x in cameras())
    inputs = {
        name: x.detach() for name, x in {**gaussians(), "colors": colours(False, None), "viewmats": viewmats}.items()
    }

    def gradients_of(name):
        given = {k: x.clone().requires_grad_(k == name) for k, x in inputs.items()}
        image, _, info = rasterization(*given.values(), Ks, WIDTH, HEIGHT, packed=packed, backend="torch")
        return image.requires_grad, info["means2d"].requires_grad

    assert gradients_of(None) == (False, False)
    assert all(gradients_of(name) == (True, True) for name in inputs)


@pytest.mark.parametrize("packed", [False, True])
def test_info_is_pickled_and_emptied_as_a_dictionary_is(packed):
    splats, (viewmats, Ks) = {name: x.detach() for name, x in gaussians().items()}, cameras()
    call = splats, colours(False, None).detach(), viewmats.detach(), Ks
    info = drawn(*call, packed=packed)[2]
    saved = pickle.loads(pickle.dumps(info))  # noqa: S301
    assert saved.keys() == info.keys()
    assert torch.equal(saved["conics"], info["conics"])
    info = drawn(*call, packed=packed)[2]
    assert torch.equal(info.setdefault("radii", None), saved["radii"])
    assert all(torch.equal(info.pop(name), saved[name]) for name in ("radii", "depths"))
    assert not {"radii", "depths"} & info.keys()


@needs("warp")
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_radii_of_warp_are_those_of_the_reference_as_float32_rounds_them(mode):
    splats, (viewmats, Ks) = {name: x.float() for name, x in gaussians().items()}, cameras()
    call = *splats.values(), colours(False, None).float(), viewmats.float(), Ks.float(), WIDTH, HEIGHT
    of = {name: rasterization(*call, rasterize_mode=mode, backend=name)[2] for name in ("torch", "warp")}
    found, expected = (info["radii"] for info in of.values())
    assert found.dtype == torch.int32
    assert torch.equal(found > 0, expected > 0)
    assert float((found != expected).float().mean()) < 0.01
    assert int((found - expected).abs().max()) <= 1 < int(expected.max())


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("call", [{}, {"rasterize_mode": "antialiased", "eps2d": 3.0}], ids=["classic", "antialiased"])
def test_what_lies_too_far_or_is_too_small_is_left_out(backend, call):
    """By the depths and radii of `info`; the opacity of antialiased Gaussians, and so their radius, is smaller."""
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, None), cameras()
    splats["scales"] = splats["scales"] * 0.3

    def info(**more):
        return drawn(splats, colors, viewmats, Ks, packed=True, backend=backend, **call, **more)[2]

    depths, radii = info()["depths"], info()["radii"]
    far, clip = float(depths.median()), int(radii.amax(1).median())
    assert sorted(info(far_plane=far)["depths"]) == sorted(depths[depths <= far])
    assert len(radii) > len(info(radius_clip=clip)["radii"]) == int((radii > clip).any(1).sum()) > 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("size", [1e-3, 1e-9, 1e-30])
def test_small_channels_keep_their_digits(backend, size):
    splats, colors = gaussians(dtype=torch.float32), colours(False, None, dtype=torch.float32)
    call = *(x.float() for x in cameras()), WIDTH, HEIGHT
    small = (colors.detach() * size).requires_grad_()
    (whole, *_), (image, *_) = (rasterization(*splats.values(), x, *call, backend=backend) for x in (colors, small))
    assert torch.allclose(image / size, whole, atol=1e-6 * float(whole.abs().max()))
    of_whole, of_small = (torch.autograd.grad(x.sum(), c)[0] for x, c in ((whole, colors), (image, small)))
    assert torch.allclose(of_small, of_whole, rtol=1e-4, atol=1e-5 * float(of_whole.abs().max()))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_backward_pass_of_depth_is_refused_after_alpha_was_changed_in_place(backend):
    """It would read the changed numbers. Of an image without depth, nothing reads them; the images of two cameras are copies."""
    splats, colors, (viewmats, Ks) = gaussians(), colours(False, None), cameras()
    for mode in ("RGB", "RGB+ED"):
        image, alpha, _ = drawn(splats, colors, viewmats[:1], Ks[:1], render_mode=mode, backend=backend)
        with torch.no_grad():
            alpha.mul_(2)
        if mode == "RGB":
            image.sum().backward()
        else:
            with pytest.raises(RuntimeError, match="modified by an inplace operation"):
                image.sum().backward()


@pytest.mark.parametrize(
    ("call", "named"),
    [
        ({"camera_model": "fisheye"}, "does not support camera_model='fisheye'"),
        ({"rendermode": "D"}, "does not support rendermode='D'"),
        ({"with_ut": True}, "does not support with_ut=True"),
        ({"distributed": True}, "distributed=True"),
        ({"covars": torch.zeros(N, 3, 3)}, "does not support covars"),
        ({"render_mode": "normals"}, "render_mode must be one of RGB, D, ED, RGB[+]D, RGB[+]ED"),
        ({"backgrounds": torch.zeros(CAMERAS, 4)}, r"backgrounds must have the shape \[2, 3\]"),
        ({"colors": torch.zeros(N, 4, 3), "sh_degree": 3}, r"must .*\[24, K, 3\] with K >= 16, .*got \[24, 4, 3\]"),
        ({"colors": torch.zeros(N - 1, 16)}, r"must .*\[24, D\] with D >= 1, .*got \[23, 16\]"),
        ({"colors": torch.zeros(N, 0)}, r"must .*\[24, D\] with D >= 1, .*got \[24, 0\]"),
        ({"colors": torch.zeros(N, 25, 3), "sh_degree": 4}, "sh_degree must be 0, 1, 2 or 3, got 4"),
        ({"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}, "at least one scene and one camera"),
    ],
)
def test_what_is_not_drawn_is_refused_by_name(call, named):
    splats, (viewmats, Ks) = gaussians(), cameras()
    with pytest.raises(ValueError, match=named):
        drawn(splats, **{"colors": colours(False, None), "viewmats": viewmats, "Ks": Ks, **call})


@pytest.mark.parametrize("name", ["viewmats", "Ks", "backgrounds"])
def test_tensors_of_cameras_need_one_row_for_each(name):
    """Under pytest the shape annotations of `rasterization` would raise first."""
    right = {"viewmats": torch.zeros(2, 4, 4), "Ks": torch.zeros(2, 3, 3), "backgrounds": torch.zeros(2, 3)}
    geometry, colors = (torch.zeros(5, 4), torch.zeros(5, 3), torch.zeros(5)), torch.zeros(5, 3)
    given = {**right, name: right[name][0]}

    def require():
        as_gsplat._require_geometry((), 5, 2, *geometry, given["viewmats"], given["Ks"], None)
        as_gsplat._require_colors((), 5, 2, colors, None, given["backgrounds"])

    with pytest.raises(ValueError, match=rf"^{name} must have the shape \[2, .*, got"):
        require()


# ---- as gsplat's own programs use it
def test_gsplats_arguments_have_gsplats_order_and_its_defaults_are_drawn():
    theirs, ours = (
        inspect.signature(f).parameters for f in (pytest.importorskip("gsplat").rasterization, rasterization)
    )
    shared = list(ours).index("backend")
    assert list(theirs)[:shared] == list(ours)[:shared]
    defaults = {name: p.default for name, p in theirs.items() if p.default is not p.empty}
    image, *_ = drawn(gaussians(), colours(False, None), *cameras(), **defaults)
    assert image.shape == (CAMERAS, HEIGHT, WIDTH, 3)


def test_gsplats_strategy_reads_the_packed_info():
    """Of two cameras, one of which sees a part of the scene."""
    strategies = pytest.importorskip("gsplat").strategy
    viewmats, Ks = (x.detach() for x in cameras(dtype=torch.float32))
    viewmats[1, 0, 3] += 2
    infos, states = [], []
    for packed in (False, True):
        splats = gaussians(dtype=torch.float32)
        strategy = strategies.DefaultStrategy(verbose=False)
        params, state = {"means": splats["means"]}, strategy.initialize_state()
        images, _, info = drawn(
            splats, colours(False, 3, dtype=torch.float32), viewmats, Ks, sh_degree=3, packed=packed
        )
        strategy.step_pre_backward(params, {}, state, 1, info)
        images.square().sum().backward()
        strategy.step_post_backward(params, {}, state, 1, info, packed=packed)
        infos.append(info)
        states.append(state)
    unpacked, packed = infos
    ids = packed["camera_ids"], packed["gaussian_ids"]
    assert N < len(ids[0]) < CAMERAS * N
    assert torch.equal(torch.stack(ids, 1), (unpacked["radii"] > 0).all(-1).nonzero())
    assert torch.equal(packed["means2d"].grad, unpacked["means2d"].grad[ids])
    for name in ("grad2d", "count"):
        assert torch.allclose(states[0][name], states[1][name]), name


def test_the_names_of_before_go_on_working():
    from rasterizers import autograd

    assert autograd.rasterization is rasterization is rasterizers.rasterization
