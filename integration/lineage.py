"""Which Gaussian came from which, in hosts that do not tell; and f_det where it may not be one of the host's parameters.

Such a host replaces its parameters when it clones, splits or prunes. The replaced ones are as the last step left them,
and every new row is a copy of an old one but for position, size and opacity: comparing both tells the whole change,
whatever functions made it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from clear_strategies.training.optim import LearningRates
from integration.attach import HostError
from rasterizers.geometry import SH_C0

# Split children keep these rows as they are. Opacity is none of them: some hosts correct that of clones.
_INHERITED: Final = ("quats", "sh0")
_COMPARED: Final = ("means", *_INHERITED)
_ODD: Final = 0x2545F4914F6CDD1D


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change of structure.

    Args:
        parents: row i now comes from row parents[i]; -1: from none that can be found.
        fresh: made by this change, a second copy of its parent or a moved one.
    """

    parents: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]


def change(before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> Change | None:
    """Compare the "means", "quats" and "sh0" of N Gaussians with those of M; None: nothing moved.

    Equal rows are the same Gaussian. A row that is not there before comes from the one with the same rotation and colour;
    of several, from the nearest.
    """
    old, new = (torch.cat([_bits(rows[name]) for name in _COMPARED], 1) for rows in (before, after))
    parents, _ = _first_equal(old, new)
    moved = (parents < 0).nonzero()[:, 0]
    if len(moved):
        kin = slice(_bits(before["means"]).shape[1], None)
        parents[moved] = _nearest_kin(old[:, kin], new[moved, kin], before["means"], after["means"][moved])
    here = torch.arange(len(new), device=parents.device)
    if len(old) == len(new) and bool((parents == here).all()):
        return None
    # A clone is appended behind its parent, so the first of equal rows is the one that was there.
    first = torch.full((len(old) + 1,), len(new), device=parents.device).scatter_reduce(0, parents + 1, here, "amin")
    fresh = first[parents + 1] != here
    fresh[moved] = True
    return Change(parents, fresh)


class Detail:
    """f_det and an Adam of its own, for hosts that look their parameters up by name and stumble over one more.

    Its rows follow the host's Gaussians, and it can tell how they went.

    Args:
        params: the host's leaves of this moment, by gsplat's names.
    """

    def __init__(self, params: Callable[[], Mapping[str, Tensor]]) -> None:
        self._params = params
        self._known = self._look()
        self._parents: Int[Tensor, " M"] | None = None  # since `rows` was last asked
        self._value = torch.nn.Parameter(torch.zeros_like(self._known["means"], requires_grad=False))
        rates = LearningRates()
        self._adam = torch.optim.Adam([self._value], lr=rates.detail, eps=rates.eps)

    @property
    def value(self) -> Float[Tensor, "N 3"]:
        """A row for each Gaussian that the host has now."""
        self._follow()
        return self._value

    def offset(self, sh0: Float[Tensor, "N ..."]) -> Float[Tensor, "N ..."]:
        """f_det in the constant band of the colours."""
        return (self.value.detach() / SH_C0).view_as(sh0)

    def rows(self, remembered: Callable[[], Mapping[str, Tensor]]) -> Int[Tensor, " M"] | None:
        """parents[M] of what happened since it was last asked; None: nothing.

        Raises:
            HostError: a Gaussian came from nowhere, but something is `remembered` of each.
        """
        self._follow()
        parents, self._parents = self._parents, None
        if parents is None:
            return None
        orphans = int((parents < 0).sum())
        if orphans and (names := ", ".join(remembered())):
            raise HostError(
                f"{orphans:,} new Gaussians are copies of none in colour and rotation, so nothing tells where they came "
                f"from; but {names} is remembered per Gaussian. End densification first."
            )
        return parents.clamp_min(0)

    def step(self) -> None:
        """Beside a step of the host; nothing where this iteration left no gradient."""
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)

    def _look(self) -> dict[str, Tensor]:
        params = self._params()
        return {name: params[name] for name in _COMPARED}

    @torch.no_grad()
    def _follow(self) -> None:
        now = self._look()
        if now["means"] is self._known["means"]:
            if len(now["means"]) != len(self._value):
                raise HostError(
                    f"the host changed the number of Gaussians from {len(self._value):,} to {len(now['means']):,} inside "
                    "its parameters. Clones and pruned sets must be parameters of their own, as in 3DGS."
                )
            return
        before, self._known = self._known, now
        happened = change(before, now)
        if happened is not None:
            self._take(happened)
            known = self._parents
            inherited = happened.parents if known is None else known[happened.parents.clamp_min(0)]
            self._parents = torch.where(happened.parents < 0, -1, inherited)

    def _take(self, happened: Change) -> None:
        """The parents' rows, and momentum for those alone that were there; without a parent f_det is 0."""
        rows, orphans = happened.parents.clamp_min(0), happened.parents < 0
        state = self._adam.state.pop(self._value, {})
        value = self._value[rows]
        value[orphans] = 0
        self._value = torch.nn.Parameter(value)
        self._adam.param_groups[0]["params"] = [self._value]
        for name, moment in state.items():
            if moment.dim():  # the count of steps has no rows
                state[name] = moment[rows]
                state[name][happened.fresh | orphans] = 0
        if state:
            self._adam.state[self._value] = state


def _bits(rows: Float[Tensor, "N ..."]) -> Int[Tensor, "N K"]:
    """Equal where the rows are equal bit by bit."""
    flat = rows.detach().flatten(1).contiguous()
    return flat.view(torch.int64 if flat.dtype == torch.float64 else torch.int32).long()


def _hash(bits: Int[Tensor, "N K"]) -> Int[Tensor, " N"]:
    h = torch.zeros_like(bits[:, 0])
    for column in bits.unbind(1):
        h = (h ^ column) * _ODD
        h = h ^ (h >> 29)
    return h


def _first_equal(
    old: Int[Tensor, "N K"], new: Int[Tensor, "M K"]
) -> tuple[Int[Tensor, " M"], tuple[Tensor, Tensor, Tensor]]:
    """The first old row equal to each new one, or -1; and the old rows in an order in which equal ones are neighbours,
    with where each new row's begin and end there.
    """
    sought, (keys, order) = _hash(new), _hash(old).sort(stable=True)
    begin, end = torch.searchsorted(keys, sought), torch.searchsorted(keys, sought, right=True)
    if not len(old):
        return torch.full_like(begin, -1), (order, begin, end)
    parents = order[begin.clamp_max(len(old) - 1)]
    parents[(old[parents] != new).any(1)] = -1
    return parents, (order, begin, end)


def _nearest_kin(
    old: Int[Tensor, "N K"], new: Int[Tensor, "M K"], old_means: Float[Tensor, "N 3"], new_means: Float[Tensor, "M 3"]
) -> Int[Tensor, " M"]:
    parents, (order, begin, end) = _first_equal(old, new)
    ambiguous = (parents >= 0) & (end - begin > 1)
    for first in sorted(set(begin[ambiguous].tolist())):
        children = (ambiguous & (begin == first)).nonzero()[:, 0]
        candidates = order[first : int(end[children[0]])]
        parents[children] = candidates[torch.cdist(new_means[children], old_means[candidates]).argmin(1)]
    return parents
