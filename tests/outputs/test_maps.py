"""Maps show what the strategies of a run decide, and making them does not change the run."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import rasterizers
from clear_strategies import GCO, P2G, SVS, Conductor, DepthMap, Grads, Objective, RandomBackground, Strategy, View
from clear_strategies.data.photo_files import read_image
from clear_strategies.data.view_names import file_stems
from clear_strategies.files import Beside
from clear_strategies.kernels.reconcile import products
from clear_strategies.outputs.maps import MAPS, ViewMaps, view_maps, write_maps
from clear_strategies.schedules import WarmupDecay
from clear_strategies.training.loop import iterate
from clear_strategies.training.state import TrainState
from clear_strategies.viewing.look import Painter
from tests.helpers import planes, toy

OBJECTIVE = Objective(lambda_hr=WarmupDecay(start=0, full=1), kernels="torch")
SCENE = toy.scene()
LEFT = (torch.arange(96) < 48)[:, None]
# The left half of the prior is a negative, so that there is something to find.
NEGATIVE = tuple(replace(v, hr=replace(v.hr, image=torch.where(LEFT, 1 - v.hr.image, v.hr.image))) for v in SCENE.train)


def trained(*strategies: Strategy) -> TrainState:
    state = toy.started(*strategies, objective=OBJECTIVE, of=replace(SCENE, train=NEGATIVE), iterations=3)
    for _ in range(3):
        iterate(state, toy.RASTERIZER)
    return state


def drawn_by(state: TrainState, **settings: Any) -> tuple[Painter, Conductor]:
    return Painter(state.field, partial(rasterizers.load, "torch", **settings)), state.conductor


def maps_of(state: TrainState, view: View | None = None, t: int = 1, **settings: Any) -> ViewMaps:
    return view_maps(*drawn_by(state, **settings), view or state.views[0], t)


def written(folder: Path, state: TrainState, views: Sequence[View]) -> dict[str, Any]:
    """The content of maps.json."""
    with Beside() as beside:
        write_maps(folder, file_stems(view.name for view in views), views, *drawn_by(state), 1, beside)
        beside.finish()
    content: dict[str, Any] = json.loads((folder / "maps.json").read_text())
    return content


def everything(state: TrainState) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in state.checkpoint({}).tensors.items()}


def test_making_maps_does_not_change_the_run() -> None:
    strategies = (GCO(), P2G(), SVS(anchor_start=2))
    state = trained(*strategies)
    before, logs = everything(state), [dict(s.logs) for s in strategies]
    caches, entries = [set(s.cache) for s in strategies], dict(state.conductor.work_log.entries)
    for view in state.views:
        maps_of(state, view)
    after = everything(state)
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert [dict(s.logs) for s in strategies] == logs
    assert [set(s.cache) for s in strategies] == caches
    assert state.conductor.work_log.entries == entries


def test_patch_maps_are_p2gs_evidence_enlarged_to_hr_and_conflict_is_the_ratio_that_training_logs() -> None:
    p2g = P2G(patch=8, reliability_scale=0.02)
    state = trained(p2g)
    maps = maps_of(state).maps
    R, A = p2g.patch_evidence(state.views[0].lr.image, state.views[0].hr.image, 4)
    assert maps["reliability"].shape == (64, 96)
    assert maps["reliability"][31, 32] == R[0, 1]  # patches of 32 HR pixels
    assert maps["demand"][32, 95] == A[1, 2]
    assert torch.equal(maps["weight"], maps["reliability"] * maps["demand"])
    state = trained()
    view, found = state.views[0], maps_of(state)
    lr, hr = state.field.render_scales(toy.RASTERIZER, view)
    (g_lr,) = lr.vjp(OBJECTIVE.lr(lr.image, view.lr.image).cotangents)
    g_base, g_hf = hr.vjp(OBJECTIVE.hr(hr.image, view.hr.image).cotangents)
    assert found.means["conflict"] == pytest.approx(
        products(g_lr.without_detail(), g_base + g_hf * 0.2).conflict()["gaussian"]
    )
    assert 0 < found.means["conflict"] < 1


class Halve(Strategy):
    """Every Gaussian loses half of its HR gradient."""

    def correct(self, lr: Grads, hr: Grads, evidence: object) -> Grads:
        return hr * 0.5


def test_corrected_is_the_share_of_the_hr_gradient_that_was_taken_away_over_black_whatever_the_background() -> None:
    state = trained(Halve())
    state.conductor.objective = replace(OBJECTIVE, lambda_hr=WarmupDecay(peak=0, final=0))  # as it may be at the end
    found = maps_of(state)
    assert found.means["corrected"] == pytest.approx(0.5, rel=1e-6)
    # Nowhere more than the number itself, and nearly that where Gaussians cover the pixel.
    assert float(found.maps["corrected"].max()) == pytest.approx(0.5, abs=0.1)
    assert float(found.maps["corrected"].max()) <= 0.5 + 1e-5
    state.field.opacities.data[:] = -4.0  # little is drawn
    found = maps_of(state, background=(1.0, 1.0, 1.0))
    assert found.means["corrected"] == pytest.approx(0.5, rel=1e-6)
    assert 0 < float(found.maps["corrected"].max()) < 0.4


@dataclass(frozen=True)
class ByOpacity(Strategy):
    """Reads the parameters, and answers by a plain mapping."""

    def correct(self, lr, hr, step):
        return {name: g * step.params["opacities"].sigmoid().view(-1, *[1] * (g.dim() - 1)) for name, g in hr.items()}


def test_maps_ask_a_strategy_as_training_does() -> None:
    means = maps_of(trained(ByOpacity())).means
    assert 0.1 < means["corrected"] < 0.99


def test_maps_show_what_a_strategy_corrects_at_the_end_of_the_run() -> None:
    class Late(GCO):
        def correct(self, lr, hr, step=None):
            return Grads(hr) if step.t < 2 else Grads(hr) * 0.0

    state = trained(Late())
    assert [maps_of(state, t=t).means["corrected"] for t in (1, 2)] == pytest.approx([0, 1])


def test_maps_of_transparent_photos_compare_them_before_the_background_that_is_drawn() -> None:
    state = trained(GCO(), RandomBackground(until=9_000))
    view = state.views[0]
    view = replace(view, hr=replace(view.hr, transparency=torch.ones_like(view.hr.image[..., 0])))
    assert state.conductor.background(1) is not None
    found = maps_of(state, view)
    state.conductor = Conductor(GCO(), objective=OBJECTIVE)
    assert found.means == maps_of(state, view).means


def test_a_folder_of_maps_is_complete(tmp_path: Path) -> None:
    state = trained(GCO(), P2G())
    view = state.views[0]
    content = written(tmp_path, state, state.views[:1])
    assert (content["corrector"], content["evidence"]) == ("GCO", "P2G")
    assert set(content["views"]) == {view.name}
    assert set(content["views"][view.name]) == set(MAPS)
    files = {path.stem: path for path in (tmp_path / view.name).iterdir()}
    assert set(files) == {*MAPS, "maps"}
    for name, values in maps_of(state).maps.items():
        assert float((read_image(files[name])[..., 0] - values).abs().max()) <= 0.5 / 255 + 1e-6


def test_views_with_stereo_show_their_depth_and_maps_that_no_strategy_makes_are_missing(tmp_path: Path, caplog) -> None:
    caplog.set_level("DEBUG")
    state = trained()
    shape = state.views[0].lr.image.shape[:2]
    depth = torch.rand(shape) + 1
    depth[0] = torch.nan
    some = DepthMap(depth, depth.isfinite().float() * 0.5)
    maps = (some, planes.depth_of(state.views[0].lr, torch.nan), None)
    views = [replace(state.views[0], name=str(i), depth=found) for i, found in enumerate(maps)]
    content = written(tmp_path, state, views)
    assert (content["corrector"], content["evidence"]) == (None, None)
    assert "no strategy of this run corrects" in caplog.text
    for view in views:
        assert set(content["views"][view.name]) == {"conflict"}
        assert {path.stem for path in (tmp_path / view.name).iterdir()} == {"conflict", "maps"}
    found, none, without = (read_image(tmp_path / name / "maps.jpg") for name in "012")
    assert found.shape == none.shape  # with two panels more than there are without stereo
    assert found.numel() > 1.3 * without.numel()
