"""Parents of the Gaussians of a GaussianModel: row indices follow the two functions that change its structure.

Where the indices are lost, values identify the rows. A model replaces its parameters when it clones, splits or prunes. The
replaced parameters hold the values of the last step, and every new row is a copy of an old row except for position, scale and
opacity. A comparison of both sets therefore finds the change, whatever functions of the host made it.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Final

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from integration.announcement import Once
from integration.replacing import replaced_methods
from integration.structure import bits, composed, first_equal, is_same

_log = logging.getLogger(__name__)

_COPIED: Final = ("quats", "sh0")  # rows that split children keep; some hosts change the opacity of clones
_COMPARED: Final = ("means", *_COPIED)
_GROUPS: Final = {"means": "xyz", "quats": "rotation", "sh0": "f_dc"}
"""The parameter groups of 3DGS that hold the parameters `_COMPARED`."""
_DISTANCES: Final = 1 << 24  # at once, 64 MB: FSGS appends very many Gaussians of one colour


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """One change of structure.

    Args:
        parents: row i now comes from row parents[i]; -1: from no row that can be found.
        fresh: rows that the change added: second copies of a parent, and moved rows.
    """

    parents: Int[Tensor, " M"]
    fresh: Bool[Tensor, " M"]


class CarriedRows:
    """Row indices that follow a GaussianModel's `_prune_optimizer`, `cat_tensors_to_optimizer` and `relocate_gs`.

    The densifiers of 3DGS and its forks end in the first two. `_prune_optimizer` keeps rows, and says which.
    `cat_tensors_to_optimizer` appends rows, which are copies of rows that exist at that moment except for position, scale and
    opacity, so that their parents are found by value among them. `relocate_gs`, of 3dgs-mcmc, writes copies over dead rows. If
    other functions have changed the structure, or a row is no copy of the parent that was carried, the parents of all rows are
    found by value.

    Args:
        model: the GaussianModel; the methods are replaced in this object.
        params: returns its current leaves, by gsplat's names.
    """

    def __init__(self, model: Any, params: Callable[[], Mapping[str, Tensor]]) -> None:
        self._model, self._params, self._warn_once = model, params, Once(_log.warning)
        self._undo = ExitStack()
        self._undo.enter_context(replaced_methods(model, {
            "_prune_optimizer": functools.partial(_hooked, self._keep),
            "cat_tensors_to_optimizer": functools.partial(_hooked, self._append),
            "relocate_gs": self._relocate,
        }))  # fmt: skip
        self.restart()

    def restart(self) -> None:
        """Every row comes from itself."""
        self._before = self._compared()
        means = self._before["means"]
        self._parents = torch.arange(len(means), device=means.device)
        self._fresh = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        self._carried = False

    def poll(self) -> Change | None:
        """The change since the last call; None: there was none."""
        before, parents, fresh, carried = self._before, self._parents, self._fresh, self._carried
        if self._compared()["means"] is before["means"]:
            return None
        self.restart()
        now = self._before
        if carried and len(parents) == len(now["means"]) and _are_copies(now, before, parents):
            return None if is_same(parents, len(before["means"])) else Change(parents, fresh)
        if carried:
            self._warn_once(
                "%s changes its rows elsewhere than in _prune_optimizer and cat_tensors_to_optimizer. Their parents are found by "
                "the values of colours and rotations instead.", type(self._model).__name__,
            )  # fmt: skip
        return find_change(before, now)

    def remove(self) -> None:
        """Give the model its own methods back."""
        self._undo.close()

    def _compared(self) -> dict[str, Tensor]:
        params = self._params()
        return {name: params[name] for name in _COMPARED}

    def _keep(self, rows: Tensor) -> None:
        """Before `_prune_optimizer(rows)`: it keeps these rows."""
        self._carried = True
        if len(self._parents) == len(self._compared()["means"]):
            self._parents, self._fresh = self._parents[rows], self._fresh[rows]

    def _append(self, tensors: Mapping[str, Tensor]) -> None:
        """Before `cat_tensors_to_optimizer(tensors)`: it appends these rows, by the names of the parameter groups."""
        self._carried = True
        now = self._compared()
        if len(self._parents) != len(now["means"]) or any(name not in tensors for name in _GROUPS.values()):
            return
        nearest = _nearest_copied(now, {name: tensors[_GROUPS[name]] for name in _COMPARED})
        self._parents = torch.cat((self._parents, composed(nearest, self._parents)))
        self._fresh = torch.cat((self._fresh, torch.ones_like(nearest, dtype=torch.bool)))

    def _relocate(self, relocate_gs: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        """It writes into the memory of the replaced parameters too, so that these no longer show which row was the dead one."""
        before = {name: rows.detach().clone() for name, rows in self._compared().items()}
        result = relocate_gs(*args, **kwargs)
        change = find_change(before, self._compared())
        if change is not None and len(self._parents) == len(before["means"]) == len(change.parents):
            self._carried = True
            self._parents = composed(change.parents, self._parents)
            self._fresh |= change.parents != torch.arange(len(self._fresh), device=self._fresh.device)
        return result


def _hooked(hook: Callable[[Any], None], method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call the method after the hook; both get the same first argument."""
    with torch.no_grad():
        hook((*args, *kwargs.values())[0])
    return method(*args, **kwargs)


def find_change(before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> Change | None:
    """Compare the parameters `_COMPARED` of N Gaussians with those of M Gaussians; None: the rows are the same.

    Equal rows are the same Gaussian. The parent of any other row is the Gaussian with the same rotation and colour, or
    the nearest of several.
    """
    old, new = (torch.cat([bits(rows[name]) for name in _COMPARED], 1) for rows in (before, after))
    parents, _ = first_equal(old, new)
    moved = (parents < 0).nonzero()[:, 0]
    if len(moved):
        parents[moved] = _nearest_copied(before, {name: after[name][moved] for name in _COMPARED})
    if is_same(parents, len(old)):
        return None
    rows = torch.arange(len(new), device=parents.device)
    # Hosts append a clone behind its parent, so the first of equal rows is the old Gaussian.
    first = torch.full((len(old) + 1,), len(new), device=parents.device).scatter_reduce(0, parents + 1, rows, "amin")
    fresh = first[parents + 1] != rows
    fresh[moved] = True
    return Change(parents, fresh)


def _are_copies(rows: Mapping[str, Tensor], of: Mapping[str, Tensor], parents: Int[Tensor, " M"]) -> bool:
    """Return True if each of M rows has the rotation and colour of its parent; a row without a parent (-1) may have any."""
    known = (parents >= 0).nonzero()[:, 0]
    return all(bool((bits(rows[name][known]) == bits(of[name][parents[known]])).all()) for name in _COPIED)


def _nearest_copied(before: Mapping[str, Tensor], rows: Mapping[str, Tensor]) -> Int[Tensor, " M"]:
    """The Gaussian of the same rotation and colour as each of M rows, the nearest of several; -1: there is none."""
    old, new = (torch.cat([bits(params[name]) for name in _COPIED], 1) for params in (before, rows))
    parents, (order, begin, end) = first_equal(old, new)
    ambiguous = (parents >= 0) & (end - begin > 1)
    for first in sorted(set(begin[ambiguous].tolist())):
        children = (ambiguous & (begin == first)).nonzero()[:, 0]
        candidates = order[first : int(end[children[0]])]
        means = before["means"][candidates]
        for some in children.split(max(1, _DISTANCES // len(candidates))):
            parents[some] = candidates[torch.cdist(rows["means"][some], means).argmin(1)]
    return parents
