"""The conflict between the LR and HR gradients of a Gaussian: inner products by attribute group, and what is counted of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from clear_strategies.core import deferred
from clear_strategies.core.deferred import Number
from clear_strategies.core.gradients import CONFLICT_GROUPS


@dataclass(frozen=True, slots=True, eq=False)
class Products:
    """⟨l, h⟩, ‖l‖² and ‖h‖² of every Gaussian by group; 0 for a group that one of both lacks."""

    dot: Float[Tensor, "N G"]
    l2: Float[Tensor, "N G"]
    h2: Float[Tensor, "N G"]

    def whole(self) -> Products:
        """The same, and in a last column those of the groups together, as if they were one vector."""
        three = torch.stack((self.dot, self.l2, self.h2))
        return Products(*torch.cat((three, three.sum(2, keepdim=True)), 2))


@dataclass(frozen=True, slots=True, eq=False)
class GradientColumns:
    """The groups that both gradients have, side by side in float64, where no product of two floats over- or underflows.

    Args:
        names: the groups. member: 1 where column d belongs to group k of `CONFLICT_GROUPS`.
    """

    names: Sequence[str]
    lr: Float[Tensor, "N D"]
    hr: Float[Tensor, "N D"]
    member: Float[Tensor, "D G"]
    work: Float[Tensor, "N D"]  # one buffer for all that is computed: fresh pages cost more than the arithmetic

    @classmethod
    def of(
        cls, lr: Mapping[str, Tensor], hr: Mapping[str, Tensor], groups: Sequence[str] = CONFLICT_GROUPS
    ) -> GradientColumns:
        """The columns of these groups, in the order of `CONFLICT_GROUPS`. Raises ValueError where no two gradients are of one."""
        names = [group for group in CONFLICT_GROUPS if group in groups and group in lr and group in hr]
        if not names:
            raise ValueError(
                f"it compares the groups {', '.join(groups)}, and no two gradients are of one: lr has "
                f"{', '.join(lr) or 'none'}, hr has {', '.join(hr) or 'none'}. Name them so."
            )
        widths = tuple((name, lr[name].shape[1:].numel()) for name in names)
        low, high = _side_by_side(lr, names), _side_by_side(hr, names)
        return cls(names, low, high, _member(widths, str(low.device)), torch.empty_like(low))

    def products(self) -> Products:
        pairs = (self.lr, self.hr), (self.lr, self.lr), (self.hr, self.hr)
        return Products(*(torch.mul(a, b, out=self.work) @ self.member for a, b in pairs))

    def minus(self, multiple: Float[Tensor, "N G"], like: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The difference h - multiple · l by group, with the shapes and the type of `like`. It takes the place of `hr`."""
        corrected = self.hr.sub_(torch.mm(multiple, self.member.T, out=self.work).mul_(self.lr))
        widths = [like[name].shape[1:].numel() for name in self.names]
        parts = corrected.to(like[self.names[0]].dtype).split_with_sizes(widths, 1)
        return {
            name: part.view(like[name].shape).to(like[name].dtype) for name, part in zip(self.names, parts, strict=True)
        }


@dataclass(frozen=True, slots=True, eq=False)
class ConflictCounts:
    """What a comparison of all Gaussians shows, by group of `CONFLICT_GROUPS`.

    Args:
        comparable: Gaussians where neither gradient is zero: invisible and dropped ones do not count (F38, F42); a seventh
            number is for the Gaussian as a whole. opposed: of them, those with a cosine below 0, before correction.
        corrected: Gaussians. omega: Σ ω over these. at_lower_bound: those with ω at its lower bound.
    """

    comparable: Sequence[Number]
    opposed: Sequence[Number]
    corrected: Sequence[Number] = (0,) * len(CONFLICT_GROUPS)
    omega: Sequence[Number] = (0.0,) * len(CONFLICT_GROUPS)
    at_lower_bound: Sequence[Number] = (0,) * len(CONFLICT_GROUPS)

    def ratios(self, groups: Sequence[str]) -> dict[str, Number]:
        """The share of comparable Gaussians that are opposed, by group, and as "gaussian" for the groups together; NaN where
        nothing could be compared.
        """
        at = {name: k for k, name in enumerate((*CONFLICT_GROUPS, "gaussian")) if name in groups or name == "gaussian"}
        return {name: deferred.defer(deferred.ratio, self.opposed[k], self.comparable[k]) for name, k in at.items()}


def counted(p: Products) -> ConflictCounts:
    """Comparable and opposed Gaussians."""
    whole = p.whole()
    comparable = (whole.l2 > 0) & (whole.h2 > 0)
    return ConflictCounts(
        deferred.elements(comparable.sum(0)), deferred.elements(((whole.dot < 0) & comparable).sum(0))
    )


def conflict_ratio(lr: Mapping[str, Tensor], hr: Mapping[str, Tensor]) -> dict[str, Number]:
    """Share of Gaussians whose LR and HR gradients point apart, by group and for the groups together; {} without a common one."""
    if not any(group in lr and group in hr for group in CONFLICT_GROUPS):
        return {}
    columns = GradientColumns.of(lr, hr)
    return counted(columns.products()).ratios(columns.names)


def _side_by_side(grads: Mapping[str, Tensor], names: Sequence[str]) -> Float[Tensor, "N D"]:
    rows = [(g if g.dim() > 1 else g[:, None]).detach().flatten(1) for g in (grads[name] for name in names)]
    out = rows[0].new_empty(len(rows[0]), sum(x.shape[1] for x in rows), dtype=torch.float64)
    return torch.cat(rows, 1, out=out)


@lru_cache(maxsize=16)
def _member(widths: tuple[tuple[str, int], ...], device: str) -> Float[Tensor, "D G"]:
    member = torch.zeros(sum(width for _, width in widths), len(CONFLICT_GROUPS), dtype=torch.float64, device=device)
    first = 0
    for name, width in widths:
        member[first : first + width, CONFLICT_GROUPS.index(name)] = 1
        first += width
    return member
