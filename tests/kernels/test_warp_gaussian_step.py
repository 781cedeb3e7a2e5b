"""The per-Gaussian step in Warp alone. tests/training/test_compiled_step.py compares it with the readable path."""

import pytest
import torch

from clear_strategies import GCO, P2G, SVS
from clear_strategies.merging.logs import computed
from clear_strategies.training.compiled_step import CompiledStep
from clear_strategies.training.optim import Adam, LearningRates
from tests.helpers import toy
from tests.helpers.backends import needs
from tests.helpers.compiled_step_cases import Case, T, as_floats, case, conductors

pytestmark = needs("warp")


@pytest.fixture
def warp_step():
    from clear_strategies.kernels.gaussian_step import warp

    return warp


def started(warp_step) -> tuple[Case, CompiledStep]:
    """A case with all strategies, an anchor that pulls from the second step on, still rows and inactive bands."""
    c = case(1000, degree=2, kind="sparse")
    _, conductor = conductors(GCO, P2G, SVS)
    conductor.after_step(c.fields[1].raw(), toy.step(conductor.strategies[2].anchor_start))
    adam = Adam(c.fields[1].raw(), LearningRates(detail_decay=0.1), 1.0)
    return c, CompiledStep(conductor, adam, passes=warp_step.WarpGaussianStep)


def two_steps(warp_step):
    """Parameters and moments, conflict ratios, logged numbers, and the counts of skipped rows."""
    c, step = started(warp_step)
    conflicts = [as_floats(step.step(c.fields[1].raw(), *c.factors(1), T + i)) for i in range(2)]
    state = [*c.fields[1].raw().values(), *step.optimizer.first.values(), *step.optimizer.second.values()]
    numbers = as_floats(computed(step.conductor.logs.scalars()))
    return state, conflicts, numbers, step.conductor.work_log.entries["optimizer rows"].skipped


@pytest.mark.slow
def test_blocks_of_many_threads_give_the_same_bits(warp_step, whole_blocks):
    """The last block is not full."""
    state, conflicts, readings, skipped = two_steps(warp_step)
    whole_blocks()
    again = two_steps(warp_step)
    assert all(torch.equal(a, b) for a, b in zip(state, again[0], strict=True))
    assert again[1] == conflicts
    assert again[2] == pytest.approx(readings, rel=1e-12)
    assert again[3] == skipped
    assert all(skipped.values())


@pytest.mark.slow
def test_the_kernels_compile_for_cuda_on_a_machine_without(warp_step, ptx_of):
    from clear_strategies.kernels.reconcile import warp as reconcile

    assert "fma.rn.f32" not in ptx_of(reconcile.compare.module, reconcile.LANES)
    assembly = ptx_of(warp_step.passes.step.module, warp_step.LANES)  # the module of all kernels
    assert ".local" not in assembly  # no spills: a thread's numbers are in registers
    assert "fma.rn.f32" not in assembly  # products and sums round as in torch
