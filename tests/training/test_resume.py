"""A resumed run has the same bits as one that never stopped, for every subset of strategies and around every event."""

import json
import logging
import math
import signal
import threading

import pytest
import torch

from clear_strategies.signals import Interrupted
from clear_strategies.training import checkpoint
from clear_strategies.training.clock import WALL
from clear_strategies.training.loop import fit, iterate
from clear_strategies.training.settings import FitSettings
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, SCENE, start, tensors

# Before and after each event of the schedule; where one strategy is alone, around the anchor and a round of density control.
EVERYWHERE, SOME = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 19), (6, 10, 12, 13)


def without_time(history: list[dict[str, float]]) -> str:
    return json.dumps(
        [{k: v for k, v in row.items() if not k.endswith(WALL) and not math.isnan(v)} for row in history],
        sort_keys=True,
    )


STATES = {
    ("gco",): SOME,
    ("gco", "p2g", "svs", "pseudo_views", "fading_opacity", "random_background"): EVERYWHERE,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("names", "cuts"), STATES.items(), ids=["+".join(names) or "none" for names in STATES])
def test_resuming_is_bitwise(names, cuts, tmp_path, caplog):
    whole = start(names)
    saved = {}
    with caplog.at_level(logging.DEBUG):
        for t in range(1, ITERATIONS + 1):
            if t in cuts:
                saved[t] = checkpoint.save(tmp_path / str(t), whole.checkpoint({"names": list(names)}))
            iterate(whole, toy.RASTERIZER)
    _assert_that_everything_happened(whole, names, caplog.text)
    expected, history = tensors(whole), without_time(whole.history)
    for t, path in saved.items():
        resumed = start(names)
        resumed.restore(checkpoint.load(path), path)
        assert resumed.t == t
        while resumed.t <= ITERATIONS:
            iterate(resumed, toy.RASTERIZER)
        found = tensors(resumed)
        assert found.keys() == expected.keys()
        different = [name for name in expected if not torch.equal(found[name], expected[name])]
        assert not different, f"cut before t={t}: {different}"
        assert without_time(resumed.history) == history


def _assert_that_everything_happened(state: TrainState, names: tuple[str, ...], log: str) -> None:
    λ = [row["lambda_hr"] for row in state.history]
    assert λ[2] == 0
    assert 0 < λ[4] < 1
    assert λ[10] == 1
    assert λ[-1] == pytest.approx(0.1)
    assert "t=5:" in log
    assert "t=10:" in log
    assert any(f"{k} split" in log or f"{k} cloned" in log for k in range(1, 30))
    assert any(f"{k} pruned" in log for k in range(1, 30))
    assert state.field.degree == 3
    if "svs" in names:
        assert state.conductor.strategies[names.index("svs")].state["means"].shape[0] == len(state.field)
    if "gco" in names:
        assert any(row.get("corrected", 0) > 0 for row in state.history)
    if "p2g" in names:
        assert any(row.get("mean_q", 0) > 0 for row in state.history)


def test_a_signal_during_the_last_save_ends_a_run_that_is_saved_to_its_end(tmp_path, monkeypatch):
    save = checkpoint.save

    def interrupted(*given, **named):
        signal.raise_signal(signal.SIGTERM)
        return save(*given, **named)

    monkeypatch.setattr(checkpoint, "save", interrupted)
    state = start(())
    state.settings = FitSettings(iterations=3, scale_schedule=False, probe_every=0, checkpoint_every=0)
    with pytest.raises(Interrupted, match="stopped by SIGTERM after the last iteration") as ended:
        fit(state, SCENE, toy.RASTERIZER, checkpoints=tmp_path)
    assert "step_0000004" in str(ended.value)
    assert checkpoint.load(checkpoint.saved(tmp_path)[-1]).t == 4


def test_training_goes_on_while_a_checkpoint_is_written_of_the_state_as_it_was(tmp_path, monkeypatch):
    save, went_on, states = checkpoint.save, threading.Event(), {}

    def slow(folder, saved, **named):
        assert went_on.wait(2)
        return save(folder, saved, **named)

    def progress(s):
        states[s.t] = {name: x.clone() for name, x in s.field.raw().items()}
        if s.t == 5:
            went_on.set()

    monkeypatch.setattr(checkpoint, "save", slow)
    state = start(())
    state.settings = FitSettings(iterations=5, scale_schedule=False, probe_every=0, checkpoint_every=3)
    fit(state, SCENE, toy.RASTERIZER, checkpoints=tmp_path, progress=progress)
    saved = checkpoint.load(tmp_path / "step_0000004.safetensors")
    assert [row["t"] for row in saved.history] == [1, 2, 3]
    assert all(torch.equal(saved.tensors[f"field/{name}"], x) for name, x in states[4].items())


def test_checkpoints_come_where_skips_jump_over_their_iteration(tmp_path, monkeypatch):
    state = start(())
    state.settings = FitSettings(iterations=12, scale_schedule=False, probe_every=0, checkpoint_every=4)
    advance = TrainState.advance

    def jumping(s):
        advance(s)
        s.t += 3 * (s.t == 7)  # from 6 to 10, over 8

    monkeypatch.setattr(TrainState, "advance", jumping)
    fit(state, SCENE, toy.RASTERIZER, checkpoints=tmp_path)
    assert [path.stem for path in checkpoint.saved(tmp_path)] == ["step_0000005", "step_0000011", "step_0000013"]


def test_the_same_seed_is_the_same_run_and_after_a_reset_of_opacities_nobody_looks_at_test_views():
    runs = []
    for seed in (5, 5, 6):
        state = start(("gco", "p2g", "svs"))
        state.settings = FitSettings(iterations=8, scale_schedule=False, probe_every=0, checkpoint_every=0, seed=seed)
        fit(state, SCENE, toy.RASTERIZER)
        runs.append(tensors(state))
    assert all(torch.equal(runs[0][name], runs[1][name]) for name in runs[0])
    assert any(runs[0][n].shape != runs[2][n].shape or not torch.equal(runs[0][n], runs[2][n]) for n in runs[0])
    state = start(())
    state.settings = FitSettings(iterations=13, scale_schedule=False, probe_every=3, checkpoint_every=0, seed=5)
    fit(state, SCENE, toy.RASTERIZER)
    assert [row["t"] for row in state.history if "psnr_test" in row] == [3, 9, 13]  # not 6 and 12
    looks = state.conductor.work_log.entries["probe test views"]
    assert looks.runs == 3
    assert looks.skipped == {"opacities were reset in this iteration": 2}
