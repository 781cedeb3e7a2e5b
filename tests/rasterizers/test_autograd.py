"""Rasterizers as torch functions: gradients of the image, and depth to look at."""

import gc
import threading
import weakref
from dataclasses import fields, replace

import pytest
import torch

import rasterizers
from clear_strategies.geometry.projection import intrinsics
from rasterizers import SplatGradients, Splats, autograd
from rasterizers.ahead import _ahead
from rasterizers.reference import ReferenceRasterizer
from rasterizers.testing import scene
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
def test_what_is_drawn_inside_is_collected_and_ends_alone(inside):
    splats = leaves(scene(20))
    with autograd.collected_drawings() as outer:
        with autograd.collected_drawings() as inner:
            for _ in range(inside):
                drawn_in(splats)
        drawn_in(splats)
    drawn_in(splats)
    assert (len(outer), len(inner)) == (1 + inside, inside)


def test_a_thread_collects_its_own_drawings():
    splats, both, seen = leaves(scene(20)), threading.Barrier(2, timeout=60), []

    def work():
        with autograd.collected_drawings() as drawings:
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


@pytest.mark.parametrize("transform", [torch.func.grad, torch.func.vmap, torch.func.hessian])
def test_a_transform_of_torch_func_is_refused_by_name(transform):
    splats = scene(5)

    def red(shift):
        moved = replace(splats, means=splats.means + shift.sum())
        return autograd.draw(rasterizers.load("auto"), moved, camera(20, 16)).image[..., 0].mean()

    shift = torch.zeros(3)
    assert red(shift) > 0
    with pytest.raises(NotImplementedError, match=r"torch\.func .* do not pass through a rasterizer"):
        transform(red)(shift)


def test_gsplats_function_has_our_rasterizers_gradients_of_the_centres_too():
    view, splats = camera(40, 30), replace(leaves(scene(60, dtype=torch.float64)), rgb_offset=None)
    images, _, info = autograd.rasterization(
        splats.means, splats.quats, splats.scales, splats.opacities, torch.cat((splats.sh0, splats.shN), 1),
        view.world_to_camera.double()[None], intrinsics(view).double()[None], 40, 30, sh_degree=1, backend="torch",
    )  # fmt: skip
    v = torch.randn(1, 30, 40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (images * v).sum().backward()
    expected = rasterizers.load("torch", kernel=0.3, antialiased=False)(splats, view).vjp(v)
    require_gradients(splats, info["means2d"].grad[0], expected)


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
