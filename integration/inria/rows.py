"""Which Gaussian came from which in a GaussianModel: row indices follow the two functions that change its structure."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from jaxtyping import Int
from torch import Tensor

from integration.lineage import COMPARED, Change, MatchedRows, are_copies, change_of, is_same, nearest_copied
from integration.replacing import ReplacedMethods

_log = logging.getLogger(__name__)

_NAMES: Final = {"means": "xyz", "quats": "rotation", "sh0": "f_dc"}
"""The parameter groups of 3DGS that hold the parameters `COMPARED`."""


class CarriedRows(MatchedRows):
    """Row indices that follow a GaussianModel's `_prune_optimizer` and `cat_tensors_to_optimizer`.

    The densifiers of 3DGS and its forks end in these two functions. The first keeps rows, and says which. The second appends
    rows, which are copies of rows that exist at that moment except for position, scale and opacity, so that their parents are
    found by value among them. If other functions have changed the structure, or a row is no copy of the parent that was
    carried, the parents of all rows are found by value (`MatchedRows`).

    Args:
        model: the GaussianModel; both methods are replaced in this object.
        params: returns its current leaves, by gsplat's names.
    """

    def __init__(self, model: Any, params: Callable[[], Mapping[str, Tensor]]) -> None:
        super().__init__(params)
        self._model, self._warned = model, False
        self._methods = ReplacedMethods(model, {
            "_prune_optimizer": functools.partial(_after, self._keep),
            "cat_tensors_to_optimizer": functools.partial(_after, self._append),
        })  # fmt: skip

    def restart(self) -> None:
        super().restart()
        self._number()

    def poll(self) -> Change | None:
        now = self._compared()
        if now["means"] is self._known["means"]:
            return None
        parents, fresh, carried = self._parents, self._fresh, self._carried
        self._number()
        if carried and len(parents) == len(now["means"]) and are_copies(now, self._known, parents):
            n = len(self._known["means"])
            self._known = now
            return None if is_same(parents, n) else Change(parents, fresh)
        if carried and not self._warned:
            self._warned = True
            _log.warning(
                "%s changes its rows elsewhere than in _prune_optimizer and cat_tensors_to_optimizer. Their parents are found by "
                "the values of colours and rotations instead.", type(self._model).__name__,
            )  # fmt: skip
        return super().poll()

    def remove(self) -> None:
        """Give the model its own methods back."""
        self._methods.undo()

    def _number(self) -> None:
        """Every row comes from itself."""
        means = self._compared()["means"]
        self._parents = torch.arange(len(means), device=means.device)
        self._fresh = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        self._carried = False

    def _keep(self, rows: Tensor) -> None:
        """Before `_prune_optimizer(rows)`: it keeps these rows."""
        self._carried = True
        if len(self._parents) == len(self._compared()["means"]):
            self._parents, self._fresh = self._parents[rows], self._fresh[rows]

    def _append(self, tensors: Mapping[str, Tensor]) -> None:
        """Before `cat_tensors_to_optimizer(tensors)`: it appends these rows, by the names of the parameter groups."""
        self._carried = True
        now = self._compared()
        if len(self._parents) != len(now["means"]) or any(name not in tensors for name in _NAMES.values()):
            return
        found = nearest_copied(now, {name: tensors[_NAMES[name]] for name in COMPARED})
        parents = self._parents[found.clamp_min(0)] if len(now["means"]) else found
        self._parents = torch.cat((self._parents, torch.where(found < 0, -1, parents)))
        self._fresh = torch.cat((self._fresh, torch.ones_like(found, dtype=torch.bool)))

    def take(self, parents: Int[Tensor, " M"]) -> None:
        """Row i of the model has been replaced by row parents[i]."""
        self._carried = True
        change = change_of(parents, len(self._parents))
        if change is not None:
            self._parents, self._fresh = self._parents[parents], self._fresh[parents] | change.fresh


def _after(hook: Callable[[Any], None], method: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call the method after the hook; both get the same first argument."""
    with torch.no_grad():
        hook((*args, *kwargs.values())[0])
    return method(*args, **kwargs)
