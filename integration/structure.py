"""A host's changes of structure, as the strategies are told of them, and rows that are found by their values."""

from __future__ import annotations

from typing import Final

import torch
from jaxtyping import Float, Int
from torch import Tensor

from clear_strategies.core.step import Step
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor

_HASH_FACTOR: Final = 0x2545F4914F6CDD1D


def is_same(parents: Int[Tensor, " M"], n: int) -> bool:
    """Return True if the M rows are the N rows that they come from, in the same order."""
    return len(parents) == n and bool((parents == torch.arange(n, device=parents.device)).all())


def composed(parents: Int[Tensor, " M"], earlier: Int[Tensor, " N"]) -> Int[Tensor, " M"]:
    """The parents of two changes of structure, `earlier` and then `parents`; -1, no parent, stays."""
    return torch.where(parents < 0, -1, earlier[parents.clamp_min(0)]) if len(earlier) else parents


def resized(
    conductor: Conductor, step: Step | None, before: int, now: int, parents: Int[Tensor, " M"] | None, remedy: str
) -> Step | None:  # fmt: skip
    """Gather what the strategies store per Gaussian; returns the step with its rows gathered, too.

    Args:
        before, now: the host's number of Gaussians before and after the change.
        parents, remedy: see `Host`.

    Raises:
        HostError: strategies store something per Gaussian, but it is unknown which Gaussian a new one comes from.
    """
    state = ", ".join(name for name, rows in conductor.state_dict().items() if rows.dim() > 0)
    if parents is None:
        if state:
            # SVS raises an AnchorError here, which says more: the anchor's iteration, and the setting to change.
            conductor.on_resize(torch.zeros(now, dtype=torch.long, device="cpu"))
            raise HostError(
                f"the number of Gaussians changed from {before:,} to {now:,} and the host does not say which came from "
                f"which, but {state} is stored per Gaussian. End densification first, or pass the host's state."
            )
        return None if step is None else Step(step.t, step.view)  # its rows cannot be gathered
    if len(parents) != now:
        raise HostError(f"the host says of {len(parents):,} Gaussians which they come from, but has {now:,}.")
    if now and int(parents.max()) >= before:
        raise HostError(
            f"the host says that a Gaussian comes from row {int(parents.max()):,}, but had {before:,} rows from 0."
        )
    if (unknown := int((parents < 0).sum())) and state:
        raise HostError(
            f"{unknown:,} new Gaussians come from no other, but {state} is stored of each Gaussian. {remedy}"
        )
    parents = parents.clamp_min(0)
    conductor.on_resize(parents)
    return None if step is None else step.resized(parents)


def rows_drawn(means: Float[Tensor, "*B M 3"], own: Float[Tensor, "N 3"]) -> Int[Tensor, "*B M"] | None:
    """For each Gaussian that a loop draws, the row of the parameter with the same position; -1: there is none. None: the rows are
    those of the parameters, in the same order, or the loop has moved the whole scene.

    Args:
        means: the rasterizer's positions; leading dimensions are scenes.
        own: the positions among the parameters.
    """
    is_alike = means.shape == own.shape
    if is_alike and means.data_ptr() == own.data_ptr():
        return None
    drawn, known = means.double().reshape(-1, 3), own.double()  # which holds every other type
    if is_alike and torch.equal(drawn, known):
        return None
    rows, _ = first_equal(bits(known), bits(drawn))
    return None if is_alike and bool((rows < 0).all()) else rows.view(means.shape[:-1])


def bits(rows: Float[Tensor, "N ..."]) -> Int[Tensor, "N K"]:
    """Integers that are equal where the rows are equal bit by bit."""
    flat = rows.detach().flatten(1).contiguous()
    return flat.view(torch.int64 if flat.dtype == torch.float64 else torch.int32).long()


def _hash(bits: Int[Tensor, "N K"]) -> Int[Tensor, " N"]:
    h = torch.zeros_like(bits[:, 0])
    for column in bits.unbind(1):
        h = (h ^ column) * _HASH_FACTOR
        h = h ^ (h >> 29)
    return h


def first_equal(
    old: Int[Tensor, "N K"], new: Int[Tensor, "M K"]
) -> tuple[Int[Tensor, " M"], tuple[Tensor, Tensor, Tensor]]:
    """The first old row equal to each new row, or -1.

    Also returns an order of the old rows that groups equal rows, and the begin and end of each new row's group in it.
    """
    wanted, (keys, order) = _hash(new), _hash(old).sort(stable=True)
    begin, end = torch.searchsorted(keys, wanted), torch.searchsorted(keys, wanted, right=True)
    if not len(old):
        return torch.full_like(begin, -1), (order, begin, end)
    parents = order[begin.clamp_max(len(old) - 1)]
    parents[(old[parents] != new).any(1)] = -1
    return parents, (order, begin, end)
