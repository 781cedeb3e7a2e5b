"""Which Gaussian came from which in a GaussianModel, and the proxy of one that changes opacities and colours once."""

from types import SimpleNamespace

import pytest
import torch

from integration.inria.cameras import enlarged_camera
from integration.inria.model_proxy import Overrides, proxy
from integration.inria.rows import CarriedRows, find_change
from rasterizers.geometry import SH_C0
from tests.helpers import toy
from tests.helpers.host_parts import N, loop, options

ROWS = torch.arange(N)


@pytest.fixture
def model(inria_host, inria_capture):
    return inria_host.setup(options(inria_host, inria_capture))[0]


def host_params(model):
    return {"means": model._xyz, "quats": model._rotation, "sh0": model._features_dc}


def rows_of(model):
    return CarriedRows(model, lambda: host_params(model))


def append(model, rows):
    names = ("_xyz", "_features_dc", "_features_rest", "_opacity", "_scaling", "_rotation")
    model.densification_postfix(*(getattr(model, name)[rows].detach() for name in names))


def pruned(*rows):
    return torch.isin(ROWS, torch.tensor(rows))


@torch.no_grad()
def test_of_two_equal_gaussians_the_one_that_the_host_keeps_is_the_parent(model):
    for p in host_params(model).values():
        p[7] = p[3]
    carried, before = rows_of(model), host_params(model)
    model.prune_points(pruned(3))
    assert carried.poll().parents[6] == 7
    assert find_change(before, host_params(model)).parents[6] == 3  # by values alone


@torch.no_grad()
def test_rows_that_moved_after_the_change_are_still_the_old_gaussians(model):
    """As with MCMC's noise: by value every row would be new, and f_det would lose its moments."""
    carried, before = rows_of(model), host_params(model)
    append(model, [5])
    model._xyz += 0.01
    change = carried.poll()
    assert change.parents.tolist() == [*range(N), 5]
    assert change.fresh.nonzero()[:, 0].tolist() == [N]
    assert int(find_change(before, host_params(model)).fresh.sum()) == N + 1


@torch.no_grad()
def test_changes_between_two_polls_are_one_change(model):
    carried = rows_of(model)
    append(model, [2, 4])
    model.prune_points(torch.isin(torch.arange(N + 2), torch.tensor([0, 2, N])))
    append(model, [N - 2])  # the copy of 4
    change = carried.poll()
    assert change.parents.tolist() == [1, *range(3, N), 4, 4]
    assert change.fresh.nonzero()[:, 0].tolist() == [N - 2, N - 1]
    assert carried.poll() is None


@torch.no_grad()
def test_a_new_gaussian_that_is_no_copy_has_no_parent(model):
    """FSGS puts new ones between neighbours, with colours of 0. Keeping every row is no change."""
    carried = rows_of(model)
    model.prune_points(pruned())
    assert carried.poll() is None
    model.densification_postfix(
        model._xyz[:1] + 1, torch.zeros(1, 1, 3), model._features_rest[:1], model._opacity[:1], model._scaling[:1],
        model._rotation[:1],
    )  # fmt: skip
    assert carried.poll().parents.tolist() == [*range(N), -1]


@torch.no_grad()
@pytest.mark.parametrize("also_pruned", [False, True], ids=["elsewhere alone", "elsewhere too"])
def test_a_change_by_another_function_is_found_by_its_values(also_pruned, model, caplog):
    carried = rows_of(model)
    if also_pruned:
        model.prune_points(pruned(0))
    for name in ("_xyz", "_features_dc", "_rotation"):
        setattr(model, name, torch.nn.Parameter(getattr(model, name).detach().flip(0)))
    assert carried.poll().parents.tolist() == [*range(N)][also_pruned:][::-1]
    assert ("found by the values" in caplog.text) == also_pruned


@torch.no_grad()
@pytest.mark.parametrize("also_added", [False, True], ids=["alone", "before others are added"])
def test_a_relocated_gaussian_comes_from_the_one_whose_copy_it_is(also_added, model):
    """3dgs-mcmc writes over the dead rows in place, then makes new parameters of the same memory."""

    def relocate_gs(dead_mask):
        for name in ("_xyz", "_features_dc", "_rotation"):
            p = getattr(model, name)
            p[dead_mask] = p[[5, 2]]
            setattr(model, name, torch.nn.Parameter(p))

    model.relocate_gs = relocate_gs
    carried = rows_of(model)
    model.relocate_gs(dead_mask=pruned(3, 6))
    if also_added:
        for name in ("_features_rest", "_opacity", "_scaling"):
            setattr(model, name, torch.nn.Parameter(getattr(model, name)))
        append(model, [0])
    change = carried.poll()
    assert change.parents.tolist() == [0, 1, 2, 5, 4, 5, 2, *range(7, N), *[0] * also_added]
    assert change.fresh.nonzero()[:, 0].tolist() == [3, 6, *[N] * also_added]


def test_the_loop_reports_the_rows_and_gets_its_methods_back(inria_host, inria_capture, inria_attached):
    recorder = toy.Recorder()
    clear, gaussians, scene = inria_attached(recorder)
    gaussians.optimizer.param_groups[1]["lr"] = 0.0  # colours stay, so that they identify Gaussians
    colors = gaussians._features_dc.detach().clone()
    loop(inria_host, clear, options(inria_host, inria_capture), gaussians, scene)
    assert len(recorder.changes) >= 3
    for parents in recorder.changes:
        colors = colors[parents]
    assert torch.equal(colors, gaussians._features_dc.detach())
    clear.remove()
    assert not {"_prune_optimizer", "cat_tensors_to_optimizer"} & vars(gaussians).keys()


def gaussians(*x, colours=None, rotation=0.0):
    """Gaussians at (x, 0, 0); their colours are x unless given."""
    means = torch.tensor([[value, 0.0, 0.0] for value in x])
    sh0 = torch.tensor([[[value, 0.0, 0.0]] for value in (x if colours is None else colours)])
    return {"means": means, "quats": torch.tensor([[1.0, rotation, 0.0, 0.0]]).repeat(len(x), 1), "sh0": sh0}


def test_clones_splits_and_pruned_gaussians_are_found_by_colour_and_place():
    before = gaussians(1.0, 2.0, 3.0, 4.0)
    assert find_change(before, gaussians(1.0, 2.0, 3.0, 4.0)) is None
    # 2 is pruned, 3 is cloned, 4 is split in two that keep its colour.
    change = find_change(before, gaussians(1.0, 3.0, 3.0, 3.9, 4.2, colours=(1.0, 3.0, 3.0, 4.0, 4.0)))
    assert change.parents.tolist() == [0, 2, 2, 3, 3]
    assert change.fresh.tolist() == [False, False, True, True, True]
    before = gaussians(1.0, 2.0, 3.0, colours=(7.0, 7.0, 7.0))
    change = find_change(before, gaussians(1.0, 2.0, 2.9, 1.2, colours=(7.0, 7.0, 7.0, 7.0)))
    assert change.parents.tolist() == [0, 1, 2, 0]
    assert change.fresh.tolist() == [False, False, True, True]
    assert find_change(gaussians(1.0), gaussians(1.0, 5.0)).parents.tolist() == [0, -1]
    assert find_change(gaussians(1.0), gaussians(1.0, rotation=0.5)).parents.tolist() == [-1]
    empty = {name: tensor[:0] for name, tensor in gaussians(1.0).items()}
    assert find_change(empty, gaussians(1.0)).parents.tolist() == [-1]
    assert find_change(gaussians(1.0), empty).parents.tolist() == []


def test_many_gaussians_of_one_colour_need_no_memory_for_all_their_distances(monkeypatch):
    x = [float(i) for i in range(40)]
    before, after = gaussians(*x, colours=(7.0,) * 40), gaussians(*x, *(i + 0.2 for i in x), colours=(7.0,) * 80)
    sizes, cdist = [], torch.cdist
    monkeypatch.setattr("integration.inria.rows._DISTANCES", 120)
    monkeypatch.setattr(torch, "cdist", lambda a, b: sizes.append(len(a) * len(b)) or cdist(a, b))
    assert find_change(before, after).parents.tolist() == [*range(40), *range(40)]
    assert max(sizes) <= 120


# ---- a proxy of a host's model: opacities and colours are changed once, however the host's getters call each other
class Model:
    """Getters as in Mip-Splatting, where one calls another."""

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

    @property
    def get_features(self):
        return torch.cat((self._features_dc, torch.zeros(N, 3, 3)), 1)


def test_opacities_are_gated_once_and_the_detail_feature_is_added_to_the_constant_band():
    model, z = Model(), torch.arange(N) / N
    overrides = Overrides(gate=z)
    gated = proxy(model, overrides)
    assert isinstance(gated, Model)
    expected = 0.5 * model.get_opacity * z[:, None]
    assert torch.equal(gated.get_opacity_with_3D_filter, expected)
    scales, opacities = gated.get_scaling_n_opacity_with_3D_filter
    assert torch.equal(opacities, expected)
    assert torch.equal(scales, 2 * model.scaling)
    assert overrides.used == {"gate"}
    model = Model()
    difference = proxy(model, Overrides(detail=torch.ones(N, 3))).get_features - model.get_features
    assert torch.allclose(difference[:, 0], torch.full((N, 3), 1 / SH_C0))
    assert bool((difference[:, 1:] == 0).all())
    del model._features_dc
    with pytest.raises(AttributeError, match="'Model' object has no attribute '_features_dc'"):
        _ = proxy(model, Overrides())._features_dc


def test_only_pixel_sizes_of_a_camera_are_enlarged():
    camera = SimpleNamespace(image_width=24, image_height=16, fx=torch.tensor(20.0), FoVx=0.9)
    assert vars(enlarged_camera(camera, 4)) == {"image_width": 96, "image_height": 64, "fx": 80.0, "FoVx": 0.9}
    assert camera.image_width == 24
