"""What is left out: only what its setting says, said in the work_log, and harmless where nothing is settled."""

import weakref
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from clear_strategies import SVS, Conductor, Objective, Strategy
from clear_strategies.core import images
from clear_strategies.merging.skips import PLATEAU_LOSS, Plateau, SkipPolicy, Skips
from clear_strategies.schedules import Ramp, WarmupDecay, scaled
from clear_strategies.training.evaluation import loss_of_views
from clear_strategies.training.loop import fit, iterate
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, start


def loss_rows(*losses: float, lambda_hr: float = 0.0) -> list[dict[str, float]]:
    return [{"t": float(t), "lambda_hr": lambda_hr, PLATEAU_LOSS: loss} for t, loss in enumerate(losses, 1)]


def test_by_default_and_of_photos_that_sr_does_not_enlarge_nothing_is_left_out_and_milestones_stretch():
    view = toy.scene().train[0]
    assert SkipPolicy().view(view, 1) is view
    assert not Plateau(Skips(), 3).measurements
    conductor, same = Conductor(skips=Skips(coarse_until=10)), replace(view, hr=view.lr)
    assert conductor.skips.view(same, 1) is same
    assert conductor.lr_due(same, True)
    assert not conductor.work_log.entries
    short = scaled(Skips(coarse_until=3_000), 0.1)
    assert (short.coarse_until, short.plateau_from, short.plateau_window, short.plateau_to) == (300, 500, 50, 800)


def test_hr_is_left_out_in_all_but_one_of_so_many_iterations_until_coarse_until():
    always = Objective(lambda_hr=WarmupDecay(start=0, full=0))
    conductor = Conductor(objective=always, skips=Skips(coarse_until=8, hr_every=3))
    assert [t for t in range(1, 13) if not conductor.wants_hr(t, scored=False)] == [2, 3, 5, 6, 8]
    assert conductor.work_log.entries["render LR + HR"].skipped == {"HR in one of 3 iterations (skips.hr_every)": 5}
    assert all(conductor.wants_hr(t) and Conductor(objective=always).wants_hr(t, scored=False) for t in range(1, 5))
    state = start(("gco",))
    state.conductor.skips = SkipPolicy(Skips(coarse_until=ITERATIONS, hr_every=2))
    for _ in range(ITERATIONS):
        iterate(state, toy.RASTERIZER)
    compared = [int(row["t"]) for row in state.history_as_floats() if "loss_base" in row]
    used = [t for t in range(1, ITERATIONS + 1) if state.conductor.objective.lambda_hr(t) > 0]
    assert compared == [t for t in used if t % 2 == 1 or state.density.collects(t)]
    assert 0 < len(used) - len(compared) < len(used) // 2


def test_the_coarse_reference_is_the_mean_of_blocks_seen_by_the_scaled_camera():
    view, skip_policy = toy.scene().train[0], SkipPolicy(Skips(coarse_until=10))
    coarse = skip_policy.view(view, 10)
    assert coarse.factor == view.factor // 2
    assert torch.equal(coarse.hr.image, images.downsample(view.hr.image, 2, "area"))
    assert coarse.hr.camera.fx == view.hr.camera.fx / 2
    assert coarse.lr is view.lr
    assert skip_policy.view(view, 9) is coarse
    another = replace(view, hr=replace(view.hr, image=1 - view.hr.image))  # of its name, e.g. in the next run
    assert torch.equal(skip_policy.view(another, 9).hr.image, another.hr.reduced(2).image)
    coarse = skip_policy.view(view, 9)
    assert skip_policy.view(view, 11) is view
    freed = weakref.ref(coarse.hr.image)
    del coarse
    assert freed() is None


def test_a_skip_that_cannot_act_is_logged_and_not_in_the_plan(caplog):
    caplog.set_level("DEBUG")
    view, skips = toy.scene().train[0], Skips(coarse_until=10, plateau_gain=0.01)
    half, rest, window = SkipPolicy(replace(skips, hr_every=2)).descriptions([view])
    assert half == "HR at half its size until iteration 10"
    assert rest == "HR in one of 2 iterations until iteration 10, and in each whose scores densification reads"
    assert "by less than 1.0% in 500 iterations" in window
    assert not caplog.records
    odd = replace(view, hr=view.hr.reduced(4))  # by a factor of 1
    assert SkipPolicy(skips).descriptions([odd]) == [window]
    caplog.clear()
    assert (
        SkipPolicy(skips).descriptions([view], hr_from=None)
        == SkipPolicy(skips).descriptions([view], hr_from=10)
        == [window]
    )
    assert [record.getMessage() for record in caplog.records] == [
        "skips.coarse_until has no effect: HR takes part after iteration 10 only."
    ]
    faint = SkipPolicy(Skips(undrawn=0.1))
    assert [faint.descriptions([odd], in_host=host) for host in (False, True)] == [
        ["Gaussians too faint to be drawn, once densification has ended"], [],
    ]  # fmt: skip
    assert SkipPolicy(scaled(skips, 0.03)).descriptions([odd] * 10) == []
    logged = {record.getMessage().partition(" ")[0]: record.levelname for record in caplog.records}
    assert logged == {"skips.coarse_until": "WARNING", "skips.plateau_gain": "DEBUG"}  # the latter is every short run's


@pytest.mark.parametrize(("now", "ends"), [(0.99, True), (0.97, False), (1.10, True)])
def test_a_plateau_is_a_window_that_gains_less_than_asked(now, ends):
    plateau = Plateau(Skips(plateau_gain=0.02, plateau_window=6, plateau_from=6), 1)
    assert plateau.reached(loss_rows(*[1.0] * 6, *[now] * 6), 12) is ends


def test_a_plateau_begins_neither_early_nor_between_windows_nor_late():
    plateau = Plateau(Skips(plateau_gain=0.5, plateau_window=6, plateau_from=7, plateau_to=30), 1)
    rows = loss_rows(*[1.0] * 36)
    assert [t for t in range(1, 37) if plateau.reached(rows[:t], t)] == [18, 24]
    assert not plateau.reached([*rows[:8], rows[23]], 24)  # those between were left out


@pytest.mark.parametrize(
    ("iterations", "n_views", "window"), [(10_000, 3, 250), (1_500, 3, 38), (1_000, 10, 60), (300, 6, 36)]
)
def test_a_window_shows_each_view_several_times(iterations, n_views, window):
    """In 8 of 300 iterations six views are seen 1.3 times each, and their loss rises and falls by chance."""
    plateau = Plateau(scaled(Skips(plateau_gain=0.01, plateau_window=250), iterations / 10_000), n_views)
    rows, measured = loss_rows(*[1.0] * iterations), [*plateau.measurements]
    assert measured == [t for t in range(0, iterations, window) if 0.5 * iterations <= t < 0.8 * iterations]
    assert [t for t in range(1, iterations + 1) if plateau.reached(rows[:t], t)] == measured[1:]
    assert not replace(plateau, n_views=iterations // 6).measurements


@pytest.mark.parametrize("peak", [0.0, 1.0])
def test_the_loss_that_tells_a_plateau_is_of_every_gaussian_and_view(peak):
    objective = Objective(lambda_hr=WarmupDecay(peak=peak, final=peak, start=0, full=0))
    thinned = Conductor(SVS(Ramp(0.9, "constant"), looks=0), objective=objective)
    losses = []
    for conductor in (thinned, Conductor(objective=objective)):
        state = start(())
        state.conductor = conductor
        conductor.on_fit_start(len(state.views), 0)
        of_views = loss_of_views(state, toy.RASTERIZER)
        iterate(state, toy.RASTERIZER)
        losses.append((of_views, state.history_as_floats()[-1]["loss_lr"]))
    (whole, with_dropout), (same, without) = losses
    assert whole == same
    assert with_dropout != without
    views = toy.scene(16, train=6).train
    *of_each, of_all = (loss_of_views(replace(state, views=some), toy.RASTERIZER) for some in (*zip(views), views))
    assert of_all == pytest.approx(sum(of_each) / 6, rel=1e-6)


def test_what_raises_the_measured_loss_is_no_plateau(monkeypatch):
    """HR begins after t = 8 and is whole after t = 10; at t = 12 the structure changes and opacities are lowered."""
    monkeypatch.setattr("clear_strategies.merging.skips._LOOKS", 0)
    state = start(())
    state.density.settings = replace(state.density.settings, start=11)
    hr = WarmupDecay(start=8, full=9, decay_from=14, end=ITERATIONS)
    state.conductor = Conductor(objective=Objective(lambda_hr=hr))
    state.conductor.skips = SkipPolicy(
        Skips(coarse_until=10, plateau_gain=1e-9, plateau_window=1, plateau_from=7, plateau_to=14)
    )
    fit(state, toy.scene(), toy.RASTERIZER)
    assert [int(row["t"]) for row in state.history if PLATEAU_LOSS in row] == [7, 8, 9, 10, 11, 13]
    assert len(state.history) == ITERATIONS
    plateau = Plateau(Skips(coarse_until=6, plateau_gain=0.5, plateau_window=4, plateau_from=4), 1)
    rises = [1.0] * 7 + [2.0]
    lr, hr = loss_rows(*rises), loss_rows(*rises, lambda_hr=1.0)
    assert plateau.reached(lr, 8)
    assert not plateau.reached([*lr[:7], hr[7]], 8)  # HR sets in
    assert not plateau.reached(hr, 8)  # HR becomes whole
    assert Plateau(replace(plateau.skips, coarse_until=0), 1).reached(hr, 8)


def test_a_plateau_is_left_out_and_the_run_has_its_end(caplog, monkeypatch):
    monkeypatch.setattr("clear_strategies.merging.skips._LOOKS", 0)
    state = start(("gco",))
    state.density.settings = replace(state.density.settings, stop=0)  # a change of structure is no plateau
    state.conductor.skips = SkipPolicy(Skips(plateau_gain=0.99, plateau_window=2, plateau_from=6, plateau_to=17))
    with caplog.at_level("DEBUG"):
        fit(state, toy.scene(), toy.RASTERIZER)
    assert [int(row["t"]) for row in state.history] == [*range(1, 9), 18, 19, 20]
    assert state.optimizer.steps == ITERATIONS  # so the learning rates are those of the end
    assert "to 18, since the loss of the training views falls by less than" in caplog.text
    assert sum(state.conductor.work_log.entries["iterations"].skipped.values()) == 9


def test_one_render_serves_both_scales_while_they_have_one_size():
    state = start(("gco", "p2g"))
    state.conductor.skips = SkipPolicy(Skips(coarse_until=12))
    state.views = [replace(view, hr=view.hr.reduced(2), truth=None) for view in state.views]  # SR by two
    assert not state.field.detail.any()  # so that both scales have one image
    view, objective = state.conductor.skips.view(state.views[0], 5), Objective(lambda_hr=WarmupDecay(start=0, full=1))
    lr, hr = state.field.render_scales(toy.RASTERIZER, view)
    of_one, of_two = (Conductor(objective=objective).update(state.field.raw(), low, hr, view, 5) for low in (None, lr))
    assert of_one.losses == of_two.losses
    for name, expected in of_two.grads.items():
        torch.testing.assert_close(of_one.grads[name], expected)
    fit(state, toy.scene(), toy.RASTERIZER)
    skipped = state.conductor.work_log.entries["render LR"].skipped
    assert skipped == {"HR at half its size is as large (skips.coarse_until)": 11}  # not at t = 1, where λ_HR = 0


def faint(state, share: float):
    """Lower the opacity of so many Gaussians below what a view draws; returns the others' rows."""
    n = len(state.field)
    rows = torch.randperm(n, generator=torch.Generator().manual_seed(1))[: round(share * n)]
    state.field.opacities.data[rows] = -6.3  # 0.0018, less than half of 1/255
    return torch.tensor([i for i in range(n) if i not in rows])


def settled(*names: str, undrawn: float = 0.05, more=()):
    state = start(names, more=more or ([] if "svs" in names else [SVS(Ramp(0.2, "constant"), looks=0)]))
    state.conductor.skips = SkipPolicy(Skips(undrawn=undrawn))
    for _ in range(13):
        iterate(state, toy.RASTERIZER)
    assert state.density.settled(state.t)
    assert state.filter_due()
    return state


def test_gaussians_that_no_view_draws_are_removed_and_the_pictures_stay():
    state = settled("gco", "p2g")
    kept, before, n = faint(state, 0.4), state.field.baked(), len(state.field)
    density = state.density.state_dict()
    views = [view.hr.camera for view in state.views]
    state.refilter()  # as `remove_undrawn` does
    pictures = [state.field.render(toy.RASTERIZER, camera) for camera in views]
    moments = {name: x[kept] for name, x in state.optimizer.first.items()}
    assert state.remove_undrawn()
    assert state.conductor.work_log.entries["Gaussians"].skipped == {
        "too faint to be drawn (skips.undrawn)": n - len(kept)
    }
    for camera, picture in zip(views, pictures, strict=True):
        assert torch.equal(state.field.render(toy.RASTERIZER, camera), picture)
    assert torch.equal(state.field.baked().means, before.means[kept])
    assert all(torch.equal(state.optimizer.first[name], x) for name, x in moments.items())
    assert all(torch.equal(x, density[name][kept]) for name, x in state.density.state_dict().items())
    assert not state.remove_undrawn()  # all are drawn
    saved, resumed = state.checkpoint({}), settled("gco", "p2g")
    resumed.restore(saved, Path("its checkpoint"))
    for s in (state, resumed):
        while not s.ended:
            iterate(s, toy.RASTERIZER)
    assert len(state.field) == len(kept)
    for name, x in state.checkpoint({}).tensors.items():
        assert torch.equal(x, resumed.checkpoint({}).tensors[name]), name


class Counts(Strategy):
    """Counts how often it is asked for a gradient."""

    def regularize(self, params, t):
        self.cache["asked"] = self.cache.get("asked", 0) + 1
        return {"means": 1e-3 * params["means"]}


def test_a_strategy_whose_gradient_keeps_them_is_asked_once_in_an_iteration():
    state = settled(more=[Counts(), SVS(Ramp(0.2, "constant"), looks=0)])
    faint(state, 0.4)
    n, counts = len(state.field), state.conductor.strategies[0]
    before = counts.cache["asked"]
    iterate(state, toy.RASTERIZER)
    assert (counts.cache["asked"], len(state.field)) == (before + 1, n)


def test_they_stay_while_the_structure_changes_or_where_they_may_return():
    early = start(("gco",))
    early.conductor.skips = SkipPolicy(Skips(undrawn=0.05))
    anchored, few, off = settled("svs"), settled("gco", undrawn=0.5), settled("gco", undrawn=0.0)
    assert anchored.conductor.pulls(anchored.field.raw(), anchored.t)
    for state in (early, anchored, few, off):
        faint(state, 0.4)
        assert not state.remove_undrawn()
        assert "Gaussians" not in state.conductor.work_log.entries
    faint(off, 1.0)
    off.conductor.skips = SkipPolicy(Skips(undrawn=0.05))
    assert not off.remove_undrawn()  # something has to be left
