"""A host's changes of structure, as the strategies hear of them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Int
from torch import Tensor

from clear_strategies.core.step import Step
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor


class Structure:
    """The number of a host's Gaussians, and what the strategies store of each.

    Args:
        n: of the Gaussians.
        poll_parents, remedy, restart_parents: see `Attachment`.
    """

    def __init__(
        self, conductor: Conductor, n: int, poll_parents: Callable[[], Int[Tensor, " M"] | None], remedy: str,
        restart_parents: Callable[[], None],
    ) -> None:  # fmt: skip
        self._conductor, self.n = conductor, n
        self._poll_parents, self._remedy, self._restart_parents = poll_parents, remedy, restart_parents

    def restart(self, n: int) -> None:
        """The host has loaded N other Gaussians, of which a checkpoint of the strategies holds the state."""
        self._restart_parents()
        self.n = n

    def follow(self, n: int, step: Step | None) -> tuple[bool, Step | None]:
        """Gather what the strategies store per Gaussian if the structure has changed.

        Args:
            n: Gaussians that the host has now. step: holds numbers per Gaussian, too.

        Returns:
            Whether it has changed, and the step with the rows of now.

        Raises:
            HostError: something is stored of each Gaussian, but it is unknown where new ones come from.
        """
        parents = self._poll_parents()
        if parents is None and n == self.n:
            return False, step
        if parents is not None and len(parents) != n:
            raise HostError(f"the host says of {len(parents):,} Gaussians which they come from, but has {n:,}.")
        state = ", ".join(name for name, rows in self._conductor.state_dict().items() if rows.dim() > 0)
        if parents is not None and (unknown := int((parents < 0).sum())):
            if state:
                raise HostError(
                    f"{unknown:,} new Gaussians come from no other, but {state} is stored of each Gaussian. {self._remedy}"
                )
            parents = parents.clamp_min(0)
        if step is not None:  # without parents, what it holds per Gaussian cannot be gathered
            step = Step(step.t, step.view) if parents is None else step.resized(parents)
        if parents is not None:
            self._conductor.on_resize(parents)
        elif state:
            # SVS raises an AnchorError here, which says more: the anchor's iteration, and the setting to change.
            self._conductor.on_resize(torch.zeros(n, dtype=torch.long))
            raise HostError(
                f"the number of Gaussians changed from {self.n:,} to {n:,} and the host does not say which came from "
                f"which, but {state} is stored per Gaussian. End densification first, or pass the host's state."
            )
        self.n = n
        return True, step
