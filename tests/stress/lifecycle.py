"""A training run as a state machine: Hypothesis steps, densifies, prunes, resets, saves, resumes and damages it in any order.

`Lifecycle` holds the rules and what must be true after each of them; `measure` runs it, and counts.
"""

import math
import shutil
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from clear_strategies import SVS
from clear_strategies.errors import DensityError, DivergedError
from clear_strategies.training import checkpoint
from clear_strategies.training.field import LOG_SCALE_LIMIT, LOGIT_LIMIT
from clear_strategies.training.loop import iterate, view_at
from clear_strategies.training.state import TrainState
from tests.helpers import toy
from tests.helpers.short_run import ITERATIONS, SUBSETS, start, tensors
from tests.stress.rows import Row

_NOT_FINITE = st.sampled_from([math.nan, math.inf, -math.inf])
_SHARES = st.floats(0.0, 0.9)


class Lifecycle(RuleBasedStateMachine):
    """One run. Structure changes by the schedule, and by the rules wherever the strategies allow it."""

    rules_run = 0

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp())

    def teardown(self) -> None:
        shutil.rmtree(self.folder)

    @initialize(names=st.sampled_from(SUBSETS), fused=st.sampled_from(["auto", "off"]))
    def begin(self, names, fused) -> None:
        self.names, self.fused = names, fused
        self.state = self._fresh()

    def _fresh(self) -> TrainState:
        return start(self.names, 10 * ITERATIONS, fused=self.fused)

    @property
    def svs(self) -> SVS | None:
        return next((s for s in self.state.conductor.strategies if isinstance(s, SVS)), None)

    def may_change(self) -> bool:
        return self.state.conductor.may_densify(self.state.t)

    @rule(iterations=st.integers(1, 4))
    def step(self, iterations) -> None:
        for _ in range(iterations):
            done, svs = self.state.t, self.svs
            iterate(self.state, toy.RASTERIZER)
            if svs is not None and done == svs.anchor_start:
                for name, rows in svs.state.items():
                    assert torch.equal(rows, self.state.field.raw()[name]), f"the anchor of {name} is not the field"

    @rule()
    def ask_for_the_mask(self) -> None:
        before = self.state.field.opacities.data.clone()
        n, t = len(self.state.field), self.state.t
        first, second = (self.state.conductor.gate(t, n) for _ in range(2))
        assert (first is None) == (second is None)
        if first is not None and second is not None:
            assert torch.equal(first, second), "both scales of an iteration share one mask"
            assert len(first[first > 0].unique()) <= 1
        assert torch.equal(self.state.field.opacities.data, before)

    @precondition(lambda self: self.may_change())
    @rule(share=_SHARES, large=_SHARES, seed=st.integers(0, 99))
    def densify(self, share, large, seed) -> None:
        s, g = self.state, torch.Generator().manual_seed(seed)
        n = len(s.field)
        s.density.score[:] = (torch.rand(n, generator=g) < share).float()
        s.density.ordinary[:], s.density.count[:] = s.density.score, 1
        s.field.scales.data[torch.rand(n, generator=g) < large] = -0.7
        self._restructure()

    @precondition(lambda self: self.may_change() and len(self.state.field) > 4)
    @rule(share=_SHARES, seed=st.integers(0, 99))
    def prune(self, share, seed) -> None:
        field = self.state.field
        faint = torch.rand(len(field), generator=torch.Generator().manual_seed(seed)) < share
        faint[:4] = False
        field.opacities.data[:4] = 0.0
        field.scales.data[:4] = field.scales.data[:4].clamp_max(-2.0)
        field.opacities.data[faint] = -LOGIT_LIMIT
        gone = faint.nonzero()[:, 0].tolist()
        self.state.density.score.zero_()
        self.state.density.ordinary.zero_()
        parents = self._restructure()
        assert not set(gone) & set(parents.tolist()), "a faint Gaussian stayed"

    def _restructure(self) -> torch.Tensor:
        s, before = self.state, self.state.field.detail.data.clone()
        parents = s.density.restructure(s.field, s.optimizer, s.t)
        s.resized(parents)
        assert torch.equal(s.field.detail.data, before[parents]), "rows left their Gaussian"
        return parents

    @precondition(lambda self: self.may_change())
    @rule()
    def prune_all(self) -> None:
        kept = self.state.field.opacities.data.clone()
        self.state.field.opacities.data.fill_(-LOGIT_LIMIT)
        before = tensors(self.state)
        with pytest.raises(DensityError, match="fewer than min_gaussians"):
            self.state.density.restructure(self.state.field, self.state.optimizer, self.state.t)
        _require_same(before, tensors(self.state))
        self.state.field.opacities.data[:] = kept

    @rule()
    def reset_opacity(self) -> None:
        self.state.density.reset_opacity(self.state.field, self.state.optimizer)
        assert float(self.state.field.filtered_opacities().max()) <= 0.01 + 1e-6

    @rule()
    def save_and_resume(self) -> None:
        """Both runs go on alike, and it is the resumed one that the machine keeps."""
        path = checkpoint.save(self.folder, self.state.checkpoint({"names": list(self.names)}), keep=2)
        resumed = self._fresh()
        resumed.restore(checkpoint.load(path), path)
        _require_same(tensors(self.state), tensors(resumed))
        for state in (self.state, resumed):
            iterate(state, toy.RASTERIZER)
        _require_same(tensors(self.state), tensors(resumed))
        self.state = resumed

    @rule(scale=st.sampled_from(["lr", "hr"]), row=st.integers(0, 15), column=st.integers(0, 23), value=_NOT_FINITE)
    def damage_a_photo(self, scale, row, column, value) -> None:
        view, before = view_at(self.state), tensors(self.state)
        image = getattr(view, scale).image
        good = image[row, column].clone()
        image[row, column] = value
        try:
            if scale == "hr" and not self.state.conductor.wants_hr(self.state.t):
                return
            with pytest.raises(DivergedError, match=view.name):
                iterate(self.state, toy.RASTERIZER)
        finally:
            image[row, column] = good
        _require_same(before, tensors(self.state))

    @rule(part=st.sampled_from(["field", "first", "second"]), at=st.integers(0, 6), value=_NOT_FINITE)
    def damage_a_number(self, part, at, value) -> None:
        """Nothing that holds it is saved, or densified by."""
        s = self.state
        table = s.field.raw() if part == "field" else getattr(s.optimizer, part)
        name = list(table)[at]
        good = table[name][0].clone()
        table[name][0] = value
        with pytest.raises(DivergedError, match=f"{name} is not finite"):
            s.checkpoint({})
        if part == "field":
            with pytest.raises(DivergedError, match=name):
                s.density.restructure(s.field, s.optimizer, s.t)
        table[name][0] = good

    @invariant()
    def holds(self) -> None:
        type(self).rules_run += 1
        if not hasattr(self, "state"):
            return
        s = self.state
        n, per_row = len(s.field), {**s.field.raw(), "filter_3d": s.field.filter_3d}
        per_row |= {f"first moment of {name}": x for name, x in s.optimizer.first.items()}
        per_row |= {f"second moment of {name}": x for name, x in s.optimizer.second.items()}
        per_row |= {name: getattr(s.density, name) for name in ("score", "ordinary", "count")}
        per_row |= s.conductor.state_dict()
        for name, x in per_row.items():
            assert len(x) == n, f"{name} has {len(x)} rows of {n}"
            assert bool(x.isfinite().all()), f"{name} is not finite"
        limits = s.density.settings
        assert limits.min_gaussians <= n <= limits.max_gaussians
        assert float(s.field.opacities.data.abs().max()) <= LOGIT_LIMIT
        assert float(s.field.scales.data.abs().max()) <= LOG_SCALE_LIMIT
        assert all(float(x.min()) >= 0 for x in s.optimizer.second.values())
        assert s.optimizer.steps == s.t - 1 == len(s.history)
        if self.svs is not None:
            assert bool(self.svs.state) == (s.t > self.svs.anchor_start)


def _require_same(before: dict[str, torch.Tensor], now: dict[str, torch.Tensor]) -> None:
    assert before.keys() == now.keys()
    changed = [name for name in before if not torch.equal(before[name], now[name])]
    assert not changed, f"changed: {changed}"


def measure(examples: int, *, steps: int = 30) -> Row:
    """Random runs of up to `steps` rules each."""
    Lifecycle.rules_run = 0
    failure = "none"
    try:
        run_state_machine_as_test(
            Lifecycle,
            settings=settings(
                max_examples=examples, stateful_step_count=steps, deadline=None, database=None, print_blob=False,
                phases=(Phase.generate,), suppress_health_check=list(HealthCheck), derandomize=True,
            ),
        )  # fmt: skip
    except (Exception, pytest.fail.Exception) as error:
        failure = f"{type(error).__name__}: {error}".split("\n")[0][:120]
    return Row(
        "lifecycle in random order: an invariant does not hold", "cpu", Lifecycle.rules_run, float(failure != "none"),
        0, failure,
    )  # fmt: skip
