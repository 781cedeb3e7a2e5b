"""Random numbers from (seed, t)."""

from __future__ import annotations

import pytest
import torch

from clear_strategies.core.seeds import generator_at, hashed_generator_at


@pytest.mark.parametrize("at", [generator_at, hashed_generator_at])
@pytest.mark.parametrize("seed", [0, 20261126014022, 2**63, -1])
def test_any_whole_number_is_a_seed(at, seed):
    first, again, next_t = (torch.rand(4, generator=at(seed, t)) for t in (7, 7, 8))
    assert torch.equal(first, again)
    assert not torch.equal(first, next_t)
