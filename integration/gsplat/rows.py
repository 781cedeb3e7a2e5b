"""Parents of Gaussians in hosts that gather every entry of their parameters: row numbers are one of these entries."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import Any, Final

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.errors import HostError
from integration.structure import is_same
from rasterizers.torch_internals import version

ROWS: Final = "clear_rows"
"""Key of the row numbers."""
_EXACT: Final = 2  # eps of a type, times the largest n up to which it represents all whole numbers
_ROUNDING: Final = 0.1  # averaging equal numbers over many steps changes them by less


class RowNumbers:
    """Row numbers, which clone, split, prune, relocation and MCMC's sampling gather like every other entry. They are float64,
    exact up to 2^53, because a loop may treat all its parameters alike, e.g. average them.

    Args:
        entries: the host's parameters, if one of them may be untrained; or other tensors that are gathered with them: the `state`
            of gsplat 1.4's strategies, or the `signal` of gsplat 1.6's scene.
        means: returns the current positions.
        as_parameter: whether the numbers must be a parameter.
    """

    def __init__(
        self, entries: MutableMapping[str, Any] | torch.nn.ParameterDict, means: Callable[[], Tensor], *,
        as_parameter: bool = True,
    ) -> None:  # fmt: skip
        self._entries: Any = entries
        self._means, self._as_parameter = means, as_parameter
        self._hooks = (
            [
                entries.register_state_dict_post_hook(_leave_out),  # type: ignore[no-untyped-call]
                entries.register_load_state_dict_pre_hook(_put_in),  # type: ignore[no-untyped-call]
            ]
            if isinstance(entries, torch.nn.ParameterDict)
            else []
        )
        self.restart()

    def restart(self) -> None:
        """Number the rows from 1. A host writes 0 for a new Gaussian whose parent it does not know, or that has none."""
        means = self._means()
        rows = torch.arange(1, len(means) + 1, device=means.device, dtype=torch.float64)
        self._numbered = len(means)
        self._entries[ROWS] = torch.nn.Parameter(rows, requires_grad=False) if self._as_parameter else rows
        self._unchanged = self._entries[ROWS], version(self._entries[ROWS])

    def poll(self) -> Int[Tensor, " M"] | None:
        """parents[M] of the change since the last call: row i comes from row parents[i], or from none if that is -1; None: the
        rows are the same.

        Raises:
            HostError: a densifier changed the parameters but not this one, or the loop has computed with the numbers or rounded
                them.
        """
        rows: Tensor = self._entries[ROWS]
        n = len(self._means())
        if len(rows) != n and self._as_parameter:
            raise HostError(
                f"the densifier changed the number of Gaussians from {len(rows):,} to {n:,} without the parameter {ROWS}. It "
                "must treat every entry of the parameters alike. Where the loop has loaded other Gaussians, remove() and attach "
                "again."
            )
        of, of_version = self._unchanged
        is_unchanged = rows is of and version(rows) == of_version
        rounds = rows.dtype.is_floating_point and self._numbered * torch.finfo(rows.dtype).eps > _EXACT
        if is_unchanged and rounds:
            self.restart()  # `splats.half()` has converted all parameters
        if is_unchanged or len(rows) != n:  # a scene moves Gaussians in place
            return None
        if rounds:
            raise HostError(
                f"the parameter {ROWS} must be float64, got {rows.dtype} for {self._numbered:,} row numbers, which that rounds. "
                "Convert the other parameters alone, or all of them before attach."
            )
        parents, numbered = rows.detach().round().long() - 1, self._numbered
        if bool(((rows - parents - 1).abs() > _ROUNDING).any()) or bool(((parents < -1) | (parents >= numbered)).any()):
            raise HostError(
                f"the parameter {ROWS} must hold row numbers from 0 to {numbered:,}, but the loop has computed others of them. "
                f"Leave it out where all parameters are changed: if name != {ROWS!r}, or if p.requires_grad."
            )
        self.restart()
        return None if is_same(parents, numbered) else parents

    @property
    def remedy(self) -> str:
        """What to do about Gaussians without a parent, if strategies store something per Gaussian."""
        if self._as_parameter:
            return (
                f"As you add one, write to its row of the parameter {ROWS} the row of the Gaussian that it resembles, plus 1. Or "
                "add them before that is stored, or leave out the strategy."
            )
        return "gsplat 1.4 does not say where relocated Gaussians come from. Update it to 1.5 or later."

    def remove(self) -> None:
        """Take the row numbers out of the host."""
        if ROWS in self._entries:
            del self._entries[ROWS]
        for hook in self._hooks:
            hook.remove()


def _leave_out(_: Any, stored: dict[str, Any], prefix: str, *__: Any) -> None:
    """Keep row numbers out of the host's checkpoints."""
    stored.pop(f"{prefix}{ROWS}", None)


def _put_in(module: Any, stored: dict[str, Any], prefix: str, *_: Any) -> None:
    """Keep the present row numbers when a checkpoint is loaded."""
    stored.setdefault(f"{prefix}{ROWS}", module[ROWS])
