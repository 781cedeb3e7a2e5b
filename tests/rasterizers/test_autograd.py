"""Rasterizers as torch functions: gradients of the image, and depth to look at."""

import gc
import inspect
import threading
import weakref
from dataclasses import fields, replace

import pytest
import torch

import rasterizers
from clear_strategies.geometry.projection import intrinsics
from rasterizers import SplatGradients, Splats, as_gsplat, autograd
from rasterizers.ahead import _ahead
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import pixels_of, scene
from tests.helpers.backends import camera


class WithoutDepthGradient(ReferenceRasterizer):
    @property
    def traits(self):
        return replace(super().traits, depth_gradient=False)


def leaves(splats: Splats) -> Splats:
    return Splats(**{f.name: getattr(splats, f.name).clone().requires_grad_() for f in fields(Splats)})


def require_gradients(splats: Splats, screen: torch.Tensor, expected: SplatGradients) -> None:
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.allclose(getattr(splats, name).grad, getattr(expected, name)[0], rtol=1e-9, atol=1e-12), name
    assert torch.allclose(screen, expected.screen[0])


@pytest.mark.parametrize("depth", [False, True])
def test_what_was_drawn_is_freed_with_its_image(depth, monkeypatch):
    drawn, draw = [], ReferenceRasterizer.__call__

    def remembering(*arguments, **options):
        rendering = draw(*arguments, **options)
        drawn.append(weakref.ref(rendering))
        return rendering

    monkeypatch.setattr(ReferenceRasterizer, "__call__", remembering)
    autograd.draw(ReferenceRasterizer(), leaves(scene(20)), camera(40, 30), depth=depth).image.sum().backward()
    gc.collect()
    assert drawn[0]() is None


def drawn_in(splats):
    return autograd.draw(ReferenceRasterizer(), splats, camera(40, 30))


@pytest.mark.parametrize("inside", [0, 1])
def test_a_recording_has_what_is_drawn_inside_of_it_and_ends_alone(inside):
    splats = leaves(scene(20))
    with autograd.recorded() as outer:
        with autograd.recorded() as inner:
            for _ in range(inside):
                drawn_in(splats)
        drawn_in(splats)
    drawn_in(splats)
    assert (len(outer), len(inner)) == (1 + inside, inside)


def test_a_thread_records_its_own_drawings():
    splats, both, seen = leaves(scene(20)), threading.Barrier(2), []

    def work():
        with autograd.recorded() as drawings:
            both.wait()
            drawn_in(splats)
            both.wait()
            seen.append(len(drawings))

    threads = [threading.Thread(target=work) for _ in range(2)]
    for step in ("start", "join"):
        for thread in threads:
            getattr(thread, step)()
    assert seen == [1, 1]


@pytest.fixture
def together(monkeypatch):
    """How many images were drawn together each time."""
    numbers, render_scales = [], ReferenceRasterizer.render_scales

    def counted(self, jobs, **more):
        numbers.append(len(jobs))
        return render_scales(self, jobs, **more)

    monkeypatch.setattr(ReferenceRasterizer, "render_scales", counted)
    return numbers


def ahead(view):
    return autograd.drawing_ahead(view.world_to_camera, intrinsics(view), view.width, view.height)


def test_an_image_that_is_drawn_ahead_is_taken_inside_and_forgotten_with_the_block(together):
    view, splats = camera(40, 30), scene(60)
    shown, colors = replace(splats, rgb_offset=None), torch.cat((splats.sh0, splats.shN), 1)
    expected = autograd.draw(ReferenceRasterizer(), shown, view, colors=colors).image
    with ahead(view):
        autograd.draw(ReferenceRasterizer(), splats, view.scaled(2), colors=colors)
        assert together[-1] == 2
        # While it is kept its tensors live, so that no others at their addresses are taken for them.
        assert _ahead.kept[2].means.data_ptr() == splats.means.data_ptr()
        drawn = len(together)
        assert torch.equal(autograd.draw(ReferenceRasterizer(), shown, view, colors=colors).image, expected)
        assert len(together) == drawn
        assert _ahead.kept is None
    with ahead(view):
        autograd.draw(ReferenceRasterizer(), splats, view.scaled(2), colors=colors)
    shown.means.data.add_(0.1)  # which torch does not count
    assert not torch.equal(autograd.draw(ReferenceRasterizer(), shown, view, colors=colors).image, expected)


def test_other_poses_and_the_image_itself_bring_no_other_along(together):
    view, splats = camera(40, 30), replace(scene(60), rgb_offset=None)
    pose = view.world_to_camera.clone()
    pose[0, 3] += 1
    with ahead(view):
        autograd.draw(ReferenceRasterizer(), splats, replace(view, world_to_camera=pose))
        autograd.draw(ReferenceRasterizer(), splats, view)
    assert set(together) <= {1}


@pytest.mark.parametrize("depth", [False, True])
def test_a_loss_of_the_image_has_the_gradient_of_the_vjp(depth):
    rasterizer, view = ReferenceRasterizer(), camera(40, 30)
    splats = leaves(scene(60, dtype=torch.float64))
    v = torch.randn(30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = autograd.draw(rasterizer, splats, view, depth=depth)
    (drawn.image * v).sum().backward()
    expected = rasterizer(splats, view).vjp(v[None])
    require_gradients(splats, drawn.means2d.grad, expected)
    assert torch.allclose(splats.rgb_offset.grad, expected.rgb[0])


def test_losses_of_depth_and_of_gradients_and_splats_changed_in_place_are_refused_rather_than_left_out():
    drawn = autograd.draw(WithoutDepthGradient(), leaves(scene(60)), camera(40, 30), depth=True)
    with pytest.raises(
        NotImplementedError, match="the loss depends on a rendered depth, which has no gradient in Without"
    ):
        (drawn.image.sum() + drawn.depth.sum()).backward()
    splats = leaves(scene(60))
    image = autograd.draw(ReferenceRasterizer(), splats, camera(40, 30)).image
    (slope,) = torch.autograd.grad(image.square().sum(), splats.means, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        (image.sum() + slope.square().sum()).backward()
    splats = leaves(scene(60))
    image = autograd.draw(ReferenceRasterizer(), splats, camera(40, 30)).image
    with torch.no_grad():
        splats.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()


def test_the_stand_in_for_gsplats_rasterization_has_our_rasterizers_gradients():
    """The expected depth is the fourth channel of its images."""
    view, splats = camera(40, 30), replace(leaves(scene(60, dtype=torch.float64)), rgb_offset=None)
    images, _, info = stand_in(splats, render_mode="RGB+ED")
    expected = rasterizers.load("torch", kernel=0.3, antialiased=False)(splats, view, depth=True)
    assert torch.allclose(images[0], pixels_of(expected))
    v = torch.randn(1, 30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (images[..., :3] * v).sum().backward()
    require_gradients(splats, info["means2d"].grad[0], expected.vjp(v))


@pytest.mark.parametrize("backend", [ReferenceRasterizer, WithoutDepthGradient])
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (0.9, 0.2, 0.4)])
def test_a_loss_of_alpha_has_the_gradient_of_another_background(backend, background):
    """C + (1 - alpha) b over black is what a rasterizer draws over b."""
    b, view = torch.tensor(background, dtype=torch.float64), camera(40, 30)
    v = torch.randn(30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    composed, drawn_over = (leaves(scene(60, dtype=torch.float64)) for _ in range(2))
    for over in (background, (0.3, 0.3, 0.3)):
        rasterizer = backend(background=over)
        shot = autograd.draw(rasterizer, composed, view)
        image = shot.image + (1 - shot.alpha)[..., None] * (b - torch.tensor(over, dtype=torch.float64))
        (image * v).sum().backward()
    expected = ReferenceRasterizer(background=background)(drawn_over, view).vjp(v[None])
    for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
        assert torch.allclose(getattr(composed, name).grad, 2 * getattr(expected, name)[0], rtol=1e-6, atol=1e-9), name


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera_model": "fisheye"}, "does not support camera_model='fisheye'"),
        ({"rendermode": "D"}, "does not support rendermode='D'"), ({"with_ut": True}, "does not support with_ut=True"),
        ({"covars": torch.zeros(60, 3, 3)}, "does not support covars"), ({"render_mode": "normals"}, "render_mode must be one"),
        ({"colors": torch.zeros(60, 4, 3), "sh_degree": 3}, r"must .*\[60, K, 3\] with K >= 16, .*got \[60, 4, 3\]"),
        ({"colors": torch.zeros(50, 16), "sh_degree": None}, r"must .*\[60, D\], .*got \[50, 16\]"),
    ],
)  # fmt: skip
def test_arguments_that_only_gsplat_supports_and_colors_of_another_shape_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        stand_in(**arguments)


def test_rgb_may_have_any_range_as_in_gsplat():
    """Normals are rendered so. Images are linear in it; what is below 0 was cut off."""
    g = torch.Generator().manual_seed(0)
    rgb, background = 3 * torch.randn(60, 3, generator=g), torch.tensor([[-0.5, 0.2, 1.7]])
    signed = rgb.clone().requires_grad_()
    image = stand_in(sh_degree=None, colors=signed, backgrounds=background)[0]
    above, below = rgb.clamp_min(0).requires_grad_(), (-rgb).clamp_min(0)
    lit, alpha, _ = stand_in(sh_degree=None, colors=above)
    unlit = stand_in(sh_degree=None, colors=below)[0]
    assert torch.allclose(image, lit - unlit + (1 - alpha) * background, atol=1e-5)
    image.square().sum().backward()
    (lit * image.detach() * 2).sum().backward()
    assert torch.allclose(signed.grad, above.grad, rtol=1e-4, atol=1e-4)


def test_backgrounds_have_a_gradient_and_gsplats_own_defaults_are_drawn():
    background = torch.rand(1, 3, generator=torch.Generator().manual_seed(0)).requires_grad_()
    image, alpha, _ = stand_in(backgrounds=background)
    assert torch.equal(image, stand_in(backgrounds=background.detach())[0])
    image.sum().backward()
    assert torch.allclose(background.grad, (1 - alpha).sum().expand(1, 3))
    given = inspect.signature(pytest.importorskip("gsplat").rasterization).parameters
    defaults = {name: p.default for name, p in given.items() if p.default is not p.empty and name != "sh_degree"}
    assert stand_in(**defaults)[0].shape == (1, 30, 40, 3)


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


def test_gsplats_arguments_have_gsplats_order():
    names = [
        list(inspect.signature(f).parameters)
        for f in (pytest.importorskip("gsplat").rasterization, rasterizers.rasterization)
    ]
    assert names[0][: names[1].index("backend")] == names[1][: names[1].index("backend")]


def test_gsplats_strategy_reads_the_packed_info():
    """Of two cameras, one of which sees a part of the scene."""
    strategies = pytest.importorskip("gsplat").strategy
    first = camera(40, 30).world_to_camera.float()
    aside = first.clone()
    aside[0, 3] += 3
    viewmats = torch.stack((first, aside))
    infos, states = [], []
    for packed in (False, True):
        splats = replace(leaves(scene(60)), rgb_offset=None)
        strategy = strategies.DefaultStrategy(verbose=False)
        params, state = {"means": splats.means}, strategy.initialize_state()
        Ks = intrinsics(camera(40, 30)).float().expand(2, 3, 3)
        images, _, info = stand_in(splats, packed=packed, viewmats=viewmats, Ks=Ks)
        strategy.step_pre_backward(params, {}, state, 1, info)
        images.square().sum().backward()
        strategy.step_post_backward(params, {}, state, 1, info, packed=packed)
        infos.append(info)
        states.append(state)
    unpacked, packed = infos
    ids = packed["camera_ids"], packed["gaussian_ids"]
    assert 0 < len(ids[0]) < 2 * 60
    assert torch.equal(torch.stack(ids, 1), (unpacked["radii"] > 0).all(-1).nonzero())
    assert torch.equal(packed["means2d"], unpacked["means2d"][ids])
    assert torch.equal(packed["means2d"].grad, unpacked["means2d"].grad[ids])
    assert {name: info.shape[1:] for name, info in packed.items() if torch.is_tensor(info)} == {
        "means2d": (2,), "radii": (2,), "depths": (), "conics": (3,), "opacities": (), "gaussian_ids": (), "camera_ids": (),
        "batch_ids": (),
    }  # fmt: skip
    for name in ("grad2d", "count"):
        assert torch.allclose(states[0][name], states[1][name]), name


@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_packed_ellipses_are_those_of_the_projection_and_have_gradients(rasterize_mode):
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    splats, view = leaves(scene(60, dtype=torch.float64)), camera(40, 30)
    info = stand_in(splats, packed=True, rasterize_mode=rasterize_mode)[2]
    i, pose = info["gaussian_ids"], view.world_to_camera.double()[None]
    covariances, _ = torch_impl._quat_scale_to_covar_preci(splats.quats, splats.scales, True, False)
    radii, means2d, depths, conics, compensations = torch_impl._fully_fused_projection(
        splats.means, covariances, pose, intrinsics(view).double()[None], 40, 30, calc_compensations=True
    )
    factor = compensations[0, i] if rasterize_mode == "antialiased" else 1
    expected = {"means2d": means2d[0, i], "depths": depths[0, i], "conics": conics[0, i]}
    expected["opacities"] = splats.opacities[i] * factor
    for name, value in expected.items():
        assert torch.allclose(info[name], value, rtol=1e-6), name
    assert (info["radii"] <= radii[0, i] + 1).all()  # they reach as far as the opacity lets them
    gradients = [
        torch.autograd.grad(x.sum(), splats.means)
        for x in (info["depths"] * info["conics"].sum(-1), (depths * conics.sum(-1))[0, i])
    ]
    assert torch.allclose(*(g for (g,) in gradients), rtol=1e-6)


def stand_in(s=None, **arguments):
    """Splats, of the same 60 Gaussians unless given, by gsplat's arguments."""
    s, view = s or scene(60), camera(40, 30)
    given = {
        "means": s.means, "quats": s.quats, "scales": s.scales, "opacities": s.opacities,
        "colors": torch.cat((s.sh0, s.shN), 1), "sh_degree": 1, "backend": "torch",
        "viewmats": view.world_to_camera.to(s.means)[None], "Ks": intrinsics(view).to(s.means)[None], "width": 40, "height": 30,
    }  # fmt: skip
    return autograd.rasterization(**given | arguments)
