"""Which Gaussian came from which.

Hosts that gather every entry of their parameters carry row numbers, see rows.py; 3DGS's GaussianModel names the rows that it
keeps, see inria/rows.py. Others do not say. Such a host replaces its parameters when it clones, splits or prunes. The replaced
parameters hold the values of the last step, and every new row is a copy of an old row except for position, scale and opacity.
A comparison of both sets therefore finds the change, whatever functions of the host made it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_COPIED: Final = ("quats", "sh0")  # rows that split children keep; some hosts change the opacity of clones
COMPARED: Final = ("means", *_COPIED)
"""The parameters that `find_change` reads."""
_HASH_FACTOR: Final = 0x2545F4914F6CDD1D


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change of structure.

    Args:
        parents: row i now comes from row parents[i]; -1: from no row that can be found.
        fresh: rows that the change added: second copies of a parent, and moved rows.
    """

    parents: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]


class Lineage(Protocol):
    """What follows a host's changes of structure."""

    def poll(self) -> Change | None:
        """The change since the last call; None: there was none."""
        ...

    def restart(self) -> None:
        """The host has loaded other parameters, which come from no earlier ones."""
        ...


class MatchedRows:
    """The lineage of a host that does not say, by its parameters' values.

    Args:
        params: returns the host's current leaves, by gsplat's names.
    """

    def __init__(self, params: Callable[[], Mapping[str, Tensor]]) -> None:
        self._params = params
        self.restart()

    def restart(self) -> None:
        self._known = self._compared()

    def poll(self) -> Change | None:
        now = self._compared()
        if now["means"] is self._known["means"]:
            return None
        before, self._known = self._known, now
        return find_change(before, now)

    def _compared(self) -> dict[str, Tensor]:
        params = self._params()
        return {name: params[name] for name in COMPARED}


def is_same(parents: Int[Tensor, " M"], n: int) -> bool:
    """Whether the M rows are the N rows that they come from, in the same order."""
    return len(parents) == n and bool((parents == torch.arange(n, device=parents.device)).all())


def change_of(parents: Int[Tensor, " M"], n: int) -> Change | None:
    """The change of N Gaussians that made row i from row parents[i]; None: the rows are the same.

    Of the rows with one parent, that at its parent's place is the old Gaussian, else the first.
    """
    if is_same(parents, n):
        return None
    rows = torch.arange(len(parents), device=parents.device)
    place = torch.where(parents == rows, rows - len(parents), rows)  # < 0: it has kept its place
    first = torch.full((n,), len(parents), device=parents.device).scatter_reduce(0, parents, place, "amin")
    return Change(parents, first[parents] != place)


def find_change(before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> Change | None:
    """Compare the parameters `COMPARED` of N Gaussians with those of M Gaussians; None: the rows are the same.

    Equal rows are the same Gaussian. The parent of any other row is the Gaussian with the same rotation and colour, or
    the nearest of several.
    """
    old, new = (torch.cat([_bits(rows[name]) for name in COMPARED], 1) for rows in (before, after))
    parents, _ = _first_equal(old, new)
    moved = (parents < 0).nonzero()[:, 0]
    if len(moved):
        parents[moved] = nearest_copied(before, {name: after[name][moved] for name in COMPARED})
    if is_same(parents, len(old)):
        return None
    rows = torch.arange(len(new), device=parents.device)
    # Hosts append a clone behind its parent, so the first of equal rows is the old Gaussian.
    first = torch.full((len(old) + 1,), len(new), device=parents.device).scatter_reduce(0, parents + 1, rows, "amin")
    fresh = first[parents + 1] != rows
    fresh[moved] = True
    return Change(parents, fresh)


def are_copies(rows: Mapping[str, Tensor], of: Mapping[str, Tensor], parents: Int[Tensor, " M"]) -> bool:
    """Whether each of M rows has the rotation and colour of its parent; a row without a parent (-1) may have any."""
    known = (parents >= 0).nonzero()[:, 0]
    return all(bool((_bits(rows[name][known]) == _bits(of[name][parents[known]])).all()) for name in _COPIED)


def nearest_copied(before: Mapping[str, Tensor], rows: Mapping[str, Tensor]) -> Int[Tensor, " M"]:
    """The Gaussian of the same rotation and colour as each of M rows, the nearest of several; -1: there is none."""
    old, new = (torch.cat([_bits(given[name]) for name in _COPIED], 1) for given in (before, rows))
    parents, (order, begin, end) = _first_equal(old, new)
    ambiguous = (parents >= 0) & (end - begin > 1)
    for first in sorted(set(begin[ambiguous].tolist())):
        children = (ambiguous & (begin == first)).nonzero()[:, 0]
        candidates = order[first : int(end[children[0]])]
        distances = torch.cdist(rows["means"][children], before["means"][candidates])
        parents[children] = candidates[distances.argmin(1)]
    return parents


def _bits(rows: Float[Tensor, "N ..."]) -> Int[Tensor, "N K"]:
    """Integers that are equal where the rows are equal bit by bit."""
    flat = rows.detach().flatten(1).contiguous()
    return flat.view(torch.int64 if flat.dtype == torch.float64 else torch.int32).long()


def _hash(bits: Int[Tensor, "N K"]) -> Int[Tensor, " N"]:
    h = torch.zeros_like(bits[:, 0])
    for column in bits.unbind(1):
        h = (h ^ column) * _HASH_FACTOR
        h = h ^ (h >> 29)
    return h


def _first_equal(
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
