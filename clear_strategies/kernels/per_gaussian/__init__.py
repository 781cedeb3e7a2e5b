"""What an iteration computes for each Gaussian beside its renderings and its step.

`reference` specifies it in torch. `warp` computes the same on CUDA, in a few kernels where torch launches one for each operation,
and `cpp` on a CPU what torch takes long for; `dispatch` chooses. tests/kernels/test_per_gaussian.py compares.
"""

from clear_strategies.kernels.per_gaussian.reference import (
    accumulate,
    activate,
    evidence,
    evidence_score,
    lift,
    nearest_depths,
    route,
    screens,
    wander,
)  # fmt: skip

__all__ = [
    "accumulate", "activate", "evidence", "evidence_score", "lift", "nearest_depths", "route", "screens", "wander",
]  # fmt: skip
