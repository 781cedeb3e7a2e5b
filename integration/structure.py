"""A host's changes of structure, as the strategies hear of them."""

from __future__ import annotations

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.step import Step
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor


def is_same(parents: Int[Tensor, " M"], n: int) -> bool:
    """Whether the M rows are the N rows that they come from, in the same order."""
    return len(parents) == n and bool((parents == torch.arange(n, device=parents.device)).all())


def composed(parents: Int[Tensor, " M"], earlier: Int[Tensor, " N"]) -> Int[Tensor, " M"]:
    """What rows that come from `parents` come from, where these come from `earlier`; -1, no row, stays."""
    return torch.where(parents < 0, -1, earlier[parents.clamp_min(0)]) if len(earlier) else parents


def resized(
    conductor: Conductor, step: Step | None, before: int, now: int, parents: Int[Tensor, " M"] | None, remedy: str
) -> Step | None:  # fmt: skip
    """Gather what the strategies store per Gaussian; returns the step with the rows of now.

    Args:
        step: holds numbers per Gaussian, too. parents, remedy: see `Attachment`.
        before, now: the numbers of the host's Gaussians.

    Raises:
        HostError: something is stored of each Gaussian, but it is unknown where new ones come from.
    """
    state = ", ".join(name for name, rows in conductor.state_dict().items() if rows.dim() > 0)
    if parents is None:
        if state:
            # SVS raises an AnchorError here, which says more: the anchor's iteration, and the setting to change.
            conductor.on_resize(torch.zeros(now, dtype=torch.long))
            raise HostError(
                f"the number of Gaussians changed from {before:,} to {now:,} and the host does not say which came from "
                f"which, but {state} is stored per Gaussian. End densification first, or pass the host's state."
            )
        return None if step is None else Step(step.t, step.view)  # what it holds per Gaussian cannot be gathered
    if len(parents) != now:
        raise HostError(f"the host says of {len(parents):,} Gaussians which they come from, but has {now:,}.")
    if (unknown := int((parents < 0).sum())) and state:
        raise HostError(
            f"{unknown:,} new Gaussians come from no other, but {state} is stored of each Gaussian. {remedy}"
        )
    parents = parents.clamp_min(0)
    conductor.on_resize(parents)
    return None if step is None else step.resized(parents)
