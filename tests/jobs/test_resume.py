"""Resuming a job: what must agree with the run before, and what may differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from clear_strategies.compose import tree
from clear_strategies.errors import DataError
from clear_strategies.jobs import job, resume
from clear_strategies.training.loop import iterate
from clear_strategies.training.signals import Interrupted
from tests.helpers import pictures, toy
from tests.helpers.command_line import TINY
from tests.helpers.configs import composed
from tests.helpers.short_run import start


def compared(*overrides: str):
    return resume.comparable(tree(composed(*overrides)))


def test_resuming_on_another_device_is_logged(caplog):
    state = start(())
    iterate(state, toy.RASTERIZER)
    saved = state.checkpoint({})
    resume.restore(start(()), saved, Path("there"), {})
    assert "bit for bit" not in caplog.text
    resume.restore(start(()), replace(saved, device="cuda"), Path("there"), {})
    assert "this run trained on cuda until now and continues on cpu" in caplog.text


def test_device_threads_and_memory_may_differ_and_defaults_are_compared_too():
    assert compared("fit.device=cpu", "fit.threads=1", "rasterizer.memory=512") == compared()
    assert compared()["fit.seed"] == 0  # a default of the class, which no file gives
    saved = replace(start(()).checkpoint({}), config=compared("density.every=50"))
    with pytest.raises(DataError, match=r"density\.every: 50 then, 100 now"):
        resume.restore(start(()), saved, Path("there"), compared())


def test_ctrl_c_after_training_names_the_checkpoint_that_was_saved(tmp_path: Path, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(job.results, "write_results", stopped)
    with pytest.raises(Interrupted) as told:
        job.run(composed(*TINY, "+strategy=gco", "prior=bicubic", "fit.threads=1", "fit.iterations=3"), tmp_path)
    saved = tmp_path / "checkpoints" / "step_0000004.safetensors"
    assert saved.is_file()
    assert str(told.value) == f"stopped by SIGINT before the run was finished. Go on with fit.resume={saved}."


def test_a_setting_of_density_has_no_effect_beside_a_strategy_that_densifies(tmp_path: Path, caplog):
    for strategy in ("mcmc", "gco"):
        chosen = [
            *TINY,
            f"+strategy={strategy}",
            "prior=bicubic",
            "fit.threads=1",
            "fit.iterations=3",
            "density.every=50",
        ]
        with pictures.not_drawn():
            job.run(composed(*chosen, "fit.scale_schedule=false"), tmp_path / strategy, chosen)
    assert caplog.text.count("density.every=50 has no effect: MCMC densifies in place of it.") == 1
